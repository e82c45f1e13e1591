"""Tensors with a JSON description in one safetensors file: no pickle, no code on load, no damage unnoticed."""

import hashlib
import json
import struct
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save_file
from torch import Tensor, uint8

from nerfcli.atomic import atomic_path
from nerfcli.errors import NON_FINITE, UserError

# Entry of the file's metadata. The format has no checksum: a bit that flips on disk would silently change the field.
# Digest and description share an entry, as safetensors writes several in any order, and equal fields give equal files.
_ENTRY = "description"


def save_tensors(path: Path, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write tensors and their description with a digest of both; the file appears whole or not at all.

    The same content gives the same bytes.
    """
    content = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    digest = _digest(content, json.dumps(description, allow_nan=False))
    with atomic_path(path) as partial:
        try:
            save_file(content, partial, metadata={_ENTRY: json.dumps([digest, description])})
            partial.chmod(0o644)  # safetensors makes files that only their owner can read
        except SafetensorError as error:  # a full disk raises this, not OSError
            raise OSError(str(error)) from error


def load_tensors(path: Path, device: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Load tensors that `save_tensors` wrote, on `device`.

    Raises:
        UserError: the file is missing, cut short, damaged, or not one of ours.
    """
    return tensors_of(read_checkpoint(path), path, device)


def read_checkpoint(path: Path) -> bytes:
    """Read a whole file at once, as a running training may replace it in the meantime."""
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist", "train first (nerfcli train SCENE), or give a run folder") from error
    except OSError as error:
        raise _unreadable(path, error) from error


def tensors_of(content: bytes, path: Path, device: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors and their description from the content of a file; see `load_tensors`."""
    try:
        tensors = load(content)
        (length,) = struct.unpack_from("<Q", content)
        digest, description = json.loads(json.loads(content[8 : 8 + length])["__metadata__"][_ENTRY])
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise _unreadable(path, error) from error
    if digest != _digest(tensors, json.dumps(description)):
        raise UserError(
            f"{path} is damaged: its content has changed since it was written",
            "train again with --overwrite, or restore the file; check the disk",
        )
    return {name: tensor.to(device) for name, tensor in tensors.items()}, description


def _unreadable(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} is not a readable checkpoint: {error}", "train again with --overwrite, or restore the file"
    )


def refuse_non_finite(tensors: dict[str, Tensor], path: Path) -> None:
    """Refuse weights from which no picture can be rendered: NaN or infinity; the message names the first tensor."""
    for name, tensor in tensors.items():
        if count := int((~tensor.isfinite()).sum()):
            raise UserError(
                f"{name} in {path} has {count} non-finite values of {tensor.numel()}",
                "train again with --overwrite and, if this happens again, with another --seed",
                NON_FINITE,
            )


def _digest(tensors: dict[str, Tensor], description: str) -> str:
    """Hash names, types, shapes and bytes of all tensors (on the CPU), and of the description."""
    digest = hashlib.blake2b(description.encode(), digest_size=16)
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        # As bytes: NumPy has no bfloat16. An empty tensor cannot be viewed as another dtype.
        if tensor.numel():
            digest.update(tensor.reshape(-1).view(uint8).numpy().data)
    return digest.hexdigest()
