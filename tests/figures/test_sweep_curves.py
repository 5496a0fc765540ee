"""Which panels, curves and points a sweep has, from runs that differ in one setting or another."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from sweep_runs import write_run

from staf_torch.figures import sweep
from staf_torch.results.reader import Collection, collect

Given = tuple[Mapping[str, Any], Mapping[str, float | None]]
RADIUS = "centers.radius"


@pytest.fixture
def runs(tmp_path: Path) -> Any:
    def written(given: Sequence[Given]) -> Collection:
        for num, (settings, metrics) in enumerate(given):
            write_run(tmp_path / f"{num:02}", settings, metrics)
        return collect(tmp_path)

    return written


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


def test_seeds_are_one_point_with_the_interval_of_students_t(runs: Any) -> None:
    given = [({RADIUS: r, "seed": s}, {"ball_error": r * math.exp(s)}) for r in (0.1, 0.2) for s in (0, 1)]
    (panel,) = sweep.error_against_radius(runs(given))
    for point, r in zip(panel.curves[0].points, (0.1, 0.2), strict=True):
        half = 12.706204736174694 / 2  # t of one degree of freedom; s = 1 / sqrt(2), over sqrt(2)
        assert point.x == r
        assert point.middle == pytest.approx(r * math.exp(0.5))
        assert point.low == pytest.approx(r * math.exp(0.5 - half))
        assert point.high == pytest.approx(r * math.exp(0.5 + half))


def test_a_sweep_of_nothing_that_a_figure_shows_has_none(runs: Any) -> None:
    found = runs([({"dt": dt}, {"ball_error": 1.0}) for dt in (0.1, 0.2)])
    assert [draw(found) for _, draw in sweep.SWEEP_FIGURES.values()] == [None, None, None]
