"""Methods beside those of others: the plants, what each method is asked, and what the table says."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from helpers_experiments import ran
from torch import Tensor

from staf_torch.experiments import rival_methods, rivals
from staf_torch.experiments.rival_methods import (
    METHODS,
    Begin,
    Rival,
    UnsuitableError,
    ipopt_program,
)
from staf_torch.experiments.rival_plants import CASES, RivalPlant, TorchMath

SHORT = dataclasses.replace(CASES["double_integrator"], steps=60, horizon=20)


def constant(value: float) -> Callable[[RivalPlant], Begin]:
    """A method that always wants the same input."""

    def prepare(case: RivalPlant) -> Begin:
        """Two lines of code, without this one."""
        return lambda x0: lambda x: torch.full((len(x), case.inputs), value, dtype=x.dtype)

    return prepare


def test_rows_say_what_was_lost_violated_and_not_tried() -> None:
    methods = [
        METHODS["discrete LQR"],
        METHODS["GlobalValue"],
        Rival("idle", constant(0.0)),
        Rival("shouting", constant(3.0)),
        Rival("absent", constant(0.0), ("no-such-package",)),
    ]
    rows = rivals.compare(SHORT, methods, tensor([[0.5, 0.0]]), calls=3)
    assert [row[0] for row in rows] == [method.name for method in methods]
    best, unsuited, lost, loud, absent = (measured | more for _, measured, more in rows)
    assert (best["regulated"], best["violations"]) == (1, 0)
    assert 1 - 1e-9 <= best["ratio_median"] <= best["ratio_max"] < 1.1
    assert (unsuited["ratio_median"], unsuited["note"]) == (None, "the LQR reaches the goal")
    assert (lost["regulated"], lost["ratio_median"]) == (0, None)
    assert loud["violations"] == pytest.approx(1)
    assert absent["note"] == "no-such-package is not installed"
    assert (absent["regulated"], absent["megabytes"]) == (None, None)
    assert (lost["lines"], lost["megabytes"], best["us_median"] > 0) == (2, 0, True)
    assert best["megabytes"] > 10  # of SciPy


def test_slow_methods_run_from_fewer_states_and_say_so() -> None:
    def timid(case: RivalPlant) -> Begin:
        steer = rival_methods.discrete_lqr(case)(tensor([]))
        return lambda x0: lambda x: torch.where(x[:, :1].abs() > 1, 0.3, 1.0) * steer(x)

    methods = [Rival("fast", timid), Rival("slow", timid, slow=True)]
    (_, every, _), (_, few, told) = rivals.compare(
        SHORT, methods, tensor([[0.5, 0.0], [1.2, 0.0]]), calls=3, slow=1
    )
    assert told["note"] == "from 1 of the 2 states"
    assert every["ratio_max"] > 1.001  # it has seen the last one
    assert few["ratio_max"] == pytest.approx(1)


def test_the_best_known_cost_is_no_method_s_and_never_above_one() -> None:
    case = dataclasses.replace(SHORT, steps=20, horizon=10)
    problem, x0 = case.problem(), tensor([[2.0, 0.0], [-3.0, 0.5]])
    good = rivals.play(problem, rival_methods.discrete_lqr(case), x0, case.steps)
    first = rivals.play(problem, constant(1.0)(case), x0[:1], case.steps)
    claimed = dataclasses.replace(first, cost=0.5 * good.cost[:1])  # whatever was reached is known
    best = rivals.best_known(case, problem, x0, [good, first, claimed])
    assert bool((best <= good.cost).all())
    assert float(best[0]) == float(claimed.cost)


def test_an_episode_pays_for_what_the_bounds_left_of_the_controls() -> None:
    problem, x0 = SHORT.problem(), tensor([[0.5, 0.0], [1.0, -1.0]])
    high = float(problem.bounds.high)
    wanted = iter([0.5, high + 1e-7, high + 1e-3, -5.0])  # within, rounding beyond, and twice beyond
    episode = rivals.play(problem, lambda x0: lambda x: torch.full((2, 1), next(wanted)).double(), x0, 4)
    assert episode.outside == pytest.approx(0.5)
    assert episode.control[0, :, 0].tolist() == [0.5, high, high, -1.0]
    x, spent = x0, torch.zeros(2).double()
    for control in episode.control.unbind(1):
        x, paid = problem.advance(x, control)
        spent = spent + paid
    torch.testing.assert_close(episode.cost, spent + problem.terminal(x))
    lost = rivals.play(problem, constant(0.0)(SHORT), tensor([[math.nan, 0.0], [0.1, 0.0]]), 2)
    assert lost.cost.isinf().tolist() == [True, False]


def test_a_plant_that_a_method_is_not_made_for_is_refused() -> None:
    with pytest.raises(UnsuitableError, match="needs a plant in continuous time"):
        METHODS["LQR"].prepare(CASES["pendulum"])
    with pytest.raises(UnsuitableError, match="follows no path"):
        METHODS["near_optimal"].prepare(CASES["figure_eight"])


def energy(name: str, x: Tensor) -> Tensor:
    """Kinetic and potential energy of a plant, from its masses and lengths alone, in J."""
    if name == "quadrotor":
        return 0.5 * x[..., 3:5].square().sum(-1) + 0.5 * 0.1 * x[..., 5] ** 2 + 9.81 * x[..., 1]
    if name == "figure_eight":
        return 0.027 * (0.5 * (x[..., 1] ** 2 + x[..., 3] ** 2) + 9.81 * x[..., 2]) + 0.7e-5 * x[..., 5] ** 2
    swing, sine, cosine = x[..., 3], x[..., 1].sin(), x[..., 1].cos()
    across, up = x[..., 2] + 0.5 * swing * cosine, -0.5 * swing * sine  # of the middle of the pole
    turning = 0.5 * (0.1 * 1.0**2 / 12) * swing**2  # of a rod of a metre
    return 0.5 * x[..., 2] ** 2 + 0.5 * 0.1 * (across**2 + up**2) + turning + 0.1 * 9.8 * 0.5 * cosine


@pytest.mark.parametrize("name", ["cart_pole_10N", "quadrotor", "figure_eight"])
def test_the_energy_of_a_plant_grows_at_the_power_of_its_inputs(name: str) -> None:
    case = CASES[name]
    generator = torch.Generator().manual_seed(1)
    x = torch.rand(50, case.dim, generator=generator, dtype=torch.float64, requires_grad=True)
    u = torch.rand(50, case.inputs, generator=generator, dtype=torch.float64)
    (slope,) = torch.autograd.grad(energy(name, x).sum(), x)
    rate = torch.stack(tuple(case.equations(TorchMath, x.unbind(-1), u.unbind(-1))), -1)
    along = {
        "cart_pole_10N": lambda: u[:, 0] * x[:, 2],
        "quadrotor": lambda: (
            (9.81 + u[:, 0]) * (x[:, 4] * x[:, 2].cos() - x[:, 3] * x[:, 2].sin()) + u[:, 1] * x[:, 5]
        ),
        "figure_eight": lambda: (
            u.sum(-1) * (x[:, 1] * x[:, 4].sin() + x[:, 3] * x[:, 4].cos())
            + 0.0397 / math.sqrt(2) * (u[:, 1] - u[:, 0]) * x[:, 5]
        ),
    }[name]()
    torch.testing.assert_close((slope * rate).sum(-1), along, rtol=1e-12, atol=1e-12)
    still = {"cart_pole_10N": [2, 3], "quadrotor": [3, 4, 5], "figure_eight": [1, 3, 5]}[name]
    places = [k for k in range(case.dim) if k not in still]
    assert torch.equal(rate[:, places], x[:, still])


def test_the_pendulum_is_that_of_gymnasium() -> None:
    gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
    inside = gymnasium.make("Pendulum-v1").unwrapped
    inside.reset(seed=0)
    for angle, rate, torque in ((0.3, 0.5, 1.0), (-2.0, 7.9, 2.0), (2.5, -7.9, -2.0)):
        inside.state = np.array([angle, rate])
        inside.step(np.array([torque]))
        found = CASES["pendulum"].equations(TorchMath, torch.tensor([angle, rate]), torch.tensor([torque]))
        np.testing.assert_allclose(torch.stack(tuple(found)).numpy(), inside.state, rtol=1e-5)


def test_the_path_is_gerono_s_with_the_velocities_that_it_states_and_its_period() -> None:
    time = torch.linspace(0, 6, 25, dtype=torch.float64, requires_grad=True)
    way = CASES["figure_eight"].way(time)
    for place, velocity in ((0, 1), (2, 3)):
        (slope,) = torch.autograd.grad(way[:, place].sum(), time, retain_graph=True)
        torch.testing.assert_close(way[:, velocity], slope, rtol=0, atol=1e-12)
    torch.testing.assert_close(way[0], way[-1], rtol=0, atol=1e-12)
    assert not torch.allclose(way[12], way[0])
    across, up = way[:, 0].detach(), way[:, 2].detach() - 1
    assert float(across.abs().max()) == pytest.approx(0.75, rel=1e-2)
    torch.testing.assert_close(across**4, 0.75**2 * (across**2 - up**2), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", list(CASES))
def test_a_plan_of_ipopt_has_the_cost_the_motion_and_the_bounds_of_the_problem(name: str) -> None:
    casadi = pytest.importorskip("casadi", reason="needs the extra rivals")
    case = dataclasses.replace(CASES[name], steps=3)
    problem, x0 = case.problem(), CASES[name].states(1, seed=0)
    solved = ipopt_program(casadi, case, problem, 3)(
        x0=np.zeros(case.dim * 4 + case.inputs * 3), p=np.append(x0[0, : case.dim].numpy(), 0.0)
    )
    assert solved["success"]
    plan = torch.from_numpy(np.array(solved["x"]).ravel())
    states, control = plan[: case.dim * 4].reshape(4, -1), plan[case.dim * 4 :].reshape(3, 1, -1)
    x, spent = x0, torch.zeros(1, dtype=torch.float64)
    torch.testing.assert_close(states[0], x0[0, : case.dim], rtol=0, atol=1e-6)
    low, high = torch.tensor(case.low), torch.tensor(case.high)
    assert bool(((low - 1e-6 <= control) & (control <= high + 1e-6)).all())
    for u, after in zip(control, states[1:], strict=True):
        x, paid = problem.advance(x, u)
        spent = spent + paid
        torch.testing.assert_close(x[0, : case.dim], after, rtol=0, atol=1e-6)
    cost: Tensor = spent + problem.terminal(x)
    assert float(cost) == pytest.approx(float(solved["f"]), rel=1e-6)


@pytest.mark.parametrize("name", list(CASES))
def test_a_plant_rests_at_its_goal_begins_in_its_box_and_may_turn_its_angles_once_more(name: str) -> None:
    case = CASES[name]
    plant, begin = case.plant(), case.states(20, seed=1)
    rest = plant.motion(plant.equilibrium().unsqueeze(0), plant.resting_input().unsqueeze(0))[:, : case.dim]
    torch.testing.assert_close(rest, torch.zeros_like(rest), rtol=0, atol=1e-12)
    assert ((begin[:, : case.dim] - case.goal()).abs() <= tensor(case.box)).all()
    x, u = uniform(5, case.dim, seed=2), uniform(5, case.inputs, seed=3)

    def moved(by: Tensor) -> Tensor:
        """What the equations say there, of x+ less the way that x itself was moved."""
        found = torch.stack(tuple(case.equations(TorchMath, (x + by).unbind(-1), u.unbind(-1))), -1)
        return found - by if case.discrete else found

    for k, unit in enumerate(torch.eye(case.dim).double()):
        turn, part = ((moved(way * unit) - moved(0 * unit)).abs().max() for way in (2 * math.pi, 1.0))
        assert (k in case.periodic) == (float(turn) < 1e-9 < float(part)), k
    assert set(case.periodic) == {k for k in range(case.dim) if k in plant.periodic}


def test_the_study_has_a_row_for_every_method() -> None:
    result = ran("rivals")
    lqr, ours, ipopt = result.rows("rivals")
    assert [row["method"] for row in (lqr, ours, ipopt)] == ["LQR", "discrete LQR", "IPOPT"]
    assert 1 - 1e-9 <= float(ours["ratio_max"]) <= float(lqr["ratio_max"]) * (1 + 1e-9)
    assert result.figures[0].axes[0].get_title() == "double integrator"
