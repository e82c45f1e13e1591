"""Encode the data that a live page fetches: a description in JSON, followed by arrays."""

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from nerfcli.viewer.packing import PackedField
from nerfcli.viewer.proof import Proof


def field_bytes(packed: PackedField, version: int) -> bytes:
    """Encode the parameters of a field; `version` is the field version in the server's status."""
    return _bytes({"version": version, "field": packed.field, "march": packed.march}, packed.arrays)


def proof_bytes(proof: Proof) -> bytes:
    """Encode the reference pictures that a page compares its own rendering with."""
    return _bytes({"proof": proof.description}, {"expected": proof.expected})


def _bytes(description: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the JSON length as uint32, the JSON, and the arrays in the order of its list "arrays" of [name, bytes]."""
    listed = [[name, array.nbytes] for name, array in arrays.items()]
    head = json.dumps({**description, "arrays": listed}, allow_nan=False).encode()
    body = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())
    return struct.pack("<I", len(head)) + head + body
