"""Rows, curves, promises and words of the experiment `laws`, of numbers made up."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from recorded import Record
from torch import Tensor

from staf_torch import optim, predictors
from staf_torch.experiments import laws
from staf_torch.experiments.laws import Case, Curve
from staf_torch.settings.chase import chase_problem

WORDS = ("ultimate_excess_before", "ultimate_excess", "step", "iterations", "paper_step")
PROMISED = [f"a_priori.{word}" for word in WORDS]
SHORT = ("dt=0.05", "duration=1.0", "settle_time=0.5")


@pytest.mark.parametrize(("work", "count"), [(2, 3), (4, 3), (11, 3), (11, 2), (30, 12)])
def test_the_rows_of_laws_are_the_recorded_ones(work: int, count: int, record: Record) -> None:
    found = laws.cases(work, count)
    record({"rows": " | ".join(f"{case.key}: {case.products}" for case in found)})
    assert all(case.iterations <= max(work - 1, 2) for case in found)
    plain = [case for case in found if case.predictor is None]
    assert all(case.products == case.law.products(count, case.iterations) for case in plain)
    for case in found[len(plain) :]:
        assert case.predictor is not None
        extra = case.predictor.products(count)
        assert case.products == case.law.products(count, case.iterations) + extra
    shown = laws.curves(work, count)
    keys = [case.key for case in shown]
    assert keys == [case.key for case in found if case.key in keys]
    paper = "steepest_descent_x1" if work == 2 else f"steepest_descent_x{work - 1}"
    assert {paper, "exact_x1", "exact_x1_secant", "exact_x1_tangent_order_2"} <= {case.key for case in shown}
    assert all(case.iterations == 1 for case in shown if case.predicted.startswith("tangent"))


def test_a_case_is_called_by_its_law_its_iterations_and_its_predictor() -> None:
    case = Case(optim.PreconditionedDescent("jacobi"), 3, predictors.Tangent(order=1), 7)
    assert (case.name, case.predicted) == (case.law.title, "tangent order 1")
    assert (
        case.key
        == f"{case.law.title} x3 tangent order 1".replace("(", "").replace(")", "").replace(" ", "_").lower()
    )
    bare = Case(optim.Exact(), 1, None, 2)
    assert (bare.key, bare.predicted) == ("exact_x1", "none")


def test_every_case_runs_with_its_own_law_and_its_work_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def solve(problem: Any, *, errors: Any) -> Any:
        asked.append((problem, errors))
        return SimpleNamespace(metrics={"ultimate_excess_before": problem.dt**2, "b": 5.0})

    monkeypatch.setattr(laws, "solve", solve)
    problem = chase_problem(settings(*SHORT))
    some = laws.cases(4, 3)[-2:]
    errors: Any = "errors"
    rows = laws.table(problem, some, errors)
    for row, case, (ran, given) in zip(rows, some, asked, strict=True):
        assert (ran.law, ran.inner_steps, ran.predictor, given) == (
            case.law,
            case.iterations,
            case.predictor,
            "errors",
        )
        assert (ran.dt, ran.steps) == (problem.dt, problem.steps)
        assert row == {
            **{"key": case.key, "law": case.name, "iterations": case.iterations, "predictor": case.predicted},
            **{
                "products": pytest.approx(case.products * 20),
                "ultimate_excess_before": pytest.approx(0.0025),
                "b": 5.0,
            },
        }
    asked.clear()
    steps = [0.3, 0.1, 0.05]
    curves = laws.sweep(problem, some, steps, errors)
    assert [(ran.dt, ran.steps) for ran, _ in asked] == [(0.3, 3), (0.1, 10), (0.05, 20)] * 2
    assert all(ran.law is some[0].law for ran, _ in asked[:3])
    assert curves[0].excess == pytest.approx([0.09, 0.01, 0.0025])
    assert curves[1].slope == pytest.approx(2.0)
    assert [curve.case for curve in curves] == some


@pytest.mark.parametrize(("steps", "fits"), [([1.0, 0.5], True), ([1.01, 0.5], False), ([0.5], False)])
def test_two_steps_within_the_duration_are_needed(steps: list[float], fits: bool) -> None:
    cfg = settings("experiment=laws", *SHORT, f"laws.steps={steps}")
    problem = chase_problem(cfg)
    if fits:
        assert laws._steps(cfg, problem) == steps
        return
    with pytest.raises(ValueError, match=r"must be two or more steps within the duration \(1 s\)"):
        laws._steps(cfg, problem)


def test_promises_are_those_of_the_theory_at_some_of_the_states(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    problem = chase_problem(settings(*SHORT, "trajectories=3", "optimizer.inner_steps=5"))
    asked: dict[str, Any] = {}

    def drift_constants(basis: Any, target: Any, states: Tensor, velocities: Tensor) -> str:
        asked["states"], asked["velocities"] = states, velocities
        return "constants"

    def named(name: str, value: Any) -> Any:
        return lambda *given, **words: asked.update({name: (given, words)}) or value

    monkeypatch.setattr(laws, "_STATES", 20)
    monkeypatch.setattr(laws.theory, "drift_constants", drift_constants)
    monkeypatch.setattr(laws.theory, "ultimate_bound", named("bound", SimpleNamespace(before=2.0, after=1.0)))
    monkeypatch.setattr(laws.theory, "step_for_bound", named("step", 0.25))
    monkeypatch.setattr(laws.theory, "steps_for_bound", named("iterations", math.inf))
    monkeypatch.setattr(laws.theory, "paper_step", named("paper", SimpleNamespace(dt=0.125)))
    found = laws.promises(problem, 1e-3)
    assert found == {
        **{"a_priori.ultimate_excess_before": 2.0, "a_priori.ultimate_excess": 1.0, "a_priori.step": 0.25},
        **{"a_priori.iterations": None, "a_priori.paper_step": 0.125},
    }
    assert len(asked["states"]) == 16  # 63 states, every fourth: no more than 20
    torch.testing.assert_close(asked["states"][0], problem.initial_states[0])
    torch.testing.assert_close(asked["velocities"], problem.system.drift(asked["states"]))
    assert asked["bound"][1] == {"dt": 0.05, "inner_steps": 5}
    assert asked["step"][1] == {"excess": 1e-3, "inner_steps": 5}
    assert asked["iterations"][1] == {"excess": 1e-3, "dt": 0.05}
    assert asked["paper"][1] == {"excess": 1e-3}
    assert all(
        isinstance(asked[name][0][1], optim.SteepestDescent) for name in ("bound", "step", "iterations")
    )

    def fails(*given: object) -> None:
        raise ValueError("no constants")

    monkeypatch.setattr(laws.theory, "drift_constants", fails)
    assert laws.promises(problem, 1e-3) == {}
    assert caplog.messages == ["no a-priori bound: no constants"]


def curve(predictor: Any, slope: float | None) -> Curve:
    return Curve(Case(optim.Exact(), 2, predictor, 3), [0.5, None], slope)


def test_curves_are_labelled_and_have_a_gap_where_there_is_no_number() -> None:
    first, second = laws._lines([curve(None, 2.0), curve(predictors.Secant(), None)], [0.1, 0.2])
    assert (first.label, second.label) == ("exact x2", "exact x2, secant")
    np.testing.assert_array_equal(first.excess, [0.5, np.nan])
    assert first.step.tolist() == [0.1, 0.2]
    assert (first.slope, second.slope) == (2.0, None)


@pytest.mark.parametrize("promised", [True, False])
def test_laws_are_summed_up_in_words(promised: bool, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    numbers: dict[str, float | None] = {name: 1.2345 * 10**k for k, name in enumerate(PROMISED)}
    numbers["a_priori.step"] = None
    swept = [curve(None, 2.341), curve(predictors.Secant(), None)]
    problem = chase_problem(settings(*SHORT, "optimizer.inner_steps=5"))
    laws._summarise(problem, "one\ntwo", swept, numbers if promised else {}, 0.001)
    assert caplog.messages[:4] == [
        f"Worst over t >= 0.5 s, dt = 0.05 s, {problem.basis.count} centers:",
        *("one", "two", "Excess before the correction ~ dt^slope:"),
    ]
    assert caplog.messages[4].split() == ["exact", "x2", "none", "2.34"]
    assert caplog.messages[5].split() == ["exact", "x2", "secant", "-"]
    if promised:
        assert caplog.messages[6] == (
            "A priori bound, steepest descent x5 at dt = 0.05 s: "
            "excess 1.23 before and 12.3 after the correction"
        )
        assert caplog.messages[7] == (
            "For an excess of 0.001: dt = none s, or 1.23e+03 iterations; "
            "by the paper's own constants, dt = 1.23e+04 s"
        )
    assert len(caplog.messages) == (8 if promised else 6)


def test_a_run_of_laws_leaves_rows_and_slopes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}
    row = {
        "key": "exact_x1",
        "law": "exact",
        "iterations": 1,
        "predictor": "none",
        "products": 2.0,
        "ball_error": None,
    }

    class Errors:
        def __init__(self, basis: object, target: object, expected: int) -> None:
            asked["expected"] = expected

    def table(problem: Any, compared: Any, errors: Any, progress: Any) -> Any:
        asked["table"] = problem.certificate, [case.key for case in compared], errors
        return [row]

    def sweep(problem: Any, drawn: Any, steps: Any, errors: Any, progress: Any) -> Any:
        asked["sweep"] = [case.key for case in drawn], steps
        return [curve(None, 2.5)]

    monkeypatch.setattr(laws, "StateErrorPass", Errors)
    monkeypatch.setattr(laws, "table", table)
    monkeypatch.setattr(laws, "sweep", sweep)
    monkeypatch.setattr(laws, "promises", lambda problem, excess: dict.fromkeys(PROMISED, excess))
    monkeypatch.setattr(laws, "draw_convergence", lambda lines: asked.update(lines=lines))
    monkeypatch.setattr(laws, "images", lambda figure: {"txt": b"drawn"})
    words = ("laws.steps=[0.1,0.2]", "laws.work=4", "laws.excess=0.25", "trajectories=2")
    cfg = settings("experiment=laws", *SHORT, *words)
    found = laws.run(cfg, tmp_path)
    assert found == {
        **{"exact_x1.iterations": 1.0, "exact_x1.products": 2.0, "exact_x1.ball_error": None},
        **{"exact_x2.slope": 2.5},
        **dict.fromkeys(PROMISED, 0.25),
    }
    certified, keys, errors = asked["table"]
    assert certified is True
    assert isinstance(errors, Errors)
    count = chase_problem(cfg).basis.count
    assert keys == [case.key for case in laws.cases(4, count)]
    drawn = laws.curves(4, count)
    assert asked["sweep"] == ([case.key for case in drawn], [0.1, 0.2])
    assert asked["expected"] == int((len(keys) + len(drawn) * (0.5 + 0.25)) * 20) * 2
    text = (tmp_path / "laws.json").read_text()
    assert json.loads(text) == [row]
    assert text.startswith('[\n  {\n    "key": "exact_x1",\n')
    assert (tmp_path / "laws.csv").read_text().splitlines()[
        0
    ] == "law,iterations,predictor,products,ball_error"
    assert "products/s" in (tmp_path / "laws.md").read_text()
    assert asked["lines"][0].step.tolist() == [0.1, 0.2]
    other = tmp_path / "other"
    other.mkdir()
    laws.run(settings("experiment=laws", *SHORT, *words, "figures=false"), other)
    assert not (other / "figures").exists()
    row["products"], lost = math.nan, tmp_path / "lost"
    lost.mkdir()
    with pytest.raises(ValueError, match="JSON compliant"):
        laws.run(settings("experiment=laws", *SHORT, *words, "figures=false"), lost)
    assert not (lost / "laws.json").exists()
