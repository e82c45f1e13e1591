"""Storage and work, by arithmetic: what a field costs before anything is run."""

from torch import nn


def parameter_bytes(count: int, *, bytes_per_value: int = 4) -> int:
    """Bytes of `count` parameters, without activations and optimiser state."""
    return count * bytes_per_value


def field_bytes(field: nn.Module) -> int:
    """Bytes of a field's parameters."""
    return sum(parameter_bytes(p.numel(), bytes_per_value=p.element_size()) for p in field.parameters())


def dense_grid_bytes(side: int, channels: int, *, bytes_per_value: int = 4) -> int:
    """Bytes of a dense grid of side^3 cells with `channels` values each."""
    return parameter_bytes(side**3 * channels, bytes_per_value=bytes_per_value)


def field_queries(width: int, height: int, samples_per_ray: float) -> int:
    """Field evaluations for one picture without skipping and early stop."""
    return round(width * height * samples_per_ray)
