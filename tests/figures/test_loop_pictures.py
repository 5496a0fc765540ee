"""A closed loop from Python: its picture with the LQR's run beside, and its five lines."""

from __future__ import annotations

import copy
import logging
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from figures.drawing import lines, visible
from helpers import tensor
from torch import Tensor

from staf_torch import adp, rows, systems
from staf_torch.figures.style import page

pytest.importorskip("scipy", reason="the LQR needs the extra adp")

pytestmark = pytest.mark.usefixtures("not_laid_out")


class Integrator(systems.ControlAffineSystem):
    """A plant of a user's own, without a name for anything."""

    dim, inputs = 2, 1

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 0 * x[..., 1]), -1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)


def pendulum() -> tuple[Any, ...]:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-0.5, high=0.7)
    return systems.Pendulum(), cost, torch.tensor([[0.5, 0.1], [-0.3, 0.0], [0.2, 0.4]])


def unnamed() -> tuple[Any, ...]:
    return Integrator(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), torch.tensor([[0.5, 0.1]])


def tracking() -> tuple[Any, ...]:
    plant = systems.Clocked(Integrator())
    cost = adp.TrackingCost(
        *(1.0, 1.0, 2, 1), path=lambda t: torch.stack((0.3 * t.sin(), 0.3 * t.cos()), dim=-1)
    )
    return plant, cost, plant.at(torch.tensor([[0.5, 0.1]]))


def wide() -> tuple[Any, ...]:
    """Bounds far from all controls, units for two states where there are three."""
    plant = systems.Linear(torch.diag(torch.tensor([-1.0, -1, -1])), torch.ones(3, 2))
    plant.units = systems.Units("m, kg", "V")
    cost = adp.QuadraticCost(1.0, 1.0, dim=3, inputs=2, low=-1e3, high=[1e3, float("inf")])
    return plant, cost, torch.tensor([[0.5, 0.1, 0.2]])


STATE, INPUT, COST = "state $x$", "control $u$", "cost so far"
CASES = {
    pendulum: ["$x_{1}$ (rad)", "$x_{2}$ (rad/s)", "control $u$ (N m)", COST],
    unnamed: [STATE, INPUT, COST],
    tracking: [STATE, INPUT, COST],  # the clock is no state to look at
    wide: ["state $x$ (m, kg)", "control $u$ (V)", COST],
}


def run(case: Any, policy: Any = None) -> adp.LoopResult:
    plant, cost, x0 = case()
    policy = policy or (lambda x: -0.4 * x[..., 1:2].expand(*x.shape[:-1], cost.inputs))
    return adp.simulate(policy, plant, cost, x0.double(), dt=0.05, steps=20, compile=False)


@pytest.mark.parametrize("case", CASES)
def test_a_closed_loop_is_drawn_with_units_bounds_and_the_lqr_beside(case: Any) -> None:
    result = run(case)
    figure = result.figure(width=3.4)
    grid = visible(figure)
    assert [axes.get_ylabel() for axes in grid] == CASES[case]
    assert figure.get_size_inches()[0] == 3.4
    assert all("LQR" in [line.get_label() for line in axes.get_lines()] for axes in grid)
    paid = lines(grid[-1])
    lqr = next(y for name, _, y in paid if name == "LQR")
    own = next(y for name, _, y in paid if name == "this loop")
    np.testing.assert_allclose(own, result.running_cost[0])
    plant, cost, x0 = case()
    best = adp.Feedback(adp.LQR(plant, cost, period=0.05))
    other = adp.simulate(best, plant, cost, x0[:1].double(), dt=0.05, steps=20, compile=False)
    np.testing.assert_allclose(lqr, other.running_cost[0], rtol=1e-9)
    level = {float(y[0]) for name, x, y in lines(grid[-2]) if list(x) == [0, 1]}
    assert level == {pendulum: {-0.5, 0.7}, wide: {-1e3, 1e3}}.get(case, set())
    if case is wide:  # the axis is that of the data
        assert grid[-2].get_ylim()[1] < 10
        assert "bounds -1000, 1000" in grid[-2].get_title(loc="left")
    wanted = [y for name, _, y in lines(grid[0]) if name == "wanted"]
    assert len(wanted) == (case is tracking)


@pytest.mark.parametrize("rest", [-0.5, 3.0])
def test_a_control_that_differs_by_rounding_has_an_axis_of_its_size(rest: float) -> None:
    figure = run(pendulum, lambda x: rest + 1e-12 * x[..., :1]).figure(lqr=False)
    control = visible(figure)[2]
    low, high = control.get_ylim()
    assert low < -0.5 < 0.7 < high  # clipped to a bound: both are seen
    assert {float(y[0]) for _, x, y in lines(control) if list(x) == [0, 1]} == {-0.5, 0.7}
    with page(2.0) as other:
        other.subplots().plot([0, 1], [5.0, 5.0 + 1e-12])
    assert np.ptp(other.axes[0].get_ylim()) > 0.4


def test_a_closed_loop_says_in_five_lines_what_it_was() -> None:
    text = repr(run(pendulum)).splitlines()
    assert len(text) == 5
    assert text[0].startswith("LoopResult: Pendulum with <lambda>, 3 rows, 21 times, 0 to 1 s")
    assert "rad/s" in text[1]
    assert text[2].endswith("N m; bounds -0.5 to 0.7")
    assert "0 of 3 diverged" in text[4]
    assert all(len(repr(run(case)).splitlines()) == 5 for case in (unnamed, wide))


def test_a_copy_of_a_result_has_its_units_and_no_plant() -> None:
    result = run(pendulum)
    for other in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result), *result.split([1, 2])):
        assert other.figure(lqr=False).axes[0].get_ylabel() == "$x_{1}$ (rad)"
    (part,) = result.split([3])
    assert repr(part) == repr(result)


def test_a_loop_without_an_lqr_says_why_and_is_drawn(caplog: pytest.LogCaptureFixture) -> None:
    plant = systems.Linear([[1.0]], [[0.0]])  # no input moves it
    cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    result = adp.simulate(
        lambda x: 0 * x, plant, cost, torch.ones(1, 1).double(), dt=0.1, steps=5, compile=False
    )
    with caplog.at_level(logging.WARNING):
        figure = result.figure()
    assert "no LQR beside this loop" in caplog.text
    assert len(visible(figure)) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rows": [3]}, r"figure\(rows=...\)` must be some of the 3 rows"),
        ({"font": "Comic Sands"}, r"`LoopResult.figure\(font=...\)` must name a font"),
    ],
)
def test_what_a_picture_cannot_be_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run(pendulum).figure(lqr=False, **options)


def test_rows_with_bounds_of_their_own_are_drawn_with_the_widest() -> None:
    low, high = rows(tensor([[-2.0], [-3.0]])), rows(tensor([[2.0], [1.0]]))
    cost = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1).bounded(low, high)
    plant = systems.Pendulum()
    loop = adp.simulate(
        adp.LQR(plant, cost), plant, cost, tensor([[0.3, 0.0], [0.2, 0.0]]), dt=0.1, steps=3, compile=False
    )
    for one in (loop, pickle.loads(pickle.dumps(loop))):
        assert "bounds -3 to 2, or less in some rows" in str(one)
        drawn = lines(visible(one.figure())[2])
        assert {float(y[0]) for _, x, y in drawn if list(x) == [0, 1]} == {-3.0, 2.0}
