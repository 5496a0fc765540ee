"""Which panels, curves and points a sweep has, from runs that differ in one setting or another."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from sweep_runs import write_run

from staf_torch.figures import sweep
from staf_torch.results.reader import Collection, collect

Given = tuple[Mapping[str, Any], Mapping[str, float | None]]
RADIUS, COUNT, STEPS = "centers.radius", "centers.count", "optimizer.inner_steps"


@pytest.fixture
def runs(tmp_path: Path) -> Any:
    def written(given: Sequence[Given]) -> Collection:
        for num, (settings, metrics) in enumerate(given):
            write_run(tmp_path / f"{num:02}", settings, metrics)
        return collect(tmp_path)

    return written


def errors(**points: float) -> dict[str, float]:
    return {"ball_error": points.get("error", 0.5), "products_per_second": points.get("work", 10.0)}


def test_runs_without_a_positive_error_are_in_no_panel(runs: Any) -> None:
    numbers = (0.5, None, 0.0, -1.0, 0.25)
    found = runs([({RADIUS: 0.1 * (k + 1)}, {"ball_error": number}) for k, number in enumerate(numbers)])
    ((curve,),) = (panel.curves for panel in sweep.error_against_radius(found))
    assert curve.label == "3 centers"
    assert [(round(point.x, 9), point.middle) for point in curve.points] == [(0.1, 0.5), (0.5, 0.25)]
    assert curve.floor == ()
    assert sweep.rounding_floor(found) is None
    assert sweep.heat_maps(found) == []
    assert sweep.cost_against_accuracy(found) == []


@pytest.mark.parametrize(
    ("swept", "titles"),
    [
        ({"kernel": ("matern", "gaussian")}, ["Matérn kernel", "Gaussian kernel"]),
        ({"kernel": (None,)}, [""]),
        (
            {"kernel": ("custom",), "kernel.path": ("mine.Cauchy", "__main__.Own")},
            ["Cauchy kernel", "Own kernel"],
        ),
        (
            {"kernel": ("inverse_multiquadric", "other"), "centers": ("rings", "ball")},
            [
                f"{kernel} kernel, centers = {layout}"
                for kernel in ("inverse multiquadric", "other")
                for layout in ("rings", "ball")
            ],
        ),
    ],
)
def test_a_panel_is_named_by_all_that_was_swept_beside_it(
    swept: Mapping[str, Sequence[Any]], titles: list[str], runs: Any
) -> None:
    rows: list[dict[str, Any]] = [{}]
    for key, values in swept.items():
        rows = [row | {key: value} for row in rows for value in values]
    found = runs([(row | {RADIUS: r}, errors(error=r)) for row in rows for r in (0.1, 0.2)])
    assert [panel.title for panel in sweep.error_against_radius(found)] == titles
    assert all(len(panel.curves[0].points) == 2 for panel in sweep.error_against_radius(found))


def test_seeds_are_one_point_with_the_interval_of_students_t(runs: Any) -> None:
    given = [({RADIUS: r, "seed": s}, errors(error=r * math.exp(s))) for r in (0.1, 0.2) for s in (0, 1)]
    (panel,) = sweep.error_against_radius(runs(given))
    for point, r in zip(panel.curves[0].points, (0.1, 0.2), strict=True):
        half = 12.706204736174694 / 2  # t of one degree of freedom; s = 1 / sqrt(2), over sqrt(2)
        assert point.x == r
        assert point.middle == pytest.approx(r * math.exp(0.5))
        assert point.low == pytest.approx(r * math.exp(0.5 - half))
        assert point.high == pytest.approx(r * math.exp(0.5 + half))


def test_radii_are_panels_where_laws_differ_and_lines_where_they_do_not(runs: Any) -> None:
    given = [
        ({"optimizer": law, RADIUS: r, STEPS: k}, errors(error=r / k, work=k))
        for law in ("a", "b")
        for r in (0.1, 0.2)
        for k in (1, 2)
    ]
    found = runs(given)
    panels = sweep.cost_against_accuracy(found)
    assert [panel.title for panel in panels] == ["centers.radius = 0.1", "centers.radius = 0.2"]
    assert [[curve.label for curve in panel.curves] for panel in panels] == [["a", "b"]] * 2
    (one,) = sweep.cost_against_accuracy(dataclasses.replace(found, rows=found.rows[:4]))
    assert [curve.label for curve in one.curves] == ["$r$ = 0.1", "$r$ = 0.2"]
    assert [len(curve.points) for curve in one.curves] == [2, 2]


@pytest.mark.parametrize("counts", [(3,), (3, 6)])
def test_work_is_counted_in_products_or_where_centers_were_swept_in_multiplications(
    counts: tuple[int, ...], runs: Any
) -> None:
    given = [
        ({COUNT: c, STEPS: k, "seed": s}, errors(error=1.0 + k + s, work=10.0 * k))
        for c in counts
        for k in (1, 2)
        for s in (0, 1)
    ]
    given.append(({COUNT: 3, STEPS: 9}, {"ball_error": 1.0, "products_per_second": None}))
    found = runs(given)
    ((curve,),) = (panel.curves for panel in sweep.cost_against_accuracy(found))
    work = sorted(10.0 * k * (c**2 if len(counts) > 1 else 1) for c in counts for k in (1, 2))
    assert [point.x for point in curve.points] == work
    assert all(point.low < point.middle < point.high for point in curve.points)
    figure = sweep.cost_figure(found)
    assert figure is not None
    words = "multiplications" if len(counts) > 1 else "products with $K$"
    assert figure.axes[0].get_xlabel() == f"{words} a simulated second"


def test_a_sweep_of_nothing_that_a_figure_shows_has_none(runs: Any) -> None:
    found = runs([({"dt": dt}, {"ball_error": 1.0}) for dt in (0.1, 0.2)])
    assert [draw(found) for _, draw in sweep.SWEEP_FIGURES.values()] == [None, None, None]
