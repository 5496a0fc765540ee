"""Closed loops side by side: what is stacked, kept, said and drawn, with runs that are made up."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.problem import AdpProblem
from staf_torch.adp.reference_optimum import Reference
from staf_torch.experiments import adp as loops
from staf_torch.experiments.adp import ClosedLoop, LoopSolution
from staf_torch.results.progress import Progress
from staf_torch.results.run_directory import RunDirectory
from staf_torch.settings.adp import adp_problem

SHORT = ("experiment=adp", "duration=0.1", "dt=0.01", "adp.compile=false")


def problem_of(*more: str) -> AdpProblem:
    return adp_problem(settings(*SHORT, *more))


def result_of(rows: int = 3, times: int = 5, weights: int = 2, **more: Any) -> adp.LoopResult:
    given = {
        "time": 0.5 * torch.arange(times).double(),
        "state": uniform(rows, times, 2, low=-4, high=4, seed=1),
        "control": uniform(rows, times, 1, seed=2),
        "actor_weights": uniform(rows, times, weights, seed=3),
        "critic_weights": uniform(rows, times, weights, seed=4),
        "identifier": torch.zeros(rows, times, 0).double(),
        "running_cost": uniform(rows, times, low=0, seed=5),
        "frozen_at": torch.full((rows,), math.inf).double(),
    }
    missing = {field.name: torch.zeros(rows) for field in dataclasses.fields(adp.LoopResult)}
    return adp.LoopResult(**missing | given | more)


def test_what_learns_is_found_behind_what_watches_it() -> None:
    plain = problem_of("adp.trust=null").controller
    watched = problem_of("adp.trust=0.5").controller
    assert isinstance(plain, adp.ActorCritic)
    assert isinstance(watched, adp.Supervised)
    assert loops.learner(plain) is plain
    assert loops.learner(watched) is watched.controller
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    lqr = adp.LQR(plant, cost)
    assert loops.learner(adp.Feedback(lqr)) is None
    guard = adp.SafetyFilter(lqr, plant, [lambda x, t: x[:, 0] + 5], dt=0.01, decay=1.0)
    assert loops.learner(guard) is None


@pytest.mark.parametrize("trust", ["null", "0.5"])
def test_initial_weights_and_gains_are_stacked_row_by_row(trust: str) -> None:
    words = [f"adp.trust={trust}", "adp/law=information"]
    first = problem_of(*words, "adp.critic=0.1", "adp.actor=0.3", "adp.gain=10").controller
    second = problem_of(*words, "adp.critic=0.2", "adp.actor=0.3", "adp.gain=20").controller
    assert loops._stacked([first], [3]) is first
    stacked = loops._stacked([first, second], [1, 2])
    assert stacked is not first
    found, one, two = (loops.learner(each) for each in (stacked, first, second))
    assert found is not None
    assert one is not None
    assert two is not None
    for name in ("critic", "actor", "gain"):
        values = [getattr(each, name) for each in (one, two, two)]
        assert torch.equal(getattr(found, name), torch.stack(values))
    assert one.critic.dim() == found.critic.dim() - 1  # the first one is as it was
    plain = adp.Feedback(adp.LQR(systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)))
    assert isinstance(loops._stacked([plain, plain], [1, 1]), adp.Feedback)


def test_gains_that_agree_stay_numbers_and_others_are_one_a_row() -> None:
    fields = [field.name for field in dataclasses.fields(adp.Gains)]
    one, two = adp.Gains(), dataclasses.replace(adp.Gains(), **{fields[0]: 0.125})
    found = loops._gains([one, two], torch.tensor([2, 1]), torch.zeros(1))
    for name in fields[1:]:
        assert getattr(found, name) == getattr(one, name)
        assert not isinstance(getattr(found, name), Tensor)
    rows: Any = getattr(found, fields[0])
    first = getattr(one, fields[0])
    assert rows.shape == (3, 1)
    assert rows.dtype == torch.float32
    torch.testing.assert_close(rows[:, 0], torch.tensor([first, first, 0.125], dtype=torch.float32))


def test_problems_run_together_with_seeds_of_their_own_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def simulate(controller: Any, plant: Any, cost: Any, x0: Tensor, **named: Any) -> adp.LoopResult:
        asked.append((controller, plant, cost, x0, named))
        return result_of(rows=len(x0))

    monkeypatch.setattr(loops, "simulate", simulate)
    first, second = (
        problem_of("trajectories=2", "seed=5"),
        problem_of("trajectories=3", "seed=50", "adp.critic=0.9"),
    )
    progress: Any = "told"
    one, two = loops.simulate_together([first, second], progress)
    ((_, plant, cost, x0, named),) = asked
    assert (plant, cost) == (first.system, first.cost)
    assert torch.equal(x0, torch.cat((first.initial_states, second.initial_states)))
    assert named == {
        **{"dt": 0.01, "steps": 10, "every": first.every, "seed": [5, 6, 50, 51, 52]},
        **{"integrator": first.integrator, "compile": False, "progress": "told"},
    }
    whole = result_of(rows=5)
    for field in dataclasses.fields(adp.LoopResult):
        parts = [getattr(each, field.name) for each in (one, two)]
        if field.name == "time":
            assert all(torch.equal(part, whole.time) for part in parts)
        else:
            assert [len(part) for part in parts] == [2, 3]
            assert torch.equal(torch.cat(parts), getattr(whole, field.name))
    told: list[float] = []
    loops.solve(first, Progress(told.append))
    asked[-1][-1]["progress"](10)
    assert told == [1.0]


@pytest.mark.parametrize(
    ("given", "size"),
    [
        ({}, 8 * 40 * 300),
        ({"trajectories": 10**6}, 8 * 40 * 200_000),
        ({"dt": 0}, 0),
        ({"dt": -0.01}, 0),
        ({"duration": None}, 0),
        ({"trajectories": "no"}, 0),
        ({"trajectories": 1.0}, 8 * 40 * 100),
    ],
)
def test_the_size_of_a_loop_is_that_of_its_records(given: dict[str, Any], size: int) -> None:
    known = {"trajectories": 3, "dt": 0.01, "duration": 1.0}
    assert ClosedLoop().size(known | given) == pytest.approx(size)
    assert ClosedLoop.animates is True
    shared = {name: ClosedLoop().shared(name, 1.5) for name in ("adp.critic", "adp.law.gains.critic", "dt")}
    fields = {field.name for field in dataclasses.fields(adp.Gains)}
    assert {f"adp.law.gains.{name}" for name in fields} | {
        f"adp.gains.{name}" for name in fields
    } <= ClosedLoop.batchable
    assert {
        "seed",
        "initial_state",
        "spread",
        "adp.actor",
        "adp.gain",
        "adp.policy.gain",
    } <= ClosedLoop.batchable
    assert (shared["adp.critic"], shared["dt"]) == ("number", 1.5)


@pytest.mark.parametrize("count", [0, 1, 20, 21, 24])
def test_diverged_trajectories_are_named_up_to_twenty(count: int, caplog: pytest.LogCaptureFixture) -> None:
    frozen_at = torch.full((25,), math.inf).double()
    frozen_at[1 : 1 + count] = torch.arange(1, 1 + count) / 8
    state = torch.full((25, 2, 2), 0.123456789).double()
    loops.name_the_diverged(result_of(25, 2, state=state, frozen_at=frozen_at))
    assert len(caplog.messages) == min(count, 20) + (count > 20)
    if count:
        assert caplog.messages[0] == "trajectory 1 from [0.123457, 0.123457] diverged at t = 0.125 s"
    if count > 20:
        assert caplog.messages[-1] == f"and {count - 20} more trajectories diverged"


def test_a_trajectory_is_restless_whose_rate_never_fell_to_a_quarter_in_the_last_quarter(
    caplog: pytest.LogCaptureFixture,
) -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    rate = torch.full((7, 8), 4.0).double()  # of 8 times the last two count
    rate[0, 5] = 0.0  # too early to be of the last quarter
    rate[1, 6] = 1.0  # at a quarter, which is enough
    rate[2, 7] = 0.5
    rate[3] = 0.0  # has never moved
    rate[4, 7] = 1.01
    state = torch.stack((rate.sqrt(), torch.zeros_like(rate)), dim=-1)
    frozen_at = torch.where(torch.arange(7) == 5, 1.0, math.inf).double()
    loops.count_the_restless(cost, result_of(7, 8, state=state, frozen_at=frozen_at))
    (said,) = caplog.messages
    assert said.startswith("3 of 7 trajectories are not regulated: in the last quarter of the 3.5 s")
    caplog.clear()
    loops.count_the_restless(cost, result_of(7, 8, state=0 * state))
    assert caplog.messages == []
    short = result_of(1, 3, state=tensor([[[1.0, 0.0], [0.1, 0.0], [1.0, 0.0]]]))
    loops.count_the_restless(cost, short)  # of three times the last one
    assert caplog.messages[0].startswith("1 of 1 trajectories")


def solution(optimum: Reference, rows: int = 3, **metrics: float | None) -> LoopSolution:
    names = (
        *("cost", "optimal_cost", "cost_ratio", "control_error", "value_error", "final_state_norm"),
        *("regulated_fraction", "diverged_fraction", "held_spectral_radius"),
    )
    known = dict.fromkeys(names, 0.123456789) | metrics
    return LoopSolution(result_of(rows), optimum, "a plant with a policy", 0.5, 8, known, (0,))


def test_a_solution_is_drawn_by_its_first_row_with_angles_of_one_turn() -> None:
    nothing = loops._drawn(solution(Reference(None, None, None)))
    assert nothing.control_error is nothing.value_error is nothing.optimal_cost is None
    errors = uniform(3, 5, seed=6), uniform(3, 5, seed=7)
    solved = solution(Reference(tensor([7.0, 8.0, 9.0]), *errors))
    found = loops._drawn(solved)
    result = solved.result
    assert found.optimal_cost == 7.0
    for name, part in (("control_error", errors[0]), ("value_error", errors[1])):
        np.testing.assert_array_equal(getattr(found, name), part[0].numpy())
    for name in ("control", "actor_weights", "critic_weights", "running_cost"):
        np.testing.assert_array_equal(getattr(found, name), getattr(result, name)[0].numpy())
    np.testing.assert_array_equal(found.time, result.time.numpy())
    turned = result.state[0].clone()
    turned[:, 0] = torch.atan2(turned[:, 0].sin(), turned[:, 0].cos())
    np.testing.assert_allclose(found.state, turned.numpy(), atol=1e-12)
    assert LoopSolution(result, nothing, "m", 0.5, 8, {}).periodic == ()  # type: ignore[arg-type]
    with pytest.raises(dataclasses.FrozenInstanceError):
        solved.dt = 1.0  # type: ignore[misc]


def test_a_loop_is_summed_up_in_four_lines(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    loops._summarise(solution(Reference(None, None, None), optimal_cost=None))
    assert caplog.messages == [
        "Closed loop: a plant with a policy, 3 trajectories, 4 s in steps of 0.5 s",
        "  cost 0.12346, optimal -, ratio 0.12346",
        "  second half: |u - u*| <= 0.12346, |V - V^| <= 0.12346",
        "  final |x| 0.12346, regulated 0.12346, diverged 0.12346, held spectral radius 0.12346",
    ]
    caplog.clear()
    loops._summarise(solution(Reference(None, None, None), rows=1))
    assert caplog.messages[0].startswith("Closed loop: a plant with a policy, 1 trajectory, 4 s")


def test_a_history_has_every_record_and_more(tmp_path: Path) -> None:
    result, more = result_of(), uniform(3, 5, 2, 2, seed=8)
    loops.write_history(RunDirectory(tmp_path), result, parameters=more)
    with np.load(tmp_path / "history.npz") as history:
        for name in ("state", "control", "actor_weights", "critic_weights", "running_cost"):
            np.testing.assert_array_equal(history[name], getattr(result, name).numpy())
        np.testing.assert_array_equal(history["parameters"], more.numpy())
        np.testing.assert_array_equal(history["time"], result.time.numpy())


class Gained(adp.Controller):
    """u = -k x of the critic's only weight k; as many draws as it is told, which move nothing."""

    draws = 2

    def init(self, x0: Tensor) -> adp.ControllerState:
        raise AssertionError

    def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
        assert uniform.shape == (len(x), 2, 2)
        assert carried.gain.shape == (len(x), 1, 1)
        assert carried.actor.shape == (len(x), 1)
        assert carried.identifier.shape == (len(x), 3)
        return -carried.critic * x[:, 1:] + uniform[:, 0, :1], carried


