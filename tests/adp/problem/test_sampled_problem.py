"""Problems in steps: of a function, of a plant and a cost, with their derivatives and regulators."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, lanes, systems
from staf_torch.numerics.derivatives import use_forward_mode

INF = math.inf
use_forward_mode()


def swung(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    turned = x[..., 1] + 0.3 * x[..., 0].sin() + 0.2 * u[..., 0] * x[..., 2].cos()
    after = torch.stack((x[..., 0] + 0.1 * turned, turned, 0.9 * x[..., 2] + u[..., 1] * u[..., 0]), dim=-1)
    return after, x.square().sum(-1) + u.square().sum(-1) + (x[..., 0] * u[..., 1]).square() + x[
        ..., 2
    ] ** 3 * u[..., 0] ** 2


SWUNG = adp.SampledProblem(swung, dim=3, inputs=2, low=[-1.0, -INF], high=[INF, 2.0], periodic=[-3])


@pytest.mark.needs_compiler
def test_derivatives_in_a_program_are_those_of_plain_torch() -> None:
    """Forward along pairs of coordinates there, backwards here; beside a row that is no number, too."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return x + 0.1 * (x * u).sin(), (x.square() * u + u**4 + x.cos())[..., 0]

    problem = adp.SampledProblem(step, dim=1, inputs=1, terminal=0.0)
    x, u = uniform(4, 1, seed=3), uniform(4, 1, seed=4)
    x[2] = torch.nan
    program = lanes.Program(lambda carry, now, row: (carry, tuple(problem.derivatives(*row))))
    _, found = program((), (), (x, u), steps=1)
    for mine, wanted in zip(found, problem.derivatives(x, u), strict=True):
        torch.testing.assert_close(mine[[0, 1, 3], 0], wanted[[0, 1, 3]])


def test_derivatives_of_a_step_are_those_of_its_row() -> None:
    x, u = uniform(3, 3, seed=1), uniform(3, 2, seed=2)
    found = SWUNG.derivatives(x, u)
    for row in range(3):
        z = torch.cat((x[row], u[row]))
        for part, first, second in ((0, found.first, found.second), (1, found.cost_first, found.cost_second)):
            function = lambda z, part=part: swung(z[None, :3], z[None, 3:])[part][0]  # noqa: E731
            torch.testing.assert_close(first[row], torch.func.jacrev(function)(z))
            torch.testing.assert_close(second[row], torch.func.jacrev(torch.func.jacrev(function))(z))
    assert [tuple(part.shape) for part in found] == [(3, 3, 5), (3, 3, 5, 5), (3, 5), (3, 5, 5)]


def test_levels_are_all_combinations_of_finite_bounds_and_rest() -> None:
    assert SWUNG.levels().tolist() == [[-1.0, 0.0], [-1.0, 2.0], [0.0, 0.0], [0.0, 2.0]]
    free = adp.SampledProblem(lambda x, u: (0.5 * x + u, x[..., 0] ** 2 + u[..., 0] ** 2), dim=1, inputs=1)
    assert free.levels().tolist() == [[0.0]]
    assert SWUNG.periodic == (0,)
    x, u = uniform(2, 4, 3, seed=1), uniform(2, 4, 2, seed=2)
    away = torch.cat((x[..., :1] + 4 * math.pi, x[..., 1:]), dim=-1)
    torch.testing.assert_close(SWUNG.away(away), x)
    torch.testing.assert_close(SWUNG.terminal(away), ((x @ SWUNG.p) * x).sum(-1))
    wanted = torch.minimum(torch.maximum(-x @ SWUNG.k.mT, SWUNG.bounds.low), SWUNG.bounds.high)
    torch.testing.assert_close(SWUNG.linear_feedback(away), wanted)
    more = torch.minimum(torch.maximum(wanted + u, SWUNG.bounds.low), SWUNG.bounds.high)
    torch.testing.assert_close(SWUNG.steered(away, u), more)


