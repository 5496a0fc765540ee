"""Methods, laws and drifts beside each other, with loops that are made up."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from recorded import Record
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.problem import AdpProblem
from staf_torch.experiments import adp_comparison, adp_tracking
from staf_torch.experiments.adp import learner

SHORT = ("experiment=adp_comparison", "duration=0.1", "dt=0.01", "trajectories=4", "adp.compile=false")


def test_every_method_is_the_recorded_one(record: Record) -> None:
    cfg = settings(*SHORT)
    described: dict[str, Any] = {}
    x0: Tensor | None = None
    for name, changes in adp_comparison._ROWS.items():
        problem = adp_comparison.variant(cfg, changes)
        learning: Any = learner(problem.controller)
        published = changes.get("law") == "published"
        assert problem.dt == (0.001 if published else 0.01)
        assert problem.every == (1 if changes.get("policy") == "rollout" else problem.steps)
        x0 = problem.initial_states if x0 is None else x0
        assert torch.equal(problem.initial_states, x0)
        assert x0.shape == (4, 2)
        assert bool((x0.norm(dim=-1) > 0).all())
        described[name] = f"{type(problem.controller).__name__} {problem.integrator} {problem.steps} "
        described[name] += f"{adp_comparison._size(problem.controller)}"
        if learning is not None:
            points = learning.extrapolation
            described[name] += (
                f" {type(learning.basis).__name__} {type(learning.law).__name__} {type(points).__name__}"
            )
            described[f"{name}: box"] = float(points.fixed_box)
            described[f"{name}: width"] = points.half_width(x0)
    record(described)


def test_a_method_keeps_its_own_step_and_record_and_the_middle_of_the_box_is_left_out() -> None:
    quick = adp_comparison.variant(settings(*SHORT, "dt=0.0005"), {"law": "published"})
    assert quick.dt == 0.0005
    kept = adp_comparison.variant(settings(*SHORT, "adp.record_every=5"), {})
    assert kept.every == 5
    whole = adp_comparison.variant(settings(*SHORT), {})
    assert (whole.every, whole.steps) == (10, 10)


def made_up(rows: int, weights: tuple[float, ...] = (1.0,)) -> Any:
    """A loop of which the first row is regulated, the second is not, and the last has diverged."""
    state = torch.ones(rows, 2, 2).double()
    state[0] = 0.0
    frozen_at = torch.full((rows,), math.inf).double()
    frozen_at[-1] = 0.5
    return SimpleNamespace(
        state=state, cost=torch.arange(1, rows + 1).double(), frozen_at=frozen_at, diverged=frozen_at < 9
    )


def test_a_run_compares_every_method_with_the_same_optimum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: dict[str, list[Any]] = {"changes": [], "best": [], "drawn": []}
    ticks = iter(0.75 * k * (k + 1) for k in range(100))

    def variant(cfg: Any, changes: Any) -> Any:
        asked["changes"].append(changes)
        return SimpleNamespace(controller=None, steps=5, initial_states=torch.zeros(3, 2), name="problem")

    def row(result: object, ratio: Tensor) -> dict[str, Any]:
        asked["best"].append(ratio.tolist())
        return {"ratio_median": 1.23456789, "ratio_max": None, "regulated": 0.5}

    monkeypatch.setattr(adp_comparison, "_ROWS", {"One, a-b": {"a": 1}, "two": {"b": 2}})
    monkeypatch.setattr(adp_comparison, "variant", variant)
    monkeypatch.setattr(adp_comparison, "optimal_cost", lambda problem: tensor([2.0, 4.0, 1.0]))
    monkeypatch.setattr(adp_comparison, "solve", lambda problem, progress: made_up(3))
    monkeypatch.setattr(adp_comparison, "comparison_row", row)
    monkeypatch.setattr(adp_comparison, "regulated", lambda result: torch.tensor([True, False, True]))
    monkeypatch.setattr(adp_comparison, "_size", lambda controller: (7, 8))
    monkeypatch.setattr(adp_comparison, "draw_comparison", asked["drawn"].append)
    monkeypatch.setattr(adp_comparison, "images", lambda figure: {"txt": b"drawn"})
    monkeypatch.setattr(adp_comparison.time, "perf_counter", lambda: next(ticks))
    caplog.set_level("INFO")
    found = adp_comparison.run(settings(*SHORT, "figures=true"), tmp_path)
    assert asked["changes"] == [{"a": 1}, {"b": 2}]
    assert asked["best"] == [[0.5, 0.5, math.inf]] * 2  # the last has diverged
    assert found == {
        f"{prefix}_{name}": value
        for prefix in ("one_a_b", "two")
        for name, value in {
            **{"functions": 7, "points": 8, "ratio_median": 1.23456789, "ratio_max": None, "regulated": 0.5}
        }.items()
    }
    (drawn,) = asked["drawn"]
    assert [each.tolist() for each in drawn.values()] == [[0.5, math.inf, math.inf]] * 2
    lines = (tmp_path / "comparison.csv").read_text().splitlines()
    assert lines[0].startswith("method,functions,points")
    seconds = [float(line.rsplit(",", 1)[1]) for line in lines[1:]]
    assert seconds == pytest.approx([1e6 * 1.5 / 15, 1e6 * 4.5 / 15])  # of 5 steps of 3 rows
    assert "1.235" in (tmp_path / "comparison.md").read_text()
    assert [line.split()[-6:] for line in caplog.messages] == [
        ["median", "1.235,", "max", "-,", "regulated", "0.5"]
    ] * 2
    other = tmp_path / "other"
    other.mkdir()
    adp_comparison.run(settings(*SHORT, "figures=false"), other)
    assert not (other / "figures").exists()
    monkeypatch.setattr(adp_comparison, "optimal_cost", lambda problem: None)
    monkeypatch.setattr(
        adp_comparison, "variant", lambda cfg, changes: SimpleNamespace(system=systems.VanDerPol())
    )
    with pytest.raises(ValueError, match=r"needs a plant whose optimum is known.*got VanDerPol"):
        adp_comparison.run(settings(*SHORT), other)


def test_the_size_of_what_is_learned_or_planned() -> None:
    cfg = settings(*SHORT)
    for changes in ({}, {"trust": None}):
        problem = adp_comparison.variant(cfg, changes)
        inner: Any = learner(problem.controller)
        assert adp_comparison._size(problem.controller) == (inner.basis.count, inner.extrapolation.count)
    rollout: Any = adp_comparison.variant(cfg, {"policy": "rollout"}).controller
    basis = rollout.policy.basis
    assert adp_comparison._size(rollout) == (basis.count, basis.count * rollout.policy.steps)
    assert rollout.policy.steps > 1
    lqr: Any = adp_comparison.variant(cfg, {"policy": "lqr"}).controller
    assert adp_comparison._size(lqr) == (0, 0)
    odd: Any = SimpleNamespace(policy=rollout.policy)
    assert adp_comparison._size(odd) == (0, 0)


def test_every_initial_state_is_run_with_every_weight() -> None:
    problem = adp_comparison.variant(settings(*SHORT), {"trust": None})
    found = adp_comparison._from_weights(problem, [0.25, 0.5, 4.0], 0.7)
    assert torch.equal(found.initial_states, torch.cat((problem.initial_states,) * 3))
    learning: Any = learner(found.controller)
    rows = tensor([0.25] * 4 + [0.5] * 4 + [4.0] * 4)
    torch.testing.assert_close(learning.critic, rows.unsqueeze(-1).expand(12, learning.basis.count))
    torch.testing.assert_close(learning.actor, 0.7 * learning.critic)
    assert learning.critic.dtype == torch.float64


def test_initial_weights_leave_shares_by_weight_and_law(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[Any] = []

    def from_weights(problem: AdpProblem, weights: list[float], actor: float) -> Any:
        asked.append((weights, actor))
        return problem

    good = torch.tensor([True, True, False, True, True, False, False, False])
    monkeypatch.setattr(adp_comparison, "_from_weights", from_weights)
    monkeypatch.setattr(adp_comparison, "variant", lambda cfg, changes: asked.append(changes) or "problem")
    monkeypatch.setattr(adp_comparison, "solve", lambda problem, progress: made_up(8))
    monkeypatch.setattr(adp_comparison, "regulated", lambda result: good)
    caplog.set_level("INFO")
    words = ("initial_weights=[0.1,2.5]", "adp.actor=0.3", "adp.critic=1.5")
    found = adp_comparison.initial_weights(settings("experiment=adp_initial_weights", *words), tmp_path)
    laws = ("published", "information", "supervised")
    shares = {
        "regulated_W0.1": 0.75,
        "regulated_W2.5": 0.25,
        "regulated_fraction": 0.5,
        "diverged_fraction": 0.125,
    }
    assert found == {f"{law}_{name}": share for law in laws for name, share in shares.items()}
    assert [each for each in asked if isinstance(each, tuple)] == [([0.1, 2.5], pytest.approx(0.2))] * 3
    assert [each for each in asked if isinstance(each, dict)] == [
        {"law": "published", "integrator": "euler", "trust": None},
        {"law": "information", "trust": None},
        {"law": "information"},
    ]
    lines = (tmp_path / "adp_initial_weights.csv").read_text().splitlines()
    assert lines == ["law,W0 = 0.1,W0 = 2.5,all", *(f"{law},0.75,0.25,0.5" for law in laws)]
    said = "regulated 0.5 of all, 0.25 at the worst W0, diverged 0.125"
    assert [" ".join(line.split()) for line in caplog.messages] == [f"{law} {said}" for law in laws]


TRACKED = ("experiment=adp_tracking", "dt=0.01", "adp.compile=false")


def tracked(rows: int = 2, identified: bool = True) -> Any:
    times = 4
    return SimpleNamespace(
        time=0.5 * torch.arange(times).double(),
        state=uniform(rows, times, 4, seed=1),
        identifier=uniform(rows, times, 9, seed=2) if identified else torch.zeros(rows, times, 0).double(),
        frozen_at=tensor([0.5, math.inf][:rows]),
        critic_weights=uniform(rows, times, 3, seed=3),
    )


def test_parameters_are_the_first_of_what_is_carried_and_errors_end_where_a_row_does() -> None:
    result = tracked()
    found = adp_tracking._parameters(result)
    assert found is not None
    assert torch.equal(found, result.identifier[..., :6].reshape(2, 4, 3, 2))
    assert adp_tracking._parameters(tracked(identified=False)) is None
    errors = adp_tracking._errors(result)
    lengths = result.state[..., :2].norm(dim=-1)
    torch.testing.assert_close(errors[1], lengths[1])
    torch.testing.assert_close(errors[0, :2], lengths[0, :2])  # at the time itself there is one
    assert bool(errors[0, 2:].isnan().all())


def test_a_tracked_path_is_drawn_by_its_first_row() -> None:
    results = {"known": tracked(identified=False), "identified": tracked()}
    parameters, theta = uniform(2, 4, 3, 2, seed=5), uniform(3, 2, seed=6)
    found = adp_tracking._drawn(results, parameters, theta)
    np.testing.assert_array_equal(found.parameters, parameters[0].reshape(4, 6).numpy())
    np.testing.assert_array_equal(found.truth, theta.flatten().numpy())
    np.testing.assert_array_equal(found.state, results["identified"].state[0].numpy())
    np.testing.assert_array_equal(found.critic_weights, results["identified"].critic_weights[0].numpy())
    assert found.time.tolist() == [0.0, 0.5, 1.0, 1.5]
    assert list(found.errors) == ["known", "identified"]
    np.testing.assert_array_equal(found.errors["known"], adp_tracking._errors(results["known"])[0].numpy())


def test_drifts_are_known_identified_or_kept_as_first_guessed() -> None:
    words = (
        "adp.critic=0.5",
        "adp.actor=0.25",
        "adp.gain=30",
        "adp.identification.gain=4",
        "adp.identification.size=9",
    )
    cfg = settings(*TRACKED, *words)
    plant, cost = adp.TwoStateTracking(), adp.tracking_cost(10.0, 1.0)
    found: dict[str, Any] = adp_tracking._controllers(cfg, plant, cost)
    known, identified, kept = found.values()
    assert list(found) == ["known", "identified", "unidentified"]
    assert identified.learner is kept.learner is known
    assert known.model is plant
    count = known.basis.count
    assert known.critic.flatten().tolist() == [0.5] * count
    assert known.actor.flatten().tolist() == [0.25] * count
    assert float(known.gain) == 30.0
    theta = torch.tensor(adp_tracking.plain(cfg.adp.identification.theta), dtype=torch.float64)
    x0 = uniform(2, 4, seed=1)
    for each, gain in ((identified, 4.0), (kept, 1e-300)):
        carried = each.init(x0)
        first = carried.identifier[:, :6].reshape(2, 3, 2)
        torch.testing.assert_close(first, theta.expand(2, 3, 2))
        learning = next(part for part in vars(each).values() if isinstance(part, adp.ConcurrentLearning))
        assert learning.gain == gain
        assert learning.size == 9


def test_a_tracking_run_has_three_loops_from_the_same_states(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[Any] = []
    pictures: list[Any] = []

    def simulate(controller: Any, plant: Any, cost: Any, x0: Tensor, **named: Any) -> Any:
        asked.append((controller, plant, cost, x0, named))
        result = tracked(identified=isinstance(controller, adp.IdentifyingTracker))
        for name in ("control", "actor_weights", "running_cost"):
            setattr(result, name, uniform(2, 4, 1, seed=9))
        return result

    def measured(result: Any, parameters: Any, theta: Tensor, best: Any) -> dict[str, float | None]:
        assert (parameters is None) == (result.identifier.shape[-1] == 0)
        assert theta.shape == (3, 2)
        return {"cost": float(best[0]), "a": 1.23456789, "b": None, "c": 2.0, "d": 3.0}

    monkeypatch.setattr(adp_tracking, "simulate", simulate)
    monkeypatch.setattr(adp_tracking, "tracking_metrics", measured)
    monkeypatch.setattr(adp_tracking, "_optimal_cost", lambda plant, cost, x0: tensor([5.0, math.nan]))
    monkeypatch.setattr(adp_tracking, "draw_tracking", pictures.append)
    monkeypatch.setattr(adp_tracking, "images", lambda figure: {"txt": b"drawn"})
    monkeypatch.setattr(
        adp_tracking, "animate", lambda scene, kind: pictures.append(scene) or {kind: b"moved"}
    )
    monkeypatch.setattr(adp_tracking, "tracking_scene", lambda controller, result: (controller, result))
    caplog.set_level("INFO")
    cfg = settings(
        *TRACKED, "duration=0.3", "trajectories=2", "seed=7", "figures=true", "history=true", "animation=html"
    )
    found = adp_tracking.run(cfg, tmp_path)
    names = ("known", "identified", "unidentified")
    parts = {"cost": 5.0, "a": 1.23456789, "b": None, "c": 2.0, "d": 3.0}
    assert found == {"optimal_cost": 5.0} | {
        f"{name}_{key}": part for name in names for key, part in parts.items()
    }
    assert len(asked) == 3
    for _, plant, _, x0, named in asked:
        assert plant is asked[0][1]
        assert torch.equal(x0, asked[0][3])
        assert x0.shape == (2, 4)
        assert named == {
            "dt": 0.01,
            "steps": 30,
            "seed": 7,
            "integrator": cfg.adp.integrator,
            "compile": False,
        }
    assert pictures[0][0] is asked[1][0]
    with np.load(tmp_path / "history.npz") as history:
        assert history["parameters"].shape == (2, 4, 3, 2)
        np.testing.assert_array_equal(history["state"], tracked().state.numpy())
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"tracking.html", "adp_tracking.txt"}
    assert len([line for line in caplog.messages if "over the optimum 1.235" in line]) == 3
    assert adp_tracking.run.animates is True
    other = tmp_path / "other"
    other.mkdir()
    monkeypatch.setattr(adp_tracking, "_optimal_cost", lambda plant, cost, x0: None)
    monkeypatch.setattr(adp_tracking, "tracking_metrics", lambda *given: dict.fromkeys("abcde"))
    bare = settings(*TRACKED, "duration=0.0001", "figures=false", "history=false", "dtype=float32")
    assert adp_tracking.run(bare, other)["optimal_cost"] is None
    assert asked[-1][-1]["steps"] == 1
    assert asked[-1][3].dtype == torch.float32
    assert [path.name for path in other.iterdir()] == ["metrics.json"]


def test_the_optimum_of_a_tracked_path_is_sought_from_the_lqr_of_its_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("scipy")
    asked: dict[str, Any] = {}

    class Shooting:
        def __init__(self, plant: Any, cost: Any, **named: Any) -> None:
            asked.update(named, plant=plant, cost=cost)

        def solve(self, x0: Tensor) -> Any:
            return SimpleNamespace(value=x0[:, 0])

    monkeypatch.setattr(adp_tracking, "DirectShooting", Shooting)
    plant, cost = adp.TwoStateTracking(), adp.tracking_cost(10.0, 1.0).float()
    found = adp_tracking._optimal_cost(plant, cost, torch.ones(2, 4))
    assert found is not None
    assert found.dtype == torch.float64
    assert (asked["horizon"], asked["intervals"]) == (8.0, 160)
    assert asked["cost"].q.dtype == torch.float64
    assert cost.q.dtype == torch.float32
    lqr = adp.LQR(systems.TwoState(), adp.QuadraticCost(10.0, 1.0, dim=2, inputs=1))
    x = uniform(3, 4, seed=1)
    torch.testing.assert_close(asked["base"](x), lqr(x[:, :2]), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(asked["terminal"](x), lqr.value(x[:, :2]), rtol=1e-5, atol=1e-6)

    def fails(*given: object) -> None:
        raise ValueError("no solver")

    monkeypatch.setattr(adp_tracking, "LQR", fails)
    assert adp_tracking._optimal_cost(plant, cost, torch.ones(2, 4)) is None
