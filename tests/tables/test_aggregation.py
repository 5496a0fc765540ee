"""From runs to rows: what is aggregated over what, against numbers by hand and SciPy, in which order."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from scipy.stats import t as student
from sweep_runs import BAD_COUNT, error, write_sweep

from staf_torch.results.reader import Collection, RecordedRun, collect
from staf_torch.results.run import MetricInfo
from staf_torch.tables import Layout, Style, Table, tabulate
from staf_torch.tables.aggregate import AGGREGATES, student_quantile

DIGITS = {"digits": MetricInfo("digits", larger_is_better=True, headline=True)}
PIVOT = Layout(
    rows=("kernel", "centers.radius"),
    columns=("centers.count",),
    metrics=("ball_error",),
    style=Style(bold=True),
)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    return collect(write_sweep(tmp_path_factory.mktemp("sweep") / "runs"))


def run(number: int, metrics: Mapping[str, float | None], **settings: Any) -> RecordedRun:
    about = {
        k: settings.pop(k) for k in ("status", "reason", "row", "declared", "build", "task") if k in settings
    }
    given = {"status": "completed", **about}
    return RecordedRun(Path(f"/runs/{number}"), settings, {"base": 1, **settings}, metrics, **given)


def of(*runs: RecordedRun) -> Collection:
    return Collection(runs, ())


def names(table: Table) -> list[str]:
    return list(table.names)


def shown(table: Table) -> list[tuple[str, str]]:
    return [(column.over, column.heading) for column in table.printed()]


def test_aggregates_are_over_what_is_in_neither_rows_nor_columns(found: Collection) -> None:
    layout = Layout(**{**PIVOT.__dict__, "aggregates": tuple(AGGREGATES)})
    table = tabulate(found, layout)
    assert len(table.rows) == 4
    row = table.rows[1].cells
    assert (row["kernel"], row["centers.radius"]) == ("exponential", 0.1)
    numbers = [error(0.1, 6, seed) for seed in range(3)]
    expected = {
        "mean": statistics.mean(numbers),
        "std": statistics.stdev(numbers),
        "ci95": student.ppf(0.975, 2) * statistics.stdev(numbers) / math.sqrt(3),
        "min": min(numbers),
        "max": max(numbers),
        "median": statistics.median(numbers),
    }
    for name, value in expected.items():
        assert row[f"ball_error.{name}[centers.count=6]"] == pytest.approx(value, rel=1e-12), name
    assert (row["ball_error.n[centers.count=6]"], row["ball_error.failed[centers.count=6]"]) == (3, 0)
    assert (row["ball_error.n[centers.count=7]"], row["ball_error.failed[centers.count=7]"]) == (0, 3)
    assert row["ball_error.mean[centers.count=7]"] is None
    assert row["reasons"] == BAD_COUNT


@pytest.mark.parametrize("option", ["rows", "columns", "metrics", "aggregates", "sort"])
def test_an_unknown_name_is_refused_with_those_that_exist(option: str, found: Collection) -> None:
    with pytest.raises(ValueError, match=r"must be one of .*; got 'ball_eror'") as raised:
        tabulate(found, Layout(**{option: ("ball_eror",)}))
    known = {"metrics": "ball_error", "aggregates": "ci95", "sort": "ball_error"}.get(option, "centers.count")
    assert known in str(raised.value)


@pytest.mark.parametrize("freedom", [1, 2, 3, 10, 99, 100, 199, 200, 201, 300, 1000, 10**6])
def test_quantile_of_students_t_is_exact(freedom: int) -> None:
    assert student_quantile(freedom) == pytest.approx(student.ppf(0.975, freedom), rel=1e-10)


def test_headlines_are_ours_in_their_order_then_those_of_ones_own_else_the_first_six_metrics() -> None:
    metrics = {"digits": 3.0, "other": 1.0, "cost": 1.0, "ball_error": 1.0}
    found = of(run(0, metrics, a=1, declared=DIGITS), run(1, metrics, a=2, declared=DIGITS))
    headlines = ["ball_error", "cost", "digits"]
    assert names(tabulate(found)) == ["a", *headlines, "status", "directory"]
    every = tabulate(found, Layout(every_metric=True))
    assert names(every) == ["a", *metrics, "status", "directory"]
    assert [c.name for c in every.columns if c.larger_is_better] == ["digits"]
    many = {f"m{k}": 1.0 for k in range(8)}
    assert names(tabulate(of(run(0, many), run(1, many, a=2))))[1:7] == [f"m{k}" for k in range(6)]
    named = tabulate(found, Layout(metrics=("other",), every_metric=True))
    assert names(named) == ["a", "other", "status", "directory"]


def test_rows_are_all_that_was_swept_but_the_seed_and_the_columns() -> None:
    found = of(
        *(run(s, {"cost": 1.0 + s}, a=a, b=b, seed=s) for a in (1, 2) for b in (True, "x") for s in (0, 1))
    )
    usual = tabulate(found, Layout(aggregates=("mean",), metrics=("cost",)))
    assert names(usual) == ["a", "b", "cost.mean", "cost.n", "cost.failed", "reasons"]
    assert [tuple(row.cells.values()) for row in usual.rows] == [
        (a, b, 1.5, 2, 0, None) for a in (1, 2) for b in (True, "x")
    ]
    spread = tabulate(found, Layout(columns=("b", "seed"), aggregates=("max",), metrics=("cost",)))
    places = ["b=true, seed=0", "b=x, seed=0", "b=true, seed=1", "b=x, seed=1"]  # texts as they came
    assert names(spread) == [
        "a",
        *(f"cost.{what}[{at}]" for at in places for what in ("max", "n", "failed")),
        "reasons",
    ]
    assert len(spread.rows) == 2
    assert "seed" in names(tabulate(found))
    assert names(tabulate(found, Layout(rows=("seed",), metrics=("cost",))))[:2] == ["seed", "cost.mean"]


def test_runs_of_different_builds_never_share_a_row() -> None:
    found = of(*(run(k, {"cost": 1.0}, a=k % 2, build=f"b{k // 2}") for k in range(4)))
    table = tabulate(found, Layout(rows=("a",)))
    assert names(table)[:2] == ["a", "build"]
    assert len(table.rows) == 4
    assert names(tabulate(found, Layout(rows=("a",), columns=("build",))))[:2] == ["a", "cost.mean[build=b0]"]
    assert names(tabulate(found, Layout(rows=("build", "a"))))[:3] == ["build", "a", "cost.mean"]


def test_what_is_missing_has_its_reason() -> None:
    found = of(
        run(0, {"cost": 1.0, "x": None}, a=1, b=1),
        run(1, {"cost": 2.0, "x": 3.0}, a=1, b=2),
        run(2, {}, a=2, b=1, status="failed", reason="broke"),
        run(3, {}, a=3, b=2, status="failed", reason="broke"),
        run(4, {"cost": 1.0}, a=3, b=2),
    )
    table = tabulate(
        found, Layout(rows=("a",), columns=("b",), aggregates=("mean", "std"), metrics=("cost", "x"))
    )
    reasons = [row.reasons for row in table.rows]
    assert reasons[0] == {
        "cost.std[b=1]": "needs two runs or more",
        "cost.std[b=2]": "needs two runs or more",
        "x.mean[b=1]": "not finite, or nothing to report",
        "x.std[b=1]": "not finite, or nothing to report",
        "x.std[b=2]": "needs two runs or more",
    }
    assert reasons[1]["cost.mean[b=1]"] == "broke"
    assert reasons[1]["cost.mean[b=2]"] == "there is no such run"
    assert reasons[2]["x.mean[b=2]"] == "broke; this run has no such metric"
    assert [row.cells["reasons"] for row in table.rows] == [
        "not finite, or nothing to report",
        "broke",
        "broke; this run has no such metric",
    ]
    counts = [(row.cells["cost.n[b=2]"], row.cells["cost.failed[b=2]"]) for row in table.rows]
    assert counts == [(1, 0), (0, 0), (1, 1)]


@pytest.mark.parametrize(("count", "said"), [(1, "/runs/0"), (3, "/runs/0, /runs/1, /runs/2"), (5, None)])
def test_a_note_names_three_runs_and_counts_the_others(count: int, said: str | None) -> None:
    failed = [run(k, {}, a=k, status="failed", reason="broke") for k in range(count)]
    table = tabulate(of(*failed, run(9, {"cost": 1.0}, a=9)), Layout(rows=("a",)))
    said = "/runs/0, /runs/1, /runs/2 and 2 more" if said is None else said
    assert table.notes == (f"{count} of {count + 1} failed: broke (in {said})",)


def test_a_setting_without_effect_is_told() -> None:
    def swept(cost: Any) -> tuple[str, ...]:
        settings = [(a, b) for a in (1, 2) for b in (1, 2)]
        return tabulate(
            of(*(run(k, {"cost": cost(*each)}, a=each[0], b=each[1]) for k, each in enumerate(settings)))
        ).notes

    def told(key: str) -> str:
        return f"`{key}` was swept and changed no metric in any row."

    assert swept(lambda a, b: 1.0 * a) == (told("b"),)
    assert swept(lambda a, b: 1.0 * b) == (told("a"),)
    assert swept(lambda a, b: 1.0) == (told("a"), told("b"))
    assert swept(lambda a, b: 1.0 * a * b) == swept(lambda a, b: float(a == b == 2)) == ()
    apart = of(run(0, {"cost": 1.0}, a=1, b=1), run(1, {"cost": 1.0}, a=2, b=2))  # nothing to compare
    assert tabulate(apart).notes == ()
    assert tabulate(of(run(0, {"cost": 1.0}, a=1), run(1, {}, a=2))).notes == ()


@pytest.mark.parametrize(
    ("sort", "order"),
    [
        (("cost",), [2, 0, 1, 3]),
        (("cost:desc",), [1, 0, 2, 3]),
        (("digits",), [0, 2, 1, 3]),
        (("digits:asc",), [1, 2, 0, 3]),
        (("digits:desc",), [0, 2, 1, 3]),
        (("word",), [0, 2, 3, 1]),
        (("word:desc",), [1, 3, 0, 2]),
        (("word", "cost"), [2, 0, 3, 1]),
        ((), [0, 1, 2, 3]),
    ],
)
def test_the_best_of_a_metric_is_first_numbers_before_texts_and_what_is_missing_last(
    sort: tuple[str, ...], order: list[int]
) -> None:
    rows = [(2.0, 9.0, 1), (3.0, 7.0, "z"), (1.0, 8.0, 1.0), (None, None, "b")]
    found = of(
        *(run(k, {"cost": c, "digits": d}, a=k, word=w, declared=DIGITS) for k, (c, d, w) in enumerate(rows))
    )
    assert [row.cells["a"] for row in tabulate(found, Layout(sort=sort, every_metric=True)).rows] == order


def test_a_metric_is_sorted_by_its_first_statistic() -> None:
    found = of(
        *(run(k, {"cost": c}, a=a) for k, (a, c) in enumerate([(1, 5.0), (1, 1.0), (2, 2.0), (3, 4.0)]))
    )
    table = tabulate(found, Layout(rows=("a",), aggregates=("min", "max"), sort=("cost",)))
    assert [row.cells["a"] for row in table.rows] == [1, 2, 3]
    table = tabulate(found, Layout(rows=("a",), aggregates=("min", "max"), sort=("cost.max:desc",)))
    assert [row.cells["a"] for row in table.rows] == [1, 3, 2]
    with pytest.raises(ValueError, match=r"`staf-table --sort` must be one of a, cost.min, .*; got 'b'"):
        tabulate(found, Layout(rows=("a",), aggregates=("min",), sort=("b",)))
