"""Cost of a trained field, and settings of fields of other kinds with about the same storage."""

from typing import Any

from nerfcli.errors import UserError
from nerfcli.field.cost import TRAINING, occupancy_bytes, optimiser_bytes, parameter_bytes, work
from nerfcli.field.hash_field import HashFieldSettings
from nerfcli.field.interface import FieldSettings
from nerfcli.field.kinds import KINDS
from nerfcli.field.sizes import chosen_size


def described_cost(
    settings: FieldSettings, *, occupancy_side: int, batch: int, samples_per_ray: float, picture_px: int
) -> dict[str, Any]:
    """Return bytes, operations and memory traffic of a field; see `cost.Work` for what is counted.

    Args:
        settings: kind and size.
        occupancy_side: cells per axis of the occupancy grid.
        batch: samples of a training step.
        samples_per_ray: mean number of samples along a ray that light reached.
        picture_px: pixels of a picture.

    Returns:
        Plain values: bytes; then operations and bytes moved per sample, forward, per picture, forward, and per step,
        forward and backward.
    """
    counts = work(settings)
    queries = picture_px * samples_per_ray
    return {
        "bytes": {
            "weights": parameter_bytes(counts.parameters),
            "occupancy": occupancy_bytes(occupancy_side),
            "optimiser": optimiser_bytes(counts.parameters),
            "activations": counts.activation_bytes(batch),
        },
        "per_sample": {"operations": counts.operations, "bytes_moved": counts.bytes_moved},
        "per_picture": {
            "samples": round(queries),
            "operations": round(queries * counts.operations),
            "bytes_moved": round(queries * counts.bytes_moved),
        },
        "per_step": {
            "samples": batch,
            "operations": batch * counts.operations * TRAINING,
            "bytes_moved": batch * counts.bytes_moved * TRAINING,
        },
    }


def other_kinds_with_equal_storage(settings: FieldSettings, footprint: float) -> dict[str, FieldSettings]:
    """Return, by kind, the largest other field within this storage; no entry for a kind whose fields are all larger."""
    memory = parameter_bytes(work(settings).parameters)
    template = HashFieldSettings(contraction=settings.contraction, view_degree=settings.view_degree)
    others = {}
    for kind in KINDS:
        if kind != settings.kind:
            try:
                others[kind] = chosen_size(kind, hash_grid=template, footprint=footprint, memory_bytes=memory)
            except UserError:  # the smallest of this kind is larger
                continue
    return others
