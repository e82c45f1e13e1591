"""JSON files with a digest of their content, so that corruption on a disk cannot silently change a camera."""

import hashlib
import json
from pathlib import Path
from typing import Any

from nerfcli.atomic import write_json

SEAL = "blake2b"


def digest(value: Any) -> str:
    """Hash plain values; equal values have equal digests in every process and on every machine."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()


def write_sealed(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON object with the digest of its content, atomically.

    Raises:
        UserError: it cannot be written.
    """
    write_json(path, {**content, SEAL: digest(content)})


def read_sealed(path: Path) -> dict[str, Any]:
    """Read an object that `write_sealed` wrote; a file without a digest is accepted unchecked.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not a JSON object, or its content has changed.
    """
    content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    if (seal := content.pop(SEAL, None)) is not None and seal != digest(content):
        raise ValueError("its content has changed since it was written")
    return content
