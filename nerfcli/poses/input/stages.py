"""Files of completed stages: their content, and a hash of what it depends on.

A complete stage is a JSON file {"key", "content", "seal"} in the work folder. The key is a hash of everything that the
content depends on: a stage with another key than the requested one counts as missing. The seal is a hash of the
content: a stage that is cut off or was changed counts as missing, too.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from nerfcli.atomic import write_json


def stage_key(*parts: Any) -> str:
    """Return a hash of plain values: equal for equal values, in every process and on every machine."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=False)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def file_key(path: Path) -> str:
    """Return a hash of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def write_stage(path: Path, key: str, content: Any) -> None:
    """Mark a stage as complete. Everything else that belongs to it must be on disk already."""
    write_json(path, {"key": key, "content": content, "seal": _seal(content)})


def read_stage(path: Path, key: str) -> Any | None:
    """Return the content of the complete stage with this key, None if it is missing or damaged."""
    if not path.is_file():
        return None
    try:
        stage = json.loads(path.read_bytes())
    except (ValueError, RecursionError):  # cut off, or not text
        return None
    if not isinstance(stage, dict) or stage.get("key") != key or "content" not in stage:
        return None
    return stage["content"] if stage.get("seal") == _seal(stage["content"]) else None


def _seal(content: Any) -> str:
    return stage_key(json.loads(json.dumps(content)))  # as read back from a file: keys are strings, tuples are lists
