"""Boxes of states and inputs beside logarithms and loops that are written out, with every kind of wall."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import systems
from staf_torch.systems.barrier import wall_numbers

INF = math.inf
A, B = tensor([[0.0, 1.0, 0.2], [-2.0, -1.0, 0.1], [0.3, 0.0, -0.5]]), tensor([[0.0], [1.0], [0.5]])


class Aside(systems.Linear):
    """A linear plant that rests at (0.5, -1, 2) without an input."""

    center = (0.5, -1.0, 2.0)

    def equilibrium(self) -> Tensor:
        return tensor(self.center)

    def drift(self, x: Tensor) -> Tensor:
        return super().drift(x - tensor(self.center))


BOXES: dict[str, tuple[list[float], list[float]]] = {
    "both": ([-1.0, -2.0, 0.0], [2.5, 3.0, 2.1]),
    "low": ([-1.0, -INF, 0.0], [INF, INF, INF]),
    "high": ([-INF, -INF, -INF], [0.75, 1.0, INF]),
    "mixed": ([-INF, -1.5, -INF], [4.0, INF, INF]),
    "none": ([-INF] * 3, [INF] * 3),
}
X = tensor([[0.5, -1.0, 2.0], [0.6, -0.5, 1.5], [-0.9, -1.4, 0.1], [0.7, 0.9, 2.05], [0.499, -1.001, 2.001]])


def boxed(name: str) -> systems.Barrier:
    low, high = BOXES[name]
    return systems.Barrier(Aside(A, B), low, high)


def coordinate(x: float, low: float, high: float, c: float) -> float:
    if math.isinf(low) and math.isinf(high):
        return x - c
    down = 1.0 if math.isinf(low) else (x - low) / (c - low)
    up = 1.0 if math.isinf(high) else (high - x) / (high - c)
    return math.log(down / up)


def stretched(x: float, low: float, high: float) -> float:
    if math.isinf(low) and math.isinf(high):
        return 1.0
    return 1 / (x - low) + 1 / (high - x)


@pytest.mark.parametrize("name", BOXES)
def test_coordinates_are_the_logarithm_of_the_distances(name: str) -> None:
    box, (low, high) = boxed(name), BOXES[name]
    s = box.transform(X)
    walls = list(zip(low, high, Aside.center, strict=True))
    expected = [[coordinate(x, *w) for x, w in zip(row, walls, strict=True)] for row in X.tolist()]
    torch.testing.assert_close(s, tensor(expected), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(box.coordinates(X), s, rtol=0, atol=0)
    torch.testing.assert_close(box.inverse(s), X, rtol=1e-13, atol=1e-13)
    rates = [[stretched(x, *w[:2]) for x, w in zip(row, walls, strict=True)] for row in X.tolist()]
    torch.testing.assert_close(box.stretch(s), tensor(rates), rtol=1e-11, atol=0)
    to_low, to_high = box.walls(s)
    torch.testing.assert_close(to_low, X - tensor(low), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(to_high, tensor(high) - X, rtol=1e-12, atol=1e-13)
    margins = torch.minimum(X - tensor(low), tensor(high) - X).amin(-1)
    torch.testing.assert_close(box.margin(s), margins, rtol=1e-12, atol=1e-13)
    assert box.transform(X[0]).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("name", BOXES)
def test_a_step_of_the_state_is_a_step_of_its_coordinates(name: str) -> None:
    box, (low, high) = boxed(name), BOXES[name]
    s, step = box.transform(X), 0.1 * uniform(5, 3, seed=1)
    moved = X + step
    inside = (moved > tensor(low)) & (moved < tensor(high))
    found = box.displaced(s, step)
    for k in range(5):
        for i in range(3):
            if inside[k, i]:
                wanted = coordinate(float(moved[k, i]), low[i], high[i], Aside.center[i])
                assert float(found[k, i]) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
            else:
                assert math.isnan(float(found[k, i]))
    far = box.displaced(s, tensor([[9.0, 9.0, 9.0], [-9.0, -9.0, -9.0]]).repeat(3, 1)[:5])
    lost = torch.stack((torch.isfinite(tensor(high)), torch.isfinite(tensor(low)))).repeat(3, 1)[:5]
    assert torch.equal(far.isnan(), lost)


@pytest.mark.parametrize("name", BOXES)
def test_steps_are_half_the_time_to_the_nearest_wall_ahead(name: str) -> None:
    box, (low, high) = boxed(name), BOXES[name]
    u = uniform(5, 1, seed=3)
    rates = ((X - tensor(Aside.center)) @ A.mT + u @ B.mT).tolist()
    found = box.step_limit(box.transform(X), u)
    torch.testing.assert_close(box.velocity(box.transform(X), u), tensor(rates), rtol=1e-11, atol=1e-11)
    for k, (x, rate) in enumerate(zip(X.tolist(), rates, strict=True)):
        times = [INF]
        for i in range(3):
            if rate[i] < 0:
                times.append((x[i] - low[i]) / -rate[i])
            if rate[i] > 0:
                times.append((high[i] - x[i]) / rate[i])
        assert float(found[k]) == pytest.approx(0.5 * min(times), rel=1e-9)


@pytest.mark.parametrize("name", BOXES)
def test_rates_and_linearisations_are_those_of_the_plant_stretched(name: str) -> None:
    box = boxed(name)
    s, u = box.transform(X), uniform(5, 1, seed=4)
    stretch = box.stretch(s)
    inner = box.plant
    torch.testing.assert_close(box.drift(s), stretch * inner.drift(X), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(box.smooth_drift(s), stretch * inner.drift(X), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(box.effectiveness(s), stretch.unsqueeze(-1) * B, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(box.rate(s, u), stretch * inner.rate(X, u), rtol=1e-10, atol=1e-10)
    at = stretch[2]
    found = box.linearisation(s[2], u[2])
    torch.testing.assert_close(found.matrix, at[:, None] * A / at, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(found.input_matrix, at[:, None] * B, rtol=1e-10, atol=0)
    rest = box.linearisation()
    at = box.stretch(torch.zeros(3).double())
    torch.testing.assert_close(rest.matrix, at[:, None] * A / at, rtol=1e-12, atol=1e-13)


def test_slopes_pass_the_middle() -> None:
    """There the nearer wall changes."""
    box = boxed("both")
    middle = torch.zeros(3, dtype=torch.float64)
    slope = torch.func.jacrev(box.inverse)(middle)
    torch.testing.assert_close(slope, torch.diag(1 / box.stretch(middle)), rtol=1e-12, atol=1e-15)
    back = torch.func.jacrev(box.transform)(tensor(Aside.center) + 1e-9)
    torch.testing.assert_close(back, torch.diag(box.stretch(middle)), rtol=1e-6, atol=1e-12)


def test_angles_are_counted_from_either_end_and_lose_their_turn_by_a_wall() -> None:
    plant = systems.Linear(A, B)
    plant.periodic = (-1, 0)
    assert systems.Barrier(plant, None, None).periodic == (-1, 0)
    assert systems.Barrier(plant, [-1.0, None, None], None).periodic == (-1,)
    assert systems.Barrier(plant, None, [None, None, 1.0]).periodic == (0,)
    assert systems.Barrier(plant, -1.0, 1.0).periodic == ()
    box = systems.Barrier(plant, [-1.0, None, None], [2.0, None, None])
    x = tensor([0.4 + 4 * math.pi, 0.3, 0.2])
    torch.testing.assert_close(
        box.transform(x), box.transform(tensor([0.4, 0.3, 0.2])), rtol=1e-9, atol=1e-12
    )


def test_rows_outside_are_named_up_to_twenty() -> None:
    box = boxed("both")
    for rows, more in ((20, False), (21, True)):
        x = X[:1].repeat(rows + 2, 1)
        x[2:, 0] = 2.5
        with pytest.raises(ValueError, match="not so row 2, 3,") as caught:
            box.transform(x)
        said = str(caught.value)
        assert f", {21}" in said
        assert ("22" in said.split("of which")[0]) is False
        assert ("and more" in said) is more
    with pytest.raises(ValueError, match=r"not so row 0, of which the first is \[0.5, -2.0, 2.0\]"):
        box.transform(tensor([0.5, -2.0, 2.0]))


def test_what_is_no_wall_is_refused() -> None:
    given = tensor([1.0, 2.0])
    assert wall_numbers("Barrier", "low", given, -INF, 2).tolist() == [1.0, 2.0]
    assert wall_numbers("Barrier", "low", None, -INF, 2).tolist() == [-INF, -INF]
    assert wall_numbers("Barrier", "high", [None, 3], INF, 2).tolist() == [INF, 3.0]
    assert wall_numbers("Barrier", "high", 4, INF, 2).dtype == torch.float64
    assert wall_numbers("Barrier", "low", tensor(5.0), -INF, 3).tolist() == [5.0] * 3
    for wrong, message in (
        ("ab", "must be a number or one for each of the 2 states"),
        ([1.0], "must be a number or one for each of the 2 states"),
        (object(), "must be a number or one for each of the 2 states"),
        ([1.0, "b"], "must be numbers or None"),
        ([1.0, True], "must be numbers or None"),
        ([1.0, math.nan], "must be finite or -inf"),
        ([1.0, INF], "must be finite or -inf"),
    ):
        with pytest.raises(ValueError, match=rf"`Barrier\(low=...\)` {message}"):
            wall_numbers("Barrier", "low", wrong, -INF, 2)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"below the equilibrium \[0.5, -1.0, 2.0\]"):
        systems.Barrier(Aside(A, B), [-1.0, -1.0, 0.0], None)
    with pytest.raises(ValueError, match=r"above the equilibrium \[0.5, -1.0, 2.0\]"):
        systems.Barrier(Aside(A, B), None, [3.0, 0.0, 2.0])
    sizeless = systems.Linear(A, B)
    sizeless.dim = None
    with pytest.raises(ValueError, match="must be a ControlAffineSystem with `dim`"):
        systems.Barrier(sizeless, -1.0, 1.0)


def test_a_box_says_its_walls_and_what_its_plant_is() -> None:
    box = boxed("low")
    assert "low=[-1.0, -inf, 0.0], high=[inf, inf, inf]" in repr(box)
    assert box.traceable
    box.plant.bounds = systems.Bounds(-1.0, 1.0, 1)
    assert systems.Barrier(box.plant, None, None).bounds is box.plant.bounds  # type: ignore[arg-type]
    assert box.inputs == 1
    assert box.dim == 3


# --- boxes of inputs ----------------------------------------------------------------------------------------


def test_inputs_at_their_bounds_are_inside_and_are_not_pushed_out() -> None:
    bounds = systems.Bounds([-1.0, 0.0], [2.0, INF], 2)
    u = tensor([[-1.0, 0.0], [2.0, 5.0], [0.5, 1.0], [-1.5, 1.0], [2.5, 1.0], [0.5, -0.1]])
    assert bounds.contain(u).tolist() == [True, True, True, False, False, False]
    assert bounds.clip(u).tolist() == [[-1, 0], [2, 5], [0.5, 1], [-1, 1], [2, 1], [0.5, 0]]
    up, down = torch.ones(6, 2).double(), -torch.ones(6, 2).double()
    assert bounds.inward(u, up)[:3].tolist() == [[0, 0], [1, 1], [1, 1]]
    assert bounds.inward(u, down)[:3].tolist() == [[-1, -1], [0, -1], [-1, -1]]
    assert bounds.inward(u, 0 * up).abs().sum() == 0
    moved = bounds.measured_from(tensor([0.5, 1.0]))
    assert (moved.low.tolist(), moved.high.tolist()) == ([-1.5, -1.0], [1.5, INF])
    assert repr(bounds) == "Bounds(low=[-1.0, 0.0], high=[2.0, inf])"


def test_bounds_are_numbers_lists_or_tensors_on_either_side() -> None:
    assert systems.Bounds(None, None, 2).present is False
    assert systems.Bounds(-1.0, None, 2).present is True
    assert systems.Bounds(None, [INF, 1], 2).present is True
    given = tensor([1.0, 2.0])
    bounds = systems.Bounds(-3, given, 2)
    given[0] = 9.0
    assert (bounds.low.tolist(), bounds.high.tolist()) == ([-3.0, -3.0], [1.0, 2.0])
    assert bounds.low.dtype == torch.float64
    for low, high, message in (
        (1.0, 1.0, r"`Bounds\(low=...\)` must be below high, \[1.0, 1.0\]"),
        ([0.0, 2.0], 1.0, r"must be below high"),
        (INF, None, r"`Bounds\(low=...\)` must be finite or -inf"),
        (None, -INF, r"`Bounds\(high=...\)` must be finite or inf"),
        (None, [1.0, math.nan], r"`Bounds\(high=...\)` must be finite or inf"),
        ([1.0], None, r"must be a number or one for each of the 2 inputs"),
        (None, True, r"`Bounds\(high=...\)` must be a number or one an input"),
        (object(), None, r"`Bounds\(low=...\)` must be a number or one an input"),
    ):
        with pytest.raises(ValueError, match=message):
            systems.Bounds(low, high, 2)  # type: ignore[arg-type]
