"""Functions that a user brings: what they are asked, how their slopes are found, and where a plant rests."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import systems
from staf_torch.systems.black_box import BlackBox
from staf_torch.systems.equilibria import find_equilibrium, resting_input_at

A, B = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.3], [0.5]])
ZERO, NONE = torch.zeros(2).double(), torch.zeros(1).double()


def linear(x: Any, u: Any) -> Any:
    return x @ A.T + u @ B.T


def with_torch(x: Tensor, u: Tensor) -> Tensor:
    return x @ torch.from_numpy(A).mT + u @ torch.from_numpy(B).mT


def of_arrays(x: Any, u: Any) -> Any:
    if isinstance(x, Tensor):
        raise TypeError("no tensors")
    return linear(x, u)


@pytest.mark.parametrize("function", [of_arrays, with_torch])
def test_leading_dimensions_of_state_and_input_are_broadcast(function: Any) -> None:
    box = BlackBox("T", function, ZERO, NONE)
    for lead, other in (((), ()), ((4,), ()), ((), (4,)), ((3, 4), (1, 4))):
        x, u = uniform(*lead, 2, seed=1), uniform(*other, 1, seed=2)
        torch.testing.assert_close(box(x, u), with_torch(x, u))


def test_slopes_are_those_of_the_function_or_known() -> None:
    for box in (BlackBox("T", with_torch, ZERO, NONE), BlackBox("T", of_arrays, ZERO, NONE)):
        at = box.linearisation(tensor([3.0, -1.0]), tensor([0.5]))
        torch.testing.assert_close(at.matrix, tensor(A), rtol=0, atol=1e-8)
        torch.testing.assert_close(at.input_matrix, tensor(B), rtol=0, atol=1e-8)
        assert not at.matrix.requires_grad

    def slopes(x: np.ndarray, u: np.ndarray) -> tuple[Any, Any]:
        assert (x.tolist(), u.tolist()) == ([3.0, -1.0], [0.5])
        return A.tolist(), B.tolist()

    known = BlackBox("T", linear, ZERO, NONE, slopes).linearisation(tensor([3.0, -1.0]), tensor([0.5]))
    assert known.matrix.dtype == known.input_matrix.dtype == torch.float64
    assert known.matrix.tolist() == A.tolist()
    box = BlackBox("T", linear, ZERO, NONE, lambda x, u: (A, B * np.inf))
    with pytest.raises(ValueError, match=r"the `slopes` of `T` are not finite at the state \[0.0, 0.0\]"):
        box.linearisation(ZERO, NONE)
    box = BlackBox("T", linear, ZERO, NONE, lambda x, u: (A, B.T))
    with pytest.raises(ValueError, match=r"must have the shapes \(2, 2\) and \(2, 1\); got \("):
        box.linearisation(ZERO, NONE)


@pytest.mark.parametrize(("bend", "smooth"), [(0.115, True), (0.125, False)])
def test_a_kink_of_a_twentieth_of_the_largest_slope_is_one(bend: float, smooth: bool) -> None:
    """Slopes of a step of 6e-6, before the kink at 1e-4, and of 6e-4, five twelfths of it behind."""

    def bent(x: Any, u: Any) -> Any:
        if isinstance(x, Tensor):
            raise TypeError
        return x + u + bend * np.maximum(x - 1e-4, 0)

    box = BlackBox("T", bent, torch.ones(1).double(), NONE)
    at = torch.zeros(1).double()
    if smooth:
        assert float(box.linearisation(at, NONE).matrix) == pytest.approx(1.0, abs=1e-6)
    else:
        with pytest.raises(ValueError, match=r"slopes over 6e-06 and 0.0006 differ by 0.05. of the largest"):
            box.linearisation(at, NONE)


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (
            lambda x, u: [1.0],
            r"must map x and u of the shapes \(10, 2\) and \(10, 1\) to \(10, 2\); got \(1,\)",
        ),
        (
            lambda x, u: 1 / 0,
            r"raised ZeroDivisionError \(division by zero\) at x and u of the shapes \(5, 2\)",
        ),
        (lambda x, u: x + np.inf * u, r"not finite near x = \[0.0, 0.0\]"),
        (lambda x, u: 2 * x, r"`T\(f\)` ignores u: another input changes nothing near x = \[0.0, 0.0\]"),
    ],
)
def test_functions_that_are_none_are_told_why(function: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        BlackBox("T(f)", function, ZERO, NONE)


# --- where a plant rests ------------------------------------------------------------------------------------


class Moving(systems.Plant):
    """x' = slope x + gain u + offset, each coordinate alone; not affine in name."""

    def __init__(self, slope: float, gain: float, offset: float, dim: int = 1) -> None:
        super().__init__()
        self.slope, self.gain, self.offset, self.dim, self.inputs = slope, gain, offset, dim, 1

    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.slope * x + self.gain * u + self.offset

    def linearisation(self, x: Tensor | None = None, u: Tensor | None = None) -> systems.Linearisation:
        raise NotImplementedError


