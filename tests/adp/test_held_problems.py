"""Problems in steps and loops that are held: edges, derivatives and regulators, beside plain formulas."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from recorded import Record
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp import plan_problem, sampled_problem
from staf_torch.adp.plans import LocalModel
from staf_torch.adp.sampling import held_riccati, linear_hold, periods
from staf_torch.adp.simulation import warn_if_unstable
from staf_torch.numerics.forward_mode import use_forward_mode

INF = math.inf
use_forward_mode()


def swung(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    turned = x[..., 1] + 0.3 * x[..., 0].sin() + 0.2 * u[..., 0] * x[..., 2].cos()
    after = torch.stack((x[..., 0] + 0.1 * turned, turned, 0.9 * x[..., 2] + u[..., 1] * u[..., 0]), dim=-1)
    return after, x.square().sum(-1) + u.square().sum(-1) + (x[..., 0] * u[..., 1]).square() + x[
        ..., 2
    ] ** 3 * u[..., 0] ** 2


SWUNG = adp.SampledProblem(swung, dim=3, inputs=2, low=[-1.0, -INF], high=[INF, 2.0], periodic=[-3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_derivatives_of_a_program_and_of_plain_torch_are_the_same(dtype: torch.dtype) -> None:
    """Of values that are straight and constant, too, and beside a row that is no number."""

    def values(z: Tensor) -> Tensor:
        a, b, c = z.unbind(-1)
        return torch.stack((a.sin() * b / (2 + c.square()), 3 * b - a, torch.full_like(a, 2.0), c**3), dim=-1)

    z = uniform(4, 3, seed=3).to(dtype)
    z[2, 1] = torch.nan
    ways = (sampled_problem._in_pairs, sampled_problem._backwards)
    (first, second), (same, bent) = (way(values, z, 4) for way in ways)
    assert first.dtype == same.dtype == dtype
    assert (first.shape, second.shape) == (same.shape, bent.shape) == ((4, 4, 3), (4, 4, 3, 3))
    torch.testing.assert_close(same[[0, 1, 3]], first[[0, 1, 3]])
    torch.testing.assert_close(bent[[0, 1, 3]], second[[0, 1, 3]])
    value, slope = plan_problem._along(values, z)
    torch.testing.assert_close(value, values(z), equal_nan=True)
    torch.testing.assert_close(slope, same, equal_nan=True)


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
    assert (SWUNG.endless, SWUNG.tick) == (True, 0.0)
    assert torch.equal(SWUNG.end, SWUNG.p)


@pytest.mark.parametrize(
    ("drift", "due", "refused"),
    [
        (3.9e-6, 0.0, False), (4.1e-6, 0.0, True), (-4.1e-6, 0.0, True),
        (0.0, 0.9e-6, False), (0.0, 1.1e-6, True), (0.0, -1.1e-6, True), (9e-6, 9e-6, True),
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

    if refused:
        with pytest.raises(
            ValueError, match="must be a state of rest at no cost; within one step it moves by"
        ):
            make()
    else:
        assert make().goal.tolist() == [3.0]


@pytest.mark.parametrize("after", [lambda x: x, lambda x: x[:, :1]])
@pytest.mark.parametrize("paid", [lambda u: u[:, 0] ** 2, lambda u: u**2])
def test_a_step_of_either_wrong_shape_is_refused(after: Any, paid: Any) -> None:
    if after(torch.zeros(2, 2)).shape[1] == 2 and paid(torch.zeros(2, 1)).dim() == 1:
        return
    with pytest.raises(
        ValueError, match=r"must map x \(2, 2\) and u \(2, 1\) to x\+ \(2, 2\) and costs \(2,\)"
    ):
        adp.SampledProblem(lambda x, u: (after(x), paid(u)), dim=2, inputs=1)


def test_arguments_of_a_problem_break_their_rule_by_name() -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return 0.5 * x + u, x.square().sum(-1) + u.square().sum(-1)

    whole: dict[str, Any] = {"dim": 2, "inputs": 2}
    for given, message in (
        ({"periodic": [2]}, r"periodic=...\)` must be coordinates of 2; got \[2\]"),
        ({"periodic": [-3]}, r"periodic=...\)` must be coordinates of 2"),
        ({"rest": tensor([0.0, 1.0]), "high": 1.0}, r"rest=...\)` must lie between the bounds"),
        ({"rest": tensor([0.0, -1.0]), "low": -1.0}, r"rest=...\)` must lie between the bounds"),
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
    problem = adp.SampledProblem.of(Leaning(), cost, dt=0.2)
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


# Held loops --------------------------------------------------------------------------------------------

CHAIN = systems.Linear([[0.0, 1.0], [3.0, -0.5]], [[0.0], [1.0]])


def in_steps(a: Tensor, b: Tensor, dt: float = 0.1) -> systems.StepPlant:
    return systems.StepPlant(
        lambda x, u: x @ a.mT + u @ b.mT, dim=len(a), inputs=b.shape[1], dt=dt, equilibrium=[0.0] * len(a)
    )


@pytest.mark.parametrize("discount", [0.0, 0.7])
@pytest.mark.parametrize("steps", [False, True])
def test_a_held_regulator_is_the_fixed_point_of_its_recursion(steps: bool, discount: float) -> None:
    plant: systems.Plant = (
        in_steps(tensor([[1.0, 0.1], [0.3, 0.95]]), tensor([[0.0], [0.1]])) if steps else CHAIN
    )
    cost = adp.QuadraticCost([2.0, 1.0], 0.3, 2, 1, discount=discount)
    p, k = held_riccati(plant, cost, 0.3)
    hold = linear_hold(plant, cost, 0.3)
    closed = torch.cat((torch.eye(2).double(), -k))
    ahead = hold.a - hold.b @ k
    torch.testing.assert_close(p, closed.mT @ hold.paid @ closed + ahead.mT @ p @ ahead)
    for other in (k + 1e-3 * tensor([[1.0, 0.0]]), k - 1e-3 * tensor([[0.0, 1.0]])):  # and K the best
        around = torch.cat((torch.eye(2).double(), -other))
        after = hold.a - hold.b @ other
        worse = around.mT @ hold.paid @ around + after.mT @ p @ after - p
        assert float(torch.linalg.eigvalsh(worse)[-1]) > 0
        assert float(torch.linalg.eigvalsh(worse)[0]) > -1e-12
    assert torch.equal(p, p.mT)


@pytest.mark.parametrize("steps", [False, True])
def test_a_mode_that_grows_slower_than_the_discount_need_not_be_stabilised(steps: bool) -> None:
    """exp(-rho t / 2) x decays: 0.2 1/s beside a half of the discount."""
    growth = math.exp(0.02) if steps else 0.2
    f, g = tensor([[growth, 0.0], [0.0, 0.5 if steps else -1.0]]), tensor([[0.0], [1.0]])
    plant: systems.Plant = in_steps(f, g) if steps else systems.Linear(f.tolist(), g.tolist())
    p, _ = held_riccati(plant, adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.5), 0.1)
    assert bool(torch.isfinite(p).all())
    with pytest.raises(ValueError, match="not stabilisable"):
        held_riccati(plant, adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.3), 0.1)


def test_a_period_is_a_multiple_to_a_billionth() -> None:
    plant = in_steps(tensor([[1.0]]), tensor([[1.0]]), 0.5)
    assert periods("call", plant, 1.5 * (1 + 0.9e-9)) == 3
    assert periods("call", plant, 1.5 * (1 - 0.9e-9)) == 3
    for dt in (1.5 * (1 + 1.2e-9), 1.5 * (1 - 1.2e-9), 0.2):
        with pytest.raises(
            ValueError, match=r"`call\(dt=...\)` must be a multiple of the plant's period of 0.5 s"
        ):
            periods("call", plant, dt)


def test_a_loop_in_steps_is_stable_up_to_a_number_of_its_periods() -> None:
    """Whatever the period is that it is asked for."""
    plant = in_steps(tensor([[1.0]]), tensor([[0.1]]))
    for period in (0.1, 0.3, 0.6, 0.7, 2.0):
        wanted = pytest.approx(abs(1 - 3 * period)), pytest.approx(0.6)
        assert adp.held_stability(lambda x: -3 * x, plant, period) == wanted
    assert adp.held_stability(lambda x: -2 / 99.95 * x, plant, 0.1).largest_period == pytest.approx(99.9)
    assert adp.held_stability(lambda x: -2 / 100.05 * x, plant, 0.1).largest_period == INF  # of 1000 tried
    assert adp.held_stability(lambda x: 3 * x, plant, 0.1) == (pytest.approx(1.3), None)
    assert adp.held_stability(lambda x: 0 * x, plant, 0.1) == (1.0, None)


def test_others_beside_a_loop_in_steps_count_only_where_they_grow() -> None:
    for other, counted in ((1.0, False), (-1.0, False), (-1.2, True), (1.2, True)):
        plant = in_steps(tensor([[1.0, 0.3], [0.0, other]]), tensor([[0.1], [0.0]]))
        found = adp.held_stability(lambda x: -3 * x[..., :1], plant, 0.1).spectral_radius
        assert found == pytest.approx(abs(other) if counted else 0.7)


def test_a_period_of_a_billion_steps_is_answered_at_once() -> None:
    plant = in_steps(tensor([[0.5, 0.1], [0.0, 0.4]]), tensor([[0.1], [0.2]]))
    found = adp.held_stability(lambda x: 0.3 * x[..., :1], plant, 1e8)
    rest = torch.linalg.solve(
        torch.eye(2).double() - tensor([[0.5, 0.1], [0.0, 0.4]]), tensor([[0.1], [0.2]])
    )
    assert found.spectral_radius == pytest.approx(0.3 * float(rest[0]))


@pytest.mark.parametrize("period", [1.0, 1000.0, 1e5])
def test_a_loop_that_overflows_within_a_period_is_unstable_and_told(
    period: float, caplog: pytest.LogCaptureFixture
) -> None:
    plant, stepped = systems.Linear([[1000.0]], [[1.0]]), in_steps(tensor([[1.5e4]]), tensor([[1.0]]))
    for each, gain in ((plant, -1001.0), (stepped, -1.5e4)):
        assert adp.held_stability(lambda x, gain=gain: gain * x, each, period).spectral_radius > 1
    assert adp.held_stability(lambda x: -1001 * x, plant, period).spectral_radius == INF
    cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    warn_if_unstable(lambda x: -1001 * x, plant, cost, period)
    assert "has the spectral radius inf" in caplog.text


def test_a_period_that_is_shorter_than_all_that_are_tried_is_found() -> None:
    """x' = 1000 x + u under u = -1001 x: held for T, e^{1000 T} < 2001."""
    plant = systems.Linear([[1000.0]], [[1.0]])
    found = adp.held_stability(lambda x: -1001 * x, plant, 1e-3).largest_period
    assert found == pytest.approx(math.log(2001) / 1000, rel=1e-5)