@pytest.mark.parametrize("rows", [1, 7, 8, 10])
def test_the_radius_is_of_the_loop_with_the_weights_of_the_end_the_largest_of_the_first_rows(
    rows: int,
) -> None:
    plant = systems.Linear([[0.0, 1.0], [-2.0, 0.0]], [[0.0], [1.0]])
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    critic = torch.full((rows, 4, 1), 9.0).double()
    critic[:, -1, 0] = 1.0 - 0.05 * torch.arange(rows)  # the less damping the larger
    problem: Any = SimpleNamespace(controller=Gained(), system=plant, cost=cost, dt=0.1)
    result = result_of(rows, 4, 1, critic_weights=critic, identifier=torch.zeros(rows, 4, 3).double())
    found = loops.held_radius(problem, result)
    k = 1.0 - 0.05 * (min(rows, 8) - 1)
    a = np.array([[0.0, 1.0, 0.0], [-2.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    held = torch.linalg.matrix_exp(torch.as_tensor(0.1 * a)).numpy()
    closed = held[:2, :2] - np.outer(held[:2, 2], [0.0, k])
    assert found == pytest.approx(float(np.abs(np.linalg.eigvals(closed)).max()), rel=1e-6)
    critic[0, -1] = math.nan
    assert loops.held_radius(problem, result) is None


def test_a_run_leaves_what_is_asked_for_and_a_filter_has_numbers_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loops, "draw_adp", lambda drawn: drawn)
    monkeypatch.setattr(loops, "images", lambda figure: {"txt": b"drawn"})
    monkeypatch.setattr(loops, "animate", lambda scene, kind: {kind: b"moved"})
    walls = ("adp/policy=lqr", "adp.walls.low=[-6,-6]", "adp.walls.high=[6,6]", "adp.walls.decay=1.0")
    cfg = settings(*SHORT, *walls, "figures=true", "history=true", "animation=gif")
    found = ClosedLoop()(cfg, tmp_path)
    assert {"wall_minimum_margin", "wall_constraint_violations", "wall_acted"} <= found.keys()
    files = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert files == {"figures/closed_loop.gif", "figures/adp.txt", "history.npz", "metrics.json"}
    bare = tmp_path / "bare"
    bare.mkdir()
    plain = ClosedLoop()(settings(*SHORT, "adp/policy=lqr", "figures=false", "history=false"), bare)
    assert not any(name.startswith("wall_") for name in plain)
    assert [path.name for path in bare.iterdir()] == ["metrics.json"]
    told: list[float] = []
    wrong, right = ClosedLoop().solve(
        [settings(*SHORT, "dt=-1"), settings(*SHORT, "adp/policy=lqr")], Progress(told.append)
    )
    assert isinstance(wrong, ValueError)
    assert isinstance(right, LoopSolution)
    assert right.metrics == pytest.approx(plain)
    assert right.method == "TwoState with " + problem_of("adp/policy=lqr").controller.label
    assert (right.dt, right.steps) == (0.01, 10)
    assert told[-1] == 1
    (alone,) = ClosedLoop().solve([settings(*SHORT, "dt=-1")], Progress(told.append))
    assert isinstance(alone, ValueError)
    (flat,) = ClosedLoop().solve([settings(*SHORT, "animation=mp4")], Progress(told.append))
    assert "animation" in str(flat)
