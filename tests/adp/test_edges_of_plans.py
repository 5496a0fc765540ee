"""Problems of plans, walls and windows at their edges: what is just allowed, and what lies just beyond."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_plans import BOX, pushed
from torch import Tensor

from staf_torch import adp, systems


def slow(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """One state that decays, in steps."""
    return 0.9 * x + 0.1 * u, 0.1 * (x.square() + u.square()).sum(-1)


def clocked(tick: float) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """One state and the time, which moves by a tick."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        after = torch.cat((0.9 * x[..., :1] + 0.1 * u, x[..., 1:] + tick), dim=-1)
        return after, 0.1 * (x[..., 0].square() + u.square().sum(-1))

    return step


def test_every_coordinate_of_a_problem_may_be_an_angle_from_either_end() -> None:
    problem = adp.SampledProblem(slow, dim=1, inputs=1, periodic=[0, -1])
    assert problem.periodic == (0,)
    assert float(problem.offset(tensor([[3.0]]), tensor([[-3.0]]))) == pytest.approx(6 - 2 * math.pi)
    for wrong in (1, -2):
        with pytest.raises(ValueError, match="periodic"):
            adp.SampledProblem(slow, dim=1, inputs=1, periodic=[wrong])


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 0.0), (0.1, 1.0)])
def test_the_input_at_rest_lies_between_the_bounds_and_not_at_one(low: float, high: float) -> None:
    with pytest.raises(ValueError, match="must lie between the bounds"):
        adp.SampledProblem(slow, dim=1, inputs=1, low=low, high=high)
    inside = adp.SampledProblem(slow, dim=1, inputs=1, low=-1e-9, high=1e-9)
    assert inside.levels().flatten().tolist() == [-1e-9, 0.0, 1e-9]


def test_a_path_needs_a_time_that_moves() -> None:
    def path(t: Tensor) -> Tensor:
        return 0 * t.unsqueeze(-1)

    made = adp.SampledProblem(clocked(0.25), dim=2, inputs=1, path=path)
    assert made.tick == 0.25
    assert made.goals(tensor([[0.3, 2.0]]), 2)[0].tolist() == [[0.0, 2.0], [0.0, 2.25], [0.0, 2.5]]
    for tick in (0.0, -0.25):
        with pytest.raises(ValueError, match="must move the time"):
            adp.SampledProblem(clocked(tick), dim=2, inputs=1, path=path)


def test_a_step_of_other_shapes_is_shown_beside_those_of_two_rows() -> None:
    wrong: list[Any] = [
        (lambda x, u: (x[:, :1], x.sum(-1)), r"x \(2, 2\) and u \(2, 2\) to x\+ .*got \(2, 1\) and \(2,\)"),
        (lambda x, u: (x, x), r"costs \(2,\); got \(2, 2\) and \(2, 2\)"),
    ]
    for step, said in wrong:
        with pytest.raises(ValueError, match=said):
            adp.SampledProblem(step, dim=2, inputs=2)


def test_a_problem_rests_within_a_millionth_and_costs_no_more() -> None:
    for moved, paid, fits in (
        (0.9e-6, 0.0, True),
        (1.1e-6, 0.0, False),
        (0, 0.9e-6, True),
        (0, 1.1e-6, False),
    ):

        def step(x: Tensor, u: Tensor, moved: float = moved, paid: float = paid) -> tuple[Tensor, Tensor]:
            after, cost = pushed(x, u)
            return after + moved, cost + paid

        if fits:
            adp.SampledProblem(step, dim=2, inputs=2)
        else:
            with pytest.raises(ValueError, match="must be a state of rest at no cost"):
                adp.SampledProblem(step, dim=2, inputs=2)