def test_a_loop_at_its_edge_and_one_without_a_slope_are_not_said_to_be_stable() -> None:
    line = systems.Linear([[0.0]], [[1.0]])
    assert adp.held_stability(lambda x: 0 * x, line, 0.5) == (1.0, None)
    broken = adp.held_stability(lambda x: math.nan * x, line, 0.5)
    assert math.isnan(broken.spectral_radius)
    assert broken.largest_period is None
    for period in (0.0, -0.5, math.inf):
        with pytest.raises(ValueError, match=r"`held_stability\(period=...\)` must be (positive|finite)"):
            adp.held_stability(lambda x: 0 * x, line, period)


def test_the_largest_period_is_found_to_a_millionth_and_is_the_recorded(record: Record) -> None:
    """The steps of the bisection are what is recorded: they end a little below the true ones."""
    found = {}
    for name, a, b, gain in (
        ("line", [[0.0]], [[1.0]], [[1.0]]),
        ("steep line", [[0.0]], [[1.0]], [[40.0]]),
        ("chain", [[0.0, 1.0], [3.0, -0.5]], [[0.0], [1.0]], [[9.0, 4.0]]),
    ):
        k = tensor(gain)
        plant = systems.Linear(a, b)
        found[name] = adp.held_stability(lambda x, k=k: -(x @ k.mT), plant, 0.1).largest_period
    assert found["line"] is not None
    assert 2.0 * (1 - 1e-6) <= found["line"] < 2.0
    record({name: tensor([value] * 5).cumsum(0) for name, value in found.items()}, rtol=1e-9)
    slow = systems.Linear([[-1.0]], [[1.0]])
    assert adp.held_stability(lambda x: 0.5 * x, slow, 0.1).largest_period == INF
