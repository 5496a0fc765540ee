"""What is compiled by itself is chosen by the work of a call, not by their number, and always alike."""

from __future__ import annotations

import itertools
import re
import time

import pytest
import torch
from torch import Tensor

import staf_torch as st
from staf_torch import adp, lanes, optim, systems, targets

pytestmark = pytest.mark.needs_compiler
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
X0 = torch.tensor([[0.3, 0.1]], dtype=torch.float64)


class Chain(systems.ControlAffineSystem):
    """A plant whose drift takes many small operations; it counts its calls."""

    dim, inputs = 2, 1

    def __init__(self, links: int) -> None:
        super().__init__()
        self.links, self.calls = links, list[int]()

    def drift(self, x: Tensor) -> Tensor:
        self.calls.append(len(x))
        force = lanes.repeat(self.links, lambda f: 0.99 * f.sin(), -x[..., 0])
        return torch.stack((x[..., 1], force - x[..., 1]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)


def run(plant: systems.ControlAffineSystem, steps: int, **more: object) -> tuple[adp.LoopResult, int]:
    plant.calls.clear()
    found = adp.simulate(lambda x: -x[..., 1:], plant, COST, X0, dt=0.01, steps=steps, **more)
    return found, len(plant.calls)


@pytest.mark.parametrize(("links", "steps", "compiled"), [(3, 60, False), (600, 200, True)])
def test_a_loop_is_compiled_where_its_operations_take_longer_than_a_compiler(
    links: int, steps: int, compiled: bool
) -> None:
    """Case 16 of FIELD.md: 200 steps of a costly plant, and not 60 of a cheap one."""
    found, calls = run(Chain(links), steps)
    assert (calls < 4 * steps) is compiled  # plain torch calls a plant four times a step
    assert torch.equal(found.state, run(Chain(links), steps, compile=compiled)[0].state)  # from the start


class Swing(systems.Pendulum):
    """A plant of a kind of its own: short calls are counted by kind."""


STATES = torch.rand(2, 5, 2, dtype=torch.float64)
BASIS = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(3), 0.1))
SHORT = {
    "the closed loop": (
        lambda: adp.simulate(lambda x: -x[..., 1:], Swing(), COST, X0, dt=0.01, steps=20),
        0.02,
    ),
    "a trajectory": (lambda: systems.simulate(Swing(), X0, dt=0.01, steps=20), 0.02),
    "the chase": (lambda: st.chase_weights(STATES, BASIS, targets.Paper(), optim.FixedStep(0.01)), 0.4),
}


@pytest.mark.parametrize("name", SHORT)
def test_short_calls_that_are_asked_again_and_again_say_once_what_they_cost(
    name: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("WARNING", logger="staf_torch.lanes.calls.choice")
    call, tick = SHORT[name]
    clock = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: tick * next(clock))
    with lanes.compiling("auto"):
        for _ in range(9):
            call()
    (line,) = [text for text in caplog.messages if "plain torch" in text]
    assert re.match(rf"{name}: 8 calls took 3.\d s in plain torch, 4\d\d ms each: each is too short", line)
    assert ("`compile=True` or `with lanes" in line) is (name == "the closed loop")
