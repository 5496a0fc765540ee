"""What `rivals` asks of every method, ours and those of other packages, with stand-ins for the packages."""

from __future__ import annotations

import dataclasses
import inspect
import math
import sys
import types
from typing import Any

import fake_casadi
import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp
from staf_torch.experiments import rival_methods
from staf_torch.experiments.rival_methods import METHODS, Method, UnsuitableError, ipopt_program
from staf_torch.experiments.rival_plants import CASES, Case

SMALL = dataclasses.replace(CASES["double_integrator"], steps=7, horizon=4)
UNSUITED = {
    "LQR": ("pendulum", "needs a plant in continuous time"),
    "near_optimal": ("figure_eight", "follows no path"),
    "near_optimal planned": ("figure_eight", "follows no path"),
    "GlobalValue": ("double_integrator", "the LQR reaches the goal"),
}


class Heard:
    """Stands for something of `adp`: keeps what it is called with."""

    def __init__(self) -> None:
        self.given: tuple[Any, ...] = ()
        self.named: dict[str, Any] = {}

    def __call__(self, *given: Any, **named: Any) -> Heard:
        self.given, self.named = given, named
        return self

    def controller(self) -> str:
        return "its controller"


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> dict[str, Heard]:
    names = ("LQR", "near_optimal", "learn_global_value", "RecedingHorizon", "PathIntegral")
    found = {name: Heard() for name in names}
    for name, each in found.items():
        monkeypatch.setattr(adp, name, each)
    monkeypatch.setattr(rival_methods, "steered", lambda case, mpc: lambda x0: mpc)
    return found


@pytest.mark.parametrize("name", UNSUITED)
def test_a_plant_that_a_method_is_not_made_for_is_refused_before_it_is_begun(
    name: str, heard: dict[str, Heard]
) -> None:
    plant, words = UNSUITED[name]
    with pytest.raises(UnsuitableError, match=words):
        METHODS[name].prepare(CASES[plant])
    assert all(not each.given for each in heard.values())


@pytest.mark.parametrize(
    ("method", "plant", "asked", "named"),
    [
        ("LQR", "cart_pole_5N", "LQR", {}),
        ("discrete LQR", "cart_pole_5N", "LQR", {"period": 0.02}),
        ("discrete LQR", "pendulum", "LQR", {"period": 0.05}),
        ("near_optimal", "quadrotor", "near_optimal", {"dt": 0.02}),
        ("near_optimal planned", "quadrotor", "near_optimal", {"dt": 0.02, "plan": True}),
        ("GlobalValue", "pendulum", "learn_global_value", {"steps": 150}),
        (
            "GlobalValue",
            "cart_pole_swing_up",
            "learn_global_value",
            {"steps": 200, "rounds": 6, "candidates": 64, "lookahead": 120},
        ),
        ("box-DDP", "cart_pole_to_1m", "RecedingHorizon", {"steps": 20}),
        ("plan followed", "cart_pole_to_1m", "RecedingHorizon", {"steps": 90, "iterations": 0}),
        ("PathIntegral", "quadrotor", "PathIntegral", {"steps": 50, "samples": 200}),
    ],
)
def test_a_method_of_ours_is_asked_for_with_the_numbers_of_its_case(
    method: str, plant: str, asked: str, named: dict[str, Any], heard: dict[str, Heard]
) -> None:
    case = CASES[plant]
    begin = METHODS[method].prepare(case)
    one = heard[asked]
    assert one.named == named
    assert [name for name, each in heard.items() if each.given] == [asked]
    first = one.given[0]
    assert (first.dim, first.inputs) == (case.dim, case.inputs)
    kind = adp.SampledProblem if asked not in ("LQR", "near_optimal") else type(case.plant())
    assert isinstance(first, kind)
    if asked in ("LQR", "near_optimal"):
        assert torch.equal(one.given[1].q, case.cost().q)
    if method == "GlobalValue":
        assert one.given[1] == ([math.pi, 8.0] if plant == "pendulum" else [1.0, math.pi, 1.0, 2.0])
    steer: Any = begin(case.states(1, seed=0))
    assert steer == "its controller" if asked == "near_optimal" else steer is one


class Carried:
    """A controller that counts its calls, and says what it was given."""

    draws = 3

    def __init__(self) -> None:
        self.seen: list[tuple[Any, ...]] = []

    def init(self, x0: Tensor) -> int:
        return 10 * len(x0)

    def step(self, x: Tensor, state: int, uniform: Tensor, dt: float) -> tuple[Tensor, int]:
        self.seen.append((x, state, uniform, dt))
        return x[:, :1] + state, state + 1


