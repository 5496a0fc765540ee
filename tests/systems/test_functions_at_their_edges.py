"""Functions of users that return other kinds of numbers, and plants and bounds at their edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import systems
from staf_torch.systems.black_box import BlackBox

ZERO, NONE = torch.zeros(2).double(), torch.zeros(1).double()


def moved(x: Any, u: Any) -> Any:
    """Rows of (x_2, u), of arrays alone."""
    if isinstance(x, Tensor):
        raise TypeError("no tensors")
    return np.concatenate((x[:, 1:], u), axis=1)


def test_a_function_that_cuts_its_graph_is_no_function_in_torch() -> None:
    def cut(x: Any, u: Any) -> Any:
        after = 0.9 * torch.as_tensor(x) + torch.as_tensor(u)
        return after.detach() if isinstance(x, Tensor) else after.numpy()

    assert BlackBox("Test(step=...)", cut, ZERO, NONE).torch is False
    assert BlackBox("Test(step=...)", lambda x, u: 0.9 * x + u, ZERO, NONE).torch is True


KINDS: dict[str, Any] = {
    "float32": lambda found: found.astype(np.float32),
    "objects": lambda found: found.astype(object),
    "lists": lambda found: found.tolist(),
}


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_what_a_function_returns_becomes_numbers_of_the_state(kind: str) -> None:
    def step(x: Any, u: Any) -> Any:
        return KINDS[kind](moved(x, u))

    box = BlackBox("Test(step=...)", step, ZERO, NONE)
    x, u = tensor([[0.5, 0.25], [1.0, -2.0]]), tensor([[4.0], [0.125]])
    after = box(x, u)
    assert after.dtype == torch.float64
    assert after.tolist() == [[0.25, 4.0], [-2.0, 0.125]]
    assert box(x.float(), u.float()).dtype == torch.float32
    states, controls = box.follow(x.numpy(), lambda x: 0.5 * x[:, :1], 3)
    assert states.dtype == np.float64
    assert states[0].tolist() == [[0.5, 0.25], [0.25, 0.25], [0.25, 0.125], [0.125, 0.125]]
    assert controls[0].tolist() == [[0.25], [0.125], [0.125]]


def test_known_slopes_are_numbers_in_double_precision_whatever_they_are_given_as() -> None:
    known = [[0, 1], [0, 0]], [[0], [1]]
    plant = systems.StepPlant(moved, dim=2, inputs=1, dt=0.1, slopes=lambda x, u: known)
    found = plant.linearisation()
    assert found.matrix.dtype == found.input_matrix.dtype == torch.float64
    assert (found.matrix.tolist(), found.input_matrix.tolist()) == known


@pytest.mark.parametrize("kind", [systems.StepPlant, systems.RatePlant])
def test_a_plant_rests_in_double_precision_and_every_coordinate_may_be_an_angle(kind: Any) -> None:
    more = {"dt": 0.1} if kind is systems.StepPlant else {}
    plant = kind(lambda x, u: 0.5 * x + u, dim=1, inputs=1, periodic=[0, -1], **more)
    assert plant.periodic == (0,)
    for part in (plant.equilibrium(), plant.resting_input()):
        assert part.dtype == torch.float64
    exact = kind(lambda x, u: 0 * x + x.detach() + u - 0.1, dim=1, inputs=1, equilibrium=[0.1], **more)
    wanted = 0.1 if kind is systems.StepPlant else 0.0
    assert float(exact.equilibrium()) == 0.1
    assert float(exact.resting_input()) == pytest.approx(wanted, abs=1e-12)
    with pytest.raises(ValueError, match="periodic"):
        kind(lambda x, u: 0.5 * x + u, dim=1, inputs=1, periodic=[1], **more)


class Odd(systems.ControlAffineSystem):
    """A plant whose drift is no tensor of the state's shape."""

    dim = 2

    def __init__(self, drift: Any) -> None:
        super().__init__()
        self.found = drift

    def drift(self, x: Tensor) -> Any:
        return self.found(x)

    def effectiveness(self, x: Tensor) -> Tensor:
        return x.new_zeros(*x.shape, 0)


def test_a_drift_of_another_shape_or_kind_is_shown() -> None:
    for drift, shown in ((lambda x: x[:, :1], r"got \(3, 1\)\."), (lambda x: "nothing", r"got nothing\.")):
        with pytest.raises(ValueError, match=shown):
            systems.simulate(Odd(drift), uniform(3, 2), dt=0.1, steps=2)


def test_bounds_that_leave_no_room_are_refused_and_slopes_at_them_point_inward() -> None:
    with pytest.raises(ValueError, match="must be below high"):
        systems.Bounds(1.0, 1.0, 2)
    with pytest.raises(ValueError, match="must be below high"):
        systems.Bounds([0.0, 2.0], [1.0, 2.0], 2)
    bounds = systems.Bounds(-1.0, 2.0, 1)
    u = tensor([[-1.0], [-1.0], [2.0], [2.0], [0.5], [-1.0], [2.0]])
    slope = tensor([[0.5], [-0.5], [0.5], [-0.5], [0.5], [0.0], [1.5]])
    assert bounds.inward(u, slope).flatten().tolist() == [0.0, -0.5, 0.5, 0.0, 0.5, 0.0, 1.5]
    assert bounds.contain(u).all()
    assert bounds.contain(tensor([[-1.001], [2.001], [0.0]])).tolist() == [False, False, True]
    assert systems.Bounds(None, [3.0, float("inf")], 2).present
    assert systems.Bounds([-3.0, -float("inf")], None, 2).present
    assert not systems.Bounds(None, float("inf"), 2).present
