"""Adam without torch's own class: the same bits. `test_fresh_process.py` shows that it loads no compiler."""

import sys
from types import SimpleNamespace

import pytest
import torch

from nerfcli.training.optimiser import BETAS, EPS, Adam


@pytest.fixture(autouse=True)
def _no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare torch's class the compiler that it imports with its first step, which takes 3 CPU seconds."""
    nothing = SimpleNamespace(graph_break=lambda: None, disable=lambda function, *_, **__: function)
    monkeypatch.setitem(sys.modules, "torch._dynamo", nothing)
    monkeypatch.setattr(torch, "_dynamo", nothing, raising=False)


def test_steps_are_those_of_torch_to_the_bit_and_go_on_from_a_saved_state():
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn(5, 3, generator=generator), torch.randn(7, generator=generator)]
    own, theirs = ([tensor.clone().requires_grad_() for tensor in start] for _ in range(2))
    adam, reference = Adam(own), torch.optim.Adam(theirs, betas=BETAS, eps=EPS)
    for step in range(12):
        rate = 0.1 / (1 + step)
        gradients = [torch.randn(tensor.shape, generator=generator) * 10.0**-step for tensor in start]
        for one, other, gradient in zip(own, theirs, gradients, strict=True):
            one.grad, other.grad = gradient.clone(), gradient.clone()
        if step == 3:
            own[1].grad = theirs[1].grad = None  # without a gradient, a parameter and its moments stay
        if step == 6:
            saved = {name: tensor.clone() for name, tensor in adam.state("adam").items()}
            adam = Adam(own)
            adam.restore({**saved, "something.else": torch.ones(1)}, "adam")
        reference.param_groups[0]["lr"] = rate
        adam.step(rate)
        reference.step()
        assert all(torch.equal(one, other) for one, other in zip(own, theirs, strict=True))
    adam.zero_grad()
    assert own[0].grad is None


def test_what_was_never_saved_begins_anew():
    parameter = torch.ones(3, requires_grad=True)
    adam = Adam([parameter])
    parameter.grad = torch.ones(3)
    adam.step(0.1)
    adam.restore({}, "adam")
    assert all((tensor == 0).all() for tensor in adam.state("adam").values())