def test_samples_have_at_most_a_knot_a_step() -> None:
    made = adp.PathIntegral(BOX, steps=4, knots=4, samples=3, noise=0.1, compile=False)
    torch.testing.assert_close(made.spread, torch.eye(4).double())
    assert made.scales.tolist() == pytest.approx([1.0, 0.1, 0.01])
    assert made.draws == 12  # 3 samples of 4 knots of 2 inputs, in points of 2 states
    with pytest.raises(ValueError, match="knots"):
        adp.PathIntegral(BOX, steps=4, knots=5, noise=0.1, compile=False)
    with pytest.raises(ValueError, match="where an input has no bounds"):
        adp.PathIntegral(BOX, steps=4, knots=4, compile=False)


def test_a_horizon_without_improvement_is_cheap_and_one_with_it_costly() -> None:
    for iterations, costly in ((0, False), (1, True)):
        made = adp.RecedingHorizon(BOX, steps=3, iterations=iterations, compile=False)
        assert made.costly is costly
        assert made.width == 3 * (2 + 2 + 4)
        made.hasten()
        assert made._hastened is costly
    with pytest.raises(ValueError, match="iterations"):
        adp.RecedingHorizon(BOX, steps=3, iterations=-1, compile=False)


def test_as_many_inputs_as_states_are_fitted_along_the_inputs() -> None:
    plant = systems.Linear([[0.0, 1.0], [-1.0, -0.5]], [[1.0, 0.0], [0.0, 1.0]])
    policy = adp.near_optimal(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2), dt=0.1)
    assert policy.basis.count == 5
    assert policy.along is None  # of as many states as inputs
    more = systems.Linear([[-0.5]], [[1.0, 0.3]])
    wide = adp.near_optimal(more, adp.QuadraticCost(1.0, 1.0, dim=1, inputs=2), dt=0.1)
    assert (wide.basis.count, wide.basis.dim) == (3, 1)


def test_a_state_on_a_wall_is_outside() -> None:
    box = systems.Barrier(systems.Pendulum(), low=[-1.0, None], high=[2.0, None])
    for at, fits in ((-1.0, False), (2.0, False), (-0.999, True), (1.999, True)):
        x = tensor([[0.1, 0.0], [at, 0.0]])
        if fits:
            assert bool(box.transform(x).isfinite().all())
        else:
            with pytest.raises(ValueError, match=r"not so row 1, of which the first is"):
                box.transform(x)
    for low, high in ((0.0, 1.0), (-1.0, 0.0)):
        with pytest.raises(ValueError, match="the equilibrium"):
            systems.Barrier(systems.Pendulum(), low=[low, None], high=[high, None])


def test_the_first_window_may_be_as_long_as_the_others() -> None:
    model = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
    whole, same = (adp.IntegralWindows(model, 0.25, first=first) for first in (None, 0.25))
    states, ready = uniform(9, 2, seed=1), []
    for windows in (whole, same):
        now = windows.init(states[0])
        ready.append([])
        for x in states:
            now, equation = windows.step(now, x, 0.125)
            now = windows.holding(now, 0 * x[:1])
            ready[-1].append(bool(equation.ready))
    assert ready[0] == ready[1] == [False] + [False, True] * 4
    with pytest.raises(ValueError, match="first"):
        adp.IntegralWindows(model, 0.25, first=0.2500001)


def test_a_probe_turns_first_a_little_before_its_half_period() -> None:
    stub: Any = SimpleNamespace(
        windows=SimpleNamespace(length=0.5), model=SimpleNamespace(inputs=2), probe=0.3
    )
    for j in range(2):
        turn = 0.5 * (2 + j) * (1 - 0.1 / math.pi)  # of a sine that begins at 0.1
        time = tensor(
            [0.0, 0.999 * turn, 1.001 * turn, 0.999 * (turn + 0.5 * (2 + j)), 1.001 * (turn + 0.5 * (2 + j))]
        )
        found = adp.AdaptiveLQR._probing(stub, time)[:, j]
        assert found.tolist() == [0.3, 0.3, -0.3, -0.3, 0.3]
