"""Methods beside those of others: the table is what the numbers say."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from composing import settings
from torch import Tensor

from staf_torch.experiments import rival_methods, rivals
from staf_torch.experiments.rival_methods import METHODS, Method, ipopt_program
from staf_torch.experiments.rival_plants import CASES, TorchMath

SHORT = dataclasses.replace(CASES["double_integrator"], steps=60, horizon=20)


def idle(case):  # type: ignore[no-untyped-def]
    """No control at all."""
    return lambda x0: lambda x: torch.zeros(len(x), case.inputs, dtype=x.dtype)


def shouting(case):  # type: ignore[no-untyped-def]
    """More than the bounds allow."""
    return lambda x0: lambda x: torch.full((len(x), case.inputs), 3.0, dtype=x.dtype)


def test_rows_say_what_was_lost_violated_and_not_tried() -> None:
    methods = [
        METHODS["discrete LQR"],
        METHODS["GlobalValue"],
        Method("idle", idle),
        Method("shouting", shouting),
        Method("absent", idle, ("no-such-package",)),
    ]
    x0 = torch.tensor([[0.5, 0.0], [4.0, 1.0]], dtype=torch.float64)
    best, unsuited, lost, loud, absent = rivals.compare(SHORT, methods, x0, calls=3)
    assert (best["regulated"], best["violations"]) == (1, 0)
    assert 1 - 1e-9 <= best["ratio_median"] <= best["ratio_max"] < 1.1
    assert (unsuited["ratio_median"], unsuited["note"]) == (None, "the LQR reaches the goal")
    assert (lost["regulated"], lost["ratio_median"]) == (0, None)
    assert loud["violations"] == pytest.approx(1)
    assert absent["note"] == "no-such-package is not installed"
    assert (absent["regulated"], absent["megabytes"]) == (None, None)
    assert (lost["lines"], best["us_median"] > 0) == (2, True)


def test_slow_methods_run_from_fewer_states_and_say_so() -> None:
    def timid(case):  # type: ignore[no-untyped-def]
        """The regulator, and a third of it far out."""
        steer = rival_methods.discrete_lqr(case)(None)
        return lambda x0: lambda x: torch.where(x[:, :1].abs() > 1, 0.3, 1.0) * steer(x)

    slow = Method("slow", timid, slow=True)
    x0 = torch.tensor([[0.5, 0.0], [0.2, 0.1], [1.2, 0.0]], dtype=torch.float64)
    every, few = rivals.compare(SHORT, [Method("fast", timid), slow], x0, calls=3, slow=1)
    assert (every["note"], few["note"]) == (None, "from 1 of the 3 states")
    assert every["ratio_max"] > 1.001  # it has seen the last one
    assert few["ratio_max"] == pytest.approx(1)
    (whole,) = rivals.compare(SHORT, [slow], x0, calls=3, slow=3)
    assert whole["note"] is None


@pytest.mark.parametrize("name", list(CASES))
def test_every_plant_rests_at_its_goal_and_begins_in_its_box(name: str) -> None:
    case = CASES[name]
    plant, x = case.plant(), case.states(20, seed=1)
    rest = plant.motion(plant.equilibrium().unsqueeze(0), plant.resting_input().unsqueeze(0))[:, : case.dim]
    torch.testing.assert_close(rest, torch.zeros_like(rest), rtol=0, atol=1e-12)
    assert (x[:, case.dim :] == 0).all()
    assert ((x[:, : case.dim] - case.goal()).abs() <= torch.tensor(case.box, dtype=torch.float64)).all()


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


def test_the_path_has_the_velocities_that_it_states_and_the_period_that_it_is_called_by() -> None:
    time = torch.linspace(0, 6, 25, dtype=torch.float64, requires_grad=True)
    way = CASES["figure_eight"].way(time)
    for place, velocity in ((0, 1), (2, 3)):
        (slope,) = torch.autograd.grad(way[:, place].sum(), time, retain_graph=True)
        torch.testing.assert_close(way[:, velocity], slope, rtol=0, atol=1e-12)
    torch.testing.assert_close(way[0], way[-1], rtol=0, atol=1e-12)
    torch.testing.assert_close(way[12, [0, 2]], way[0, [0, 2]], rtol=0, atol=1e-12)  # it meets itself halfway
    assert not torch.allclose(way[12], way[0])
    across, up = way[:, 0], way[:, 2] - 1
    torch.testing.assert_close(across.abs().max(), torch.tensor(0.75, dtype=torch.float64), rtol=1e-2, atol=0)
    torch.testing.assert_close(across**4, 0.75**2 * (across**2 - up**2), rtol=0, atol=1e-12)  # of Gerono


@pytest.mark.parametrize("name", ["cart_pole_to_1m", "pendulum", "figure_eight"])
def test_equations_mean_the_same_to_casadi(name: str) -> None:
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
    for u, after in zip(control, states[1:], strict=True):
        x, paid = problem.advance(x, u)
        spent = spent + paid
        torch.testing.assert_close(x[0, : case.dim], after, rtol=0, atol=1e-6)
    cost: Tensor = spent + problem.terminal(x)
    assert float(cost) == pytest.approx(float(solved["f"]), rel=1e-6)


def test_unknown_plants_and_methods_are_refused_by_name(tmp_path) -> None:  # type: ignore[no-untyped-def]
    cfg = settings("experiment=rivals", "rivals.plants=[rocket]")
    with pytest.raises(ValueError, match=r"`staf rivals.plants=...` must be one of .*; got 'rocket'"):
        rivals.run(cfg, tmp_path)


def test_the_size_of_a_package_is_that_of_its_files() -> None:
    assert rival_methods._size("numpy") > 10 * rival_methods._size("pytest") > 0


# Period (s), duration (s), diagonals of Q and R, bounds of the inputs, half the box of states, periods ahead.
TABLE = {
    "double_integrator": (0.1, 15, (1, 1), (1,), (-1,), (1,), (5, 1), 50),
    "pendulum": (0.05, 10, (20, 2), (0.02,), (-2,), (2,), (math.pi, 1), 50),
    "cart_pole_10N": (0.02, 5, (1, 1, 0.1, 0.1), (0.01,), (-10,), (10,), (0.3,) * 4, 50),
    "cart_pole_5N": (0.02, 5, (1, 1, 0.1, 0.1), (0.01,), (-5,), (5,), (0.3,) * 4, 50),
    "cart_pole_to_1m": (1 / 15, 6, (5, 5, 0.1, 0.1), (0.1,), (-10,), (10,), (1, 0.2, 0.2, 0.2), 20),
    "quadrotor": (0.02, 4, (1,) * 6, (1, 1), (-9.81, -1), (9.81, 1), (0.4,) * 6, 50),
    "figure_eight": (
        0.02,
        6,
        (5, 0.1, 5, 0.1, 0.1, 0.1),
        (0.1, 0.1),
        (0.0563,) * 2,
        (0.2967,) * 2,
        (0.05,) * 6,
        20,
    ),
    "cart_pole_swing_up": (0.02, 6, (1, 1, 0.1, 0.1), (0.01,), (-10,), (10,), (1, math.pi, 1, 2), 120),
}


@pytest.mark.parametrize("name", list(CASES))
def test_published_numbers_are_of_these_cases(name: str) -> None:
    case, cost = CASES[name], CASES[name].cost()
    found = (case.dt, case.steps * case.dt, *case.weights, case.low, case.high, case.box, case.horizon)
    for one, two in zip(found, TABLE[name], strict=True):
        assert one == pytest.approx(two)
    if case.path is None:
        x = (case.goal() + 0.1).unsqueeze(0)
        u = torch.full((1, case.inputs), 0.2, dtype=torch.float64)
        paid = 0.01 * sum(case.weights[0]) + 0.04 * sum(case.weights[1])
        assert float(cost.rate(x, u)) == pytest.approx(paid)


@pytest.mark.parametrize("name", list(CASES))
def test_an_angle_is_a_coordinate_that_may_turn_once_more_and_not_less(name: str) -> None:
    case = CASES[name]
    generator = torch.Generator().manual_seed(2)
    x = torch.rand(5, case.dim, generator=generator, dtype=torch.float64)
    u = torch.rand(5, case.inputs, generator=generator, dtype=torch.float64)

    def moved(by: Tensor) -> Tensor:
        """What the equations say there, of x+ less the way that x itself was moved."""
        found = torch.stack(tuple(case.equations(TorchMath, (x + by).unbind(-1), u.unbind(-1))), -1)
        return found - by if case.discrete else found

    still = torch.zeros(case.dim, dtype=torch.float64)
    for k, unit in enumerate(torch.eye(case.dim, dtype=torch.float64)):
        turn, part = ((moved(way * unit) - moved(still)).abs().max() for way in (2 * math.pi, 1.0))
        assert (k in case.periodic) == (float(turn) < 1e-9 < float(part)), k
    assert set(case.periodic) == {k for k in range(case.dim) if k in case.plant().periodic}


@pytest.mark.parametrize("name", list(CASES))
def test_a_memory_of_trajectories_is_for_plants_that_begin_far_from_their_goal(name: str) -> None:
    case = CASES[name]
    turns = any(case.box[k] >= math.pi for k in case.periodic)  # it begins anywhere on a circle
    assert case.swing == turns


def test_a_plan_of_ipopt_begins_from_the_last_one_a_period_later() -> None:
    pytest.importorskip("casadi", reason="needs the extra rivals")
    case = dataclasses.replace(CASES["double_integrator"], horizon=4)
    steer = rival_methods.ipopt(case)(torch.tensor([[2.0, 0.0]], dtype=torch.float64))
    x = torch.tensor([[2.0, 0.0]], dtype=torch.float64)
    problem = case.problem()
    for _ in range(3):
        u = steer(x)
        assert u.shape == (1, 1)
        assert -1 - 1e-6 <= float(u) <= 1 + 1e-6
        x, _ = problem.advance(x, u)
    fresh = rival_methods.ipopt(case)(x)(x)
    torch.testing.assert_close(steer(x), fresh, rtol=0, atol=1e-5)