class Cubic(Moving):
    """x' = u^3 - 8 + x (1 + x^2), which rests at u = 2 with x = 0."""

    calls = 0

    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        self.calls += 1
        return u**3 - 8 + x * (1 + x**2)


def test_the_input_that_holds_a_state_is_found_from_a_guess_or_the_plants_own() -> None:
    plant = Cubic(0, 0, 0)
    x = torch.zeros(1).double()
    assert float(resting_input_at(plant, x, tensor([1.0]))) == pytest.approx(2.0, rel=1e-12)
    assert plant.calls < 40
    assert float(resting_input_at(plant, x + 1, tensor([1.0]))) == pytest.approx(6 ** (1 / 3), rel=1e-12)
    away = Moving(2.0, 4.0, -6.0)
    assert float(resting_input_at(away, x)) == pytest.approx(1.5)
    two = Moving(1.0, 1.0, 0.0, dim=2)  # nothing holds both at 1 and 0: the nearest
    assert float(resting_input_at(two, tensor([1.0, 0.0]))) == pytest.approx(-0.5)


def test_a_rest_is_searched_by_the_input_alone_and_then_by_both() -> None:
    x, u = find_equilibrium(Cubic(0, 0, 0), tensor([0.5]), tensor([1.0]))
    assert float(x) == 0.5
    assert float(u) == pytest.approx((8 - 0.5 * 1.25) ** (1 / 3), rel=1e-12)
    two = Moving(1.0, 1.0, 0.0, dim=2)
    x, u = find_equilibrium(two, tensor([1.0, 0.0]), tensor([0.0]))
    torch.testing.assert_close(x, -u.expand(2))
    torch.testing.assert_close(u, tensor([-1 / 3]))  # by the smallest step

    class Never(Moving):
        def motion(self, x: Tensor, u: Tensor) -> Tensor:
            return torch.stack((x[..., 0] + u[..., 0], 2.5 + 0 * x[..., 1]), dim=-1)

    said = "Never has no equilibrium near the guess, the state [0.0, 0.0] and the input [1.0]: state 1 keeps"
    with pytest.raises(ValueError, match=re.escape(said) + " moving, by 2.5"):
        find_equilibrium(Never(0, 0, 0, dim=2), torch.zeros(2).double(), torch.ones(1).double())


# --- plants of functions ------------------------------------------------------------------------------------


def test_guesses_are_states_or_pairs_and_angles_are_counted_from_either_end() -> None:
    def step(x: Any, u: Any) -> Any:
        return x + 0.1 * np.concatenate((x[:, 1:], u - np.sin(x[:, :1])), axis=1)

    given: dict[str, Any] = {"dim": 2, "inputs": 1, "dt": 0.1}
    for guess, rest in (
        (None, 0.0),
        (([0.5, 0.0], [0.3]), np.sin(0.5)),
        ((0.5, 0.0), np.sin(0.5)),  # a tuple of two numbers is a state
    ):
        plant = systems.StepPlant(step, equilibrium=guess, periodic=[-2, 0], **given)
        assert plant.periodic == (0,)
        assert float(plant.resting_input()) == pytest.approx(rest, abs=1e-9)
        assert plant.equilibrium()[1] == 0.0
        at = plant.linearisation()
        cosine = float(torch.cos(plant.equilibrium()[0]))
        torch.testing.assert_close(at.matrix, tensor([[1, 0.1], [-0.1 * cosine, 1]]), rtol=0, atol=1e-7)
        elsewhere = plant.linearisation(tensor([1.0, 0.0]))
        assert float(elsewhere.matrix[1, 0]) == pytest.approx(-0.1 * np.cos(1.0), abs=1e-7)
    turned = plant.motion(tensor([3.1, 1.0]), tensor([0.0]))
    assert float(turned[0]) == pytest.approx(0.1)
    assert plant.bounds is None
    assert systems.StepPlant(step, low=-1.0, **given).bounds is not None
    for wrong in ([0.5], ([0.5, 0.0], [0.3, 0.1])):
        with pytest.raises(
            ValueError, match=r"\(equilibrium=...\)` must be 2 numbers, or those and 1 of the"
        ):
            systems.StepPlant(step, equilibrium=wrong, **given)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"`StepPlant\(periodic=...\)` must be coordinates of 2"):
        systems.StepPlant(step, periodic=[-3], **given)


def moved(x: Any, u: Any) -> Any:
    """Rows of (x_2, u), of arrays alone."""
    if isinstance(x, Tensor):
        raise TypeError("no tensors")
    return np.concatenate((x[:, 1:], u), axis=1)


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
