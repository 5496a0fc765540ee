"""Problems in steps: of a function, of a plant and a cost, with their derivatives and regulators."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_swingup import double_integrator
from torch import Tensor

from staf_torch import adp, lanes, systems
from staf_torch.adp.planning.trajectories import LocalModel
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
    x, u = uniform(4, 3, seed=3), uniform(4, 2, seed=4)
    x[2, 1] = torch.nan
    program = lanes.Program(lambda carry, now, row: (carry, tuple(SWUNG.derivatives(*row))))
    _, found = program((), (), (x, u), steps=1)
    for mine, wanted in zip(found, SWUNG.derivatives(x, u), strict=True):
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
    after, paid = SWUNG.advance(x, u)
    for mine, plain in zip((after, paid), swung(x, u), strict=True):
        torch.testing.assert_close(mine, plain)
    away = torch.cat((x[..., :1] + 4 * math.pi, x[..., 1:]), dim=-1)
    torch.testing.assert_close(SWUNG.away(away), x)
    torch.testing.assert_close(SWUNG.terminal(away), ((x @ SWUNG.p) * x).sum(-1))
    wanted = torch.minimum(torch.maximum(-x @ SWUNG.k.mT, SWUNG.bounds.low), SWUNG.bounds.high)
    torch.testing.assert_close(SWUNG.linear_feedback(away), wanted)
    more = torch.minimum(torch.maximum(wanted + u, SWUNG.bounds.low), SWUNG.bounds.high)
    torch.testing.assert_close(SWUNG.steered(away, u), more)
    goals = SWUNG.goals(away[0], 2)
    assert goals.shape == (4, 3, 3)
    torch.testing.assert_close(goals, tensor([4 * math.pi, 0.0, 0.0]).expand(4, 3, 3))
    assert torch.equal(SWUNG.end, SWUNG.p)


@pytest.mark.parametrize(
    ("drift", "due", "refused"),
    [
        (3.9e-6, 0.0, False), (-4.1e-6, 0.0, True), (0.0, 0.9e-6, False), (0.0, -1.1e-6, True),
    ],
)  # fmt: skip
def test_a_goal_may_move_by_a_millionth_of_its_size_and_cost_a_millionth(
    drift: float, due: float, refused: bool
) -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        d = x[..., 0] - 3.0
        return x + u - 0.1 * d.unsqueeze(-1) + drift, d.square() + u[..., 0].square() + due

    def make() -> adp.SampledProblem:
        return adp.SampledProblem(step, dim=1, inputs=1, goal=tensor([3.0]))

    said = "the goal is no state of rest at no cost: within one step it moves by"
    assert make().unregulated.startswith(said) == refused
    assert bool(make().k.any()) != refused


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


def test_a_step_of_either_wrong_shape_is_refused() -> None:
    for step, said in (
        (
            lambda x, u: (x[:, :1], x.sum(-1)),
            r"x\+, .*\[0\]` must map rows \(5, 2\), \(5, 1\) .*; got \(5, 1\)",
        ),
        (lambda x, u: (x, u**2), r"costs, .*\[1\]` must .* to \(5,\), .*; got \(5, 1\)"),
        (lambda x, u: (x, 0.0), r"costs, .* to \(5,\), .*, as a tensor; got 0.0"),
    ):
        with pytest.raises(ValueError, match=said):
            adp.SampledProblem(step, dim=2, inputs=1)


def test_arguments_of_a_problem_break_their_rule_by_name() -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return 0.5 * x + u, x.square().sum(-1) + u.square().sum(-1)

    whole: dict[str, Any] = {"dim": 2, "inputs": 2}
    for given, message in (
        ({"periodic": [2]}, r"periodic=...\)` must be coordinates of 2; got \[2\]"),
        ({"periodic": [-3]}, r"periodic=...\)` must be coordinates of 2"),
        ({"goal": tensor([0.0])}, r"goal=...\)` must have 2 entries"),
        ({"dim": 0}, r"dim=...\)` must be at least 1"),
        ({"inputs": 0}, r"inputs=...\)` must be at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            adp.SampledProblem(step, **{**whole, **given})
    assert adp.SampledProblem(step, **whole, periodic=[1, -1, -2]).periodic == (0, 1)
    made = adp.SampledProblem(step, **whole, terminal=torch.eye(2))
    assert not made.endless
    assert made.end.dtype == made.goal.dtype == made.rest.dtype == torch.float64
    assert torch.equal(made.end, torch.eye(2).double())


class Leaning(systems.ControlAffineSystem):
    """A rod that is held aside of upright."""

    dim, inputs, periodic = 2, 1, (0,)

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 2.0 * x[..., 0].sin() - 0.3 * x[..., 1]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return tensor([[0.0], [1.5]]).to(x).expand(*x.shape, 1)


def test_a_problem_of_a_plant_has_its_rest_its_bounds_and_its_runge_kutta_step() -> None:
    cost = adp.QuadraticCost([2.0, 0.5], 0.7, 2, 1, target=[0.4, 0.0], low=-5.0, high=4.0)
    problem = adp.SampledProblem.of(Leaning(), cost, dt=0.2, substeps=1)
    assert problem.goal.tolist() == [0.4, 0.0]
    assert problem.rest.tolist() == pytest.approx([-2.0 * math.sin(0.4) / 1.5])
    assert (problem.bounds.low.tolist(), problem.bounds.high.tolist()) == ([-5.0], [4.0])
    assert (problem.periodic, problem.path, problem.endless) == ((0,), None, True)
    x, u = uniform(3, 2, seed=1), uniform(3, 1, seed=2)

    def rates(x: Tensor) -> Tensor:
        d = x - tensor([0.4, 0.0])
        due = 2 * d[:, 0] ** 2 + 0.5 * d[:, 1] ** 2 + 0.7 * (u[:, 0] + 2.0 * math.sin(0.4) / 1.5) ** 2
        moved = torch.stack((x[:, 1], 2 * x[:, 0].sin() - 0.3 * x[:, 1] + 1.5 * u[:, 0]), dim=1)
        return torch.cat((moved, due[:, None]), dim=1)

    a = rates(x)
    b = rates(x + 0.1 * a[:, :2])
    c = rates(x + 0.1 * b[:, :2])
    d = rates(x + 0.2 * c[:, :2])
    mean = 0.2 * (a / 6 + b / 3 + c / 3 + d / 6)
    after, paid = problem.advance(x, u)
    torch.testing.assert_close(after, x + mean[:, :2])
    torch.testing.assert_close(paid, mean[:, 2])
    other = adp.SampledProblem.of(Leaning(), cost, dt=0.2, low=-3.0)
    assert (other.bounds.low.tolist(), other.bounds.high.tolist()) == ([-3.0], [INF])
    ended = adp.QuadraticCost(1.0, 1.0, 2, 1, terminal=2.0)
    assert torch.equal(adp.SampledProblem.of(Leaning(), ended, dt=0.2).end, 2 * torch.eye(2).double())
    with pytest.raises(ValueError, match=r"`SampledProblem.of\(cost=...\)` must have no discount; got 0.1"):
        adp.SampledProblem.of(Leaning(), adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.1), dt=0.2)
    plant = systems.StepPlant(lambda x, u: 0.9 * x + 0.1 * u, dim=1, inputs=1, dt=0.5)
    line = adp.QuadraticCost(1.0, 1.0, 1, 1)
    assert (
        float(adp.SampledProblem.of(plant, line, dt=0.5).advance(tensor([[2.0]]), tensor([[1.0]]))[1]) == 2.5
    )
    with pytest.raises(
        ValueError, match=r"`SampledProblem.of\(dt=...\)` must be the plant's period, 0.5 s; got 0.4"
    ):
        adp.SampledProblem.of(plant, line, dt=0.4)


def test_a_local_model_is_a_quadratic_function_the_shorter_way_around() -> None:
    model = LocalModel(
        uniform(2, 3, seed=1), uniform(2, seed=2), uniform(2, 3, seed=3), uniform(2, 3, 3, seed=4)
    )
    x = uniform(2, 5, 3, seed=5)
    d = x - model.state[:, None]
    bent = torch.einsum("bli,bij,blj->bl", d, model.curvature, d)
    wanted = model.value[:, None] + (d * model.gradient[:, None]).sum(-1) + 0.5 * bent
    turned = x + tensor([2 * math.pi, 0.0, 0.0])
    torch.testing.assert_close(model.at(SWUNG, turned), wanted)
    slope = model.gradient + (model.curvature @ d[:, 0].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(model.slope(SWUNG, turned[:, 0]), slope)


def clocked(tick: float) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """One state and the time, which moves by a tick."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        after = torch.cat((0.9 * x[..., :1] + 0.1 * u, x[..., 1:] + tick), dim=-1)
        return after, 0.1 * (x[..., 0].square() + u.square().sum(-1))

    return step


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


def cart(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)


def test_plant_in_steps_pays_its_period_times_the_rate() -> None:
    plant = systems.StepPlant(cart, dim=2, inputs=1, dt=0.1, low=-1.0, high=1.0)
    problem = adp.SampledProblem.of(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
    x, u = tensor([[5.0, 0.0], [-1.0, 2.0]]), tensor([[0.5], [-1.0]])
    for mine, known in zip(problem.advance(x, u), double_integrator(-1.0, 1.0).advance(x, u), strict=True):
        torch.testing.assert_close(mine, known)
    torch.testing.assert_close(problem.p, double_integrator(-1.0, 1.0).p)
    assert problem.bounds.high.tolist() == [1.0]
