"""Tensors with a JSON description in one safetensors file: no pickle, no code on load."""

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nerfcli.atomic import atomic_path
from nerfcli.errors import UserError


def save_tensors(path: Path, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
    """Write tensors and their description; the file appears whole or not at all."""
    content = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_path(path) as partial:
        try:
            save_file(content, partial, metadata={"description": json.dumps(description, allow_nan=False)})
            partial.chmod(0o644)  # safetensors makes files that only their owner can read
        except SafetensorError as error:  # a full disk comes as this, not as OSError
            raise OSError(str(error)) from error


def load_tensors(path: Path, device: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `save_tensors` wrote, on `device`.

    Raises:
        UserError: the file is missing, cut short, or not one of ours.
    """
    try:
        with safe_open(path, framework="pt", device=device) as file:
            metadata = file.metadata() or {}
            return {name: file.get_tensor(name) for name in file.keys()}, json.loads(metadata["description"])  # noqa: SIM118
    except FileNotFoundError as error:
        raise UserError(
            f"{path} does not exist", "train first (nerfcli train SCENE), or give the folder that train wrote"
        ) from error
    except (SafetensorError, KeyError, OSError, json.JSONDecodeError) as error:
        raise UserError(
            f"{path} is not a readable checkpoint: {error}",
            "train again with --overwrite, or restore the file",
        ) from error