def test_a_controller_that_carries_a_state_is_steered_by_numbers_that_are_the_same_again() -> None:
    mpc: Any = Carried()
    x = uniform(2, 4, seed=1)
    for _ in range(2):  # every beginning is a new one
        mpc.seen.clear()
        steer = rival_methods.steered(SMALL, mpc)(x)
        torch.testing.assert_close(steer(x), x[:, :1] + 20)
        torch.testing.assert_close(steer(x + 1), x[:, :1] + 22)
        drawn = torch.Generator().manual_seed(0)
        for (at, state, uniforms, dt), k in zip(mpc.seen, (0, 1), strict=True):
            expected = torch.rand((2, 3, 4), generator=drawn, dtype=torch.float64)
            torch.testing.assert_close(uniforms, 2 * expected - 1, rtol=0, atol=1e-15)
            assert torch.equal(at, x + k)
            assert (state, dt) == (20 + k, SMALL.dt)
    steer(x.float())
    assert mpc.seen[-1][2].dtype == torch.float32


def test_a_method_of_another_package_is_told_apart_by_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {name: (method.packages, method.slow) for name, method in METHODS.items()}
    ours = (("scipy",), False)
    assert found == dict.fromkeys(list(METHODS)[:8], ours) | {
        "IPOPT": (("casadi",), True),
        "MPPI": (("pytorch-mppi",), True),
    }
    alone = ["LQR", "discrete LQR", "GlobalValue", "MPPI"]
    assert [name for name, method in METHODS.items() if not method.helpers] == alone
    assert METHODS["IPOPT"].helpers == (ipopt_program,)
    assert all(
        METHODS[name].helpers == (rival_methods.steered,) for name in METHODS if name not in (*alone, "IPOPT")
    )
    mine = Method("mine", rival_methods.lqr)
    assert (mine.packages, mine.helpers, mine.slow, mine.missing) == ((), (), False, None)
    assert Method("mine", rival_methods.lqr, ("torch", "no-such-one", "nor-this")).missing == "no-such-one"
    with pytest.raises(dataclasses.FrozenInstanceError):
        mine.slow = True  # type: ignore[misc]
    monkeypatch.setattr(rival_methods, "_size", {"a": 2**20, "b": 3 * 2**19}.get)
    assert Method("mine", rival_methods.lqr, ("a", "b")).megabytes == 2.5


def commented(case: Case) -> None:
    """Three lines of code, one of them this: its text is none."""

    # not this one
    assert case  # but this one

    assert case.dt


def test_lines_of_code_are_counted_without_blank_ones_and_comments() -> None:
    assert len(inspect.getsourcelines(commented)[0]) == 7
    assert rival_methods._lines(commented) == 3
    assert Method("mine", commented).lines == 3
    assert Method("mine", commented, (), (commented, commented)).lines == 9


def test_a_package_without_a_list_of_files_takes_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = types.SimpleNamespace(files=None)
    monkeypatch.setattr(rival_methods.metadata, "distribution", lambda name: nothing)
    assert rival_methods._size.__wrapped__("a package of a system") == 0


def program(name: str, **changes: Any) -> tuple[Any, Any, fake_casadi.Solver]:
    """A case, what solves it, and the solver behind it, which finds that any guess is the solution."""
    made: list[fake_casadi.Solver] = []
    case = dataclasses.replace(CASES[name], **changes)
    solve = ipopt_program(fake_casadi.module(made), case, case.problem(), 5)
    (solver,) = made
    return case, solve, solver


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("double_integrator", {}),
        ("double_integrator", {"rest": (0.0,), "target": (0.5, 0.0)}),
        ("pendulum", {}),
        ("cart_pole_to_1m", {}),
        ("quadrotor", {}),
        ("figure_eight", {}),
    ],
)
def test_the_program_of_ipopt_has_the_costs_and_the_motion_of_the_problem(
    name: str, changes: dict[str, Any]
) -> None:
    case, solve, _ = program(name, **changes)
    problem, n, m, begun = case.problem(), case.dim, case.inputs, 0.7
    if case.path is None:
        begun = 0.0
    # Any states at all: the cost is theirs, and what the motion misses them by is the constraint.
    states = uniform(6, n, low=-2, high=2, seed=1)
    for k in case.periodic:
        states[:, k] = tensor([0.4, 3.3, -3.6, 7.0, -9.1, 12.2])  # several turns away
    control = uniform(5, m, low=-1, high=1, seed=2)
    full = states
    if case.path is not None:
        full = torch.cat((states, begun + case.dt * torch.arange(6).double().unsqueeze(-1)), dim=-1)
    moved, paid = problem.advance(full[:-1], control)
    total = float(paid.sum() + problem.terminal(full[-1:]))
    guess = np.concatenate([states.numpy().ravel(), control.numpy().ravel()])
    start = uniform(n, seed=3)
    found = solve(guess, np.append(start.numpy(), begun))
    assert found["success"]
    assert found["f"].item() == pytest.approx(total, rel=1e-9)
    expected = torch.cat((states[0] - start, (states[1:] - moved[:, :n]).flatten()))
    np.testing.assert_allclose(found["g"].ravel(), expected.numpy(), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("steps", [5, 6])
def test_the_solver_of_ipopt_is_quiet_has_the_bounds_and_is_begun_warm_but_for_a_whole_episode(
    steps: int,
) -> None:
    _, solve, solver = program("quadrotor", steps=steps)
    solve(np.zeros(6 * 6 + 5 * 2), np.zeros(7))
    low, high = solver.asked["lbx"], solver.asked["ubx"]
    assert low.tolist() == [-math.inf] * 36 + [-9.81, -1.0] * 5
    assert high.tolist() == [math.inf] * 36 + [9.81, 1.0] * 5
    assert (solver.asked["lbg"], solver.asked["ubg"]) == (0.0, 0.0)
    quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "ipopt.max_iter": 300}
    warm = {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3}
    assert solver.options == quiet | {"error_on_fail": False} | (warm if steps == 6 else {})
    assert solver.kind == "ipopt"


