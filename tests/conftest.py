"""Shared fixtures and the one table of tolerances."""

import pytest
import torch

# Relative tolerance of a chain of some dozen operations, per dtype. A looser one in a test carries its reason.
TOLERANCE = {torch.float64: 1e-12, torch.float32: 5e-6}


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(autouse=True)
def _two_threads():
    """Small tensors do not pay for more, and the answers must not depend on it."""
    torch.set_num_threads(2)