@pytest.mark.parametrize(
    ("step", "given", "said"),
    [
        (lambda x, u: (x + 1, u[:, 0] ** 2), {}, "within one step it moves by 1 and costs 0"),
        (lambda x, u: (2 * x, u[:, 0] ** 2 + x[:, 0] ** 2), {}, "no input reaches .* the eigenvalue 2"),
        (lambda x, u: (x + u, u[:, 0] ** 2 - x[:, 0]), {}, r"its cost has a slope there, \[-1.0, 0.0\]"),
        (lambda x, u: (x + u.abs(), (x**2 + u**2)[:, 0]), {}, "no input reaches"),
        (lambda x, u: (x + u - 2, (x + u - 2)[:, 0] ** 2), {"rest": tensor([2.0]), "high": 1.0}, "bounds"),
    ],
)  # fmt: skip
def test_a_problem_without_a_regulator_says_why_and_ends_at_no_cost(
    step: Any, given: dict[str, Any], said: str, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("WARNING"):
        made = adp.SampledProblem(step, dim=1, inputs=1, **given)
    assert re.search(said, made.unregulated)
    assert "Give `terminal`" in caplog.text
    assert not torch.cat((made.p, made.k)).any()
    assert not made.terminal(tensor([[3.0]])).any()
    caplog.clear()
    with caplog.at_level("WARNING"):
        ended = adp.SampledProblem(step, dim=1, inputs=1, terminal=2.0, **given)
    assert caplog.text == ""
    assert float(ended.terminal(tensor([[3.0]]))) == 18.0


def leaning(x: Tensor, u: Tensor) -> Tensor:
    """A rod that is held aside of upright."""
    return torch.stack((x[..., 1], 2.0 * x[..., 0].sin() - 0.3 * x[..., 1] + 1.5 * u[..., 0]), dim=-1)


LEANING = systems.RatePlant(leaning, dim=2, inputs=1, periodic=[0])


def test_a_problem_of_a_plant_has_its_rest_its_bounds_and_its_runge_kutta_step() -> None:
    cost = adp.QuadraticCost([2.0, 0.5], 0.7, 2, 1, target=[0.4, 0.0], low=-5.0, high=4.0)
    problem = adp.SampledProblem.of(LEANING, cost, dt=0.2, substeps=1)
    assert problem.goal.tolist() == [0.4, 0.0]
    assert problem.rest.tolist() == pytest.approx([-2.0 * math.sin(0.4) / 1.5])
    assert (problem.bounds.low.tolist(), problem.bounds.high.tolist()) == ([-5.0], [4.0])
    assert problem.periodic == (0,)
    x, u = uniform(3, 2, seed=1), uniform(3, 1, seed=2)

    def rates(x: Tensor) -> Tensor:
        d = x - tensor([0.4, 0.0])
        due = 2 * d[:, 0] ** 2 + 0.5 * d[:, 1] ** 2 + 0.7 * (u[:, 0] + 2.0 * math.sin(0.4) / 1.5) ** 2
        return torch.cat((leaning(x, u), due[:, None]), dim=1)

    a = rates(x)
    b = rates(x + 0.1 * a[:, :2])
    c = rates(x + 0.1 * b[:, :2])
    d = rates(x + 0.2 * c[:, :2])
    mean = 0.2 * (a / 6 + b / 3 + c / 3 + d / 6)
    after, paid = problem.advance(x, u)
    torch.testing.assert_close(after, x + mean[:, :2])
    torch.testing.assert_close(paid, mean[:, 2])
    other = adp.SampledProblem.of(LEANING, cost, dt=0.2, low=-3.0)
    assert (other.bounds.low.tolist(), other.bounds.high.tolist()) == ([-3.0], [INF])
    ended = adp.QuadraticCost(1.0, 1.0, 2, 1, terminal=2.0)
    assert torch.equal(adp.SampledProblem.of(LEANING, ended, dt=0.2).end, 2 * torch.eye(2).double())
    plant = systems.StepPlant(lambda x, u: 0.9 * x + 0.1 * u, dim=1, inputs=1, dt=0.5)
    line = adp.QuadraticCost(1.0, 1.0, 1, 1)
    assert (
        float(adp.SampledProblem.of(plant, line, dt=0.5).advance(tensor([[2.0]]), tensor([[1.0]]))[1]) == 2.5
    )


def clocked(tick: float) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """One state and the time, which moves by a tick."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        after = torch.cat((0.9 * x[..., :1] + 0.1 * u, x[..., 1:] + tick), dim=-1)
        return after, 0.1 * (x[..., 0].square() + u.square().sum(-1))

    return step


def test_angles_are_among_the_states() -> None:
    with pytest.raises(ValueError, match=r"periodic=...\)` must be coordinates of 3; got \[-4\]"):
        adp.SampledProblem(swung, dim=3, inputs=2, periodic=[-4])


def test_a_path_needs_a_time_that_moves() -> None:
    def path(t: Tensor) -> Tensor:
        return 0 * t.unsqueeze(-1)

    made = adp.SampledProblem(clocked(0.25), dim=2, inputs=1, path=path)
    assert made.tick == 0.25
    assert made.goals(tensor([[0.3, 2.0]]), 2)[0].tolist() == [[0.0, 2.0], [0.0, 2.25], [0.0, 2.5]]
    for tick in (0.0, -0.25):
        with pytest.raises(ValueError, match="must move the time"):
            adp.SampledProblem(clocked(tick), dim=2, inputs=1, path=path)


def test_problem_of_a_plant_and_a_cost_pays_what_the_simulation_pays() -> None:
    plant = systems.Pendulum()
    cost = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1, low=-3.0, high=5.0)
    problem = adp.SampledProblem.of(plant, cost, dt=0.05)
    x = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    run = adp.simulate(adp.Feedback(problem.linear_feedback), plant, cost, x, dt=0.05, steps=20)
    spent = torch.zeros(1, dtype=torch.float64)
    for _ in range(20):
        x, paid = problem.advance(x, problem.linear_feedback(x))
        spent = spent + paid
    torch.testing.assert_close(run.cost, spent, rtol=1e-12, atol=0)
    torch.testing.assert_close(run.state[:, -1], x, rtol=1e-12, atol=1e-14)