@pytest.mark.parametrize("rest", [None, (0.25,)])
def test_ipopt_begins_at_rest_and_then_from_its_last_plan_a_period_later(
    rest: tuple[float, ...] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = dataclasses.replace(SMALL, horizon=3, rest=rest)
    asked: list[tuple[list[float], list[float]]] = []
    plans = iter(
        [
            np.arange(11.0),
            np.full(11, np.nan),  # the solver has failed: what it began from is followed
            100 + np.arange(11.0),
            *[200 + np.arange(11.0)] * 3,
        ]
    )

    def solve(x0: np.ndarray, p: np.ndarray) -> dict[str, Any]:
        asked.append((x0.tolist(), p.tolist()))
        return {"x": next(plans)}

    monkeypatch.setitem(sys.modules, "casadi", types.ModuleType("casadi"))
    steps: list[int] = []
    monkeypatch.setattr(rival_methods, "ipopt_program", lambda *given: steps.append(given[3]) or solve)
    x0 = tensor([[1.0, 2.0]])
    steer = rival_methods.ipopt(case)(x0)
    assert steps == [3]
    found = [steer(x0 + k) for k in range(3)]
    assert [each.tolist() for each in found] == [[[8.0]], [[9.0]], [[108.0]]]
    idle = 0.25 if rest else 0.0
    assert asked[0] == ([1.0, 2.0] * 4 + [idle] * 3, [1.0, 2.0, 0.0])
    shifted = [2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 6.0, 7.0, 9.0, 10.0, 10.0]
    assert asked[1] == (shifted, [2.0, 3.0, 0.1])
    again = [4.0, 5.0, 6.0, 7.0, 6.0, 7.0, 6.0, 7.0, 10.0, 10.0, 10.0]
    assert asked[2][0] == again
    assert asked[2][1] == pytest.approx([3.0, 4.0, 0.2])
    # Every row has a plan of its own, and every beginning its own time.
    both = rival_methods.ipopt(case)(torch.cat((x0, -x0)))
    assert both(torch.cat((x0, -x0))).tolist() == [[208.0], [208.0]]
    assert asked[4] == ([-1.0, -2.0] * 4 + [idle] * 3, [-1.0, -2.0, 0.0])


def test_mppi_asks_for_the_cost_after_the_step_and_at_the_last_one_for_the_rest_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[Any] = []

    class Batched:
        def __init__(self, *given: Any, **named: Any) -> None:
            self.given, self.named, self.U = given, named, torch.ones(2, 3)
            made.append(self)

        def command(self, x: Tensor) -> str:
            return "its command"

    module: Any = types.ModuleType("pytorch_mppi")
    module.MPPI_Batched = Batched
    monkeypatch.setitem(sys.modules, "pytorch_mppi", module)
    case = dataclasses.replace(CASES["quadrotor"], horizon=4)
    problem, x, u = case.problem(), uniform(3, 6, seed=1), uniform(3, 2, seed=2)
    steer: Any = rival_methods.mppi(case)(x)
    (one,) = made
    assert steer(x) == "its command"
    assert torch.equal(one.U, torch.zeros(2, 3))
    motion, cost, dim, spread, rows = one.given
    assert (dim, rows) == (6, 3)
    moved, paid = problem.advance(x, u)
    torch.testing.assert_close(motion(x, u, 0), moved)
    for t in (0, 2):
        torch.testing.assert_close(cost(x, u, t), paid)
    torch.testing.assert_close(cost(x, u, 3), paid + problem.terminal(x))
    width = tensor([2 * 9.81, 2.0])
    torch.testing.assert_close(spread, torch.diag((width / 4).square()))
    named = one.named
    assert named.pop("lambda_") == pytest.approx(0.01 * float(problem.terminal(x).mean()))
    assert torch.equal(named.pop("u_min"), problem.bounds.low)
    assert torch.equal(named.pop("u_max"), problem.bounds.high)
    assert named == {"num_samples": 200, "horizon": 4, "step_dependent_dynamics": True}
