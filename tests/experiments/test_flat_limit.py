"""`experiment=flat_limit`: its own reference, its numbers, its files and its figure."""

from __future__ import annotations

import csv
import io
import json
import math
from decimal import Decimal
from pathlib import Path

import composing
import mpmath as mp
import pytest
import torch
from helpers import tensor, uniform
from omegaconf import DictConfig
from truth import Truth, paper

import staf_torch as st
from staf_torch.experiments import flat_limit
from staf_torch.figures.theory import ErrorPanel, draw_errors


def settings(*overrides: str) -> DictConfig:
    return composing.settings("experiment=flat_limit", *overrides)


@pytest.mark.parametrize("count", [1, 3, 6, 15])
@pytest.mark.parametrize("radius", [1e-8, 1e-3, 0.5])
@pytest.mark.parametrize("width", [None, 0.8])
def test_reference_agrees_with_another_implementation_to_25_digits(
    count: int, radius: float, width: float | None
) -> None:
    directions = st.polygon(1) if count == 1 else st.rings(count)
    x, zeta = uniform(2, seed=count), uniform(3, 2, low=-0.7, high=0.7, seed=7)
    found = flat_limit.interpolant(directions, radius, x, zeta, width)
    truth = Truth(directions, radius, x, paper, width)
    for value, z in zip(found, zeta, strict=True):
        expected = Decimal(mp.nstr(truth.value(z), 40))
        assert abs(value - expected) <= Decimal("1e-25") * abs(expected)


def test_relative_error_is_infinite_where_a_value_is_not_a_number() -> None:
    truth = [Decimal(2), Decimal(-4)]
    assert flat_limit.relative_error(tensor([2.0, -3.0]), truth) == 0.25
    assert flat_limit.relative_error(tensor([2.0, math.nan]), truth) == math.inf


@pytest.fixture(scope="module")
def samples() -> list[flat_limit.Sample]:
    return flat_limit.solve(
        flat_limit.problem_of(settings("flat_limit.radii.per_decade=1", "flat_limit.counts=[3,6,15]"))
    )


def error(samples: list[flat_limit.Sample], method: str, dtype: str, centers: int, radius: float) -> float:
    (found,) = [
        s
        for s in samples
        if (s.dtype, s.centers) == (dtype, centers) and math.isclose(s.radius, radius, rel_tol=1e-6)
    ]
    return found.error[method]


def test_graded_basis_keeps_all_digits_at_every_radius(samples: list[flat_limit.Sample]) -> None:
    for sample in samples:
        assert sample.error["graded"] <= {"float64": 5e-15, "float32": 5e-7}[sample.dtype]


@pytest.mark.parametrize(
    ("method", "centers", "radius", "expected"),
    [
        ("cholesky", 3, 1e-6, 3e-10),
        ("cholesky", 6, 1e-1, 3e-13),
        ("cholesky", 6, 1e-3, 4e-9),
        ("cholesky", 15, 1e-1, 2e-10),
        ("jitter", 3, 1e-1, 9e-12),
        ("jitter", 3, 1e-6, 5e-7),
        ("jitter", 6, 1e-1, 7e-10),
        ("jitter", 6, 1e-3, 2e-6),
        ("jitter", 6, 1e-6, 4e-7),
        ("jitter", 15, 1e-1, 5e-7),
        ("jitter", 15, 1e-6, 2e-7),
        ("pivoted", 3, 1e-6, 3e-10),
        ("pivoted", 6, 1e-3, 3e-9),
        ("pivoted", 6, 1e-6, 3e-10),
        ("pivoted", 15, 1e-2, 2e-8),
    ],
)
def test_other_methods_lose_what_the_reference_says(
    samples: list[flat_limit.Sample], method: str, centers: int, radius: float, expected: float
) -> None:
    # Rounding error is a random number, and another state gives another one: a factor of 5 either way.
    assert expected / 5 <= error(samples, method, "float64", centers, radius) <= 5 * expected


@pytest.mark.parametrize(
    ("dtype", "centers", "fails", "works"),
    [
        ("float64", 6, 1e-5, 1e-3),
        ("float64", 15, 1e-3, 1e-1),
        ("float32", 3, 1e-4, 1e-3),
        ("float32", 6, 1e-2, 1e-1),
        ("float32", 15, 1e-1, 0.5),
    ],
)
def test_plain_cholesky_fails_below_its_radius(
    samples: list[flat_limit.Sample], dtype: str, centers: int, fails: float, works: float
) -> None:
    assert error(samples, "cholesky", dtype, centers, fails) == math.inf
    assert math.isfinite(error(samples, "cholesky", dtype, centers, works))
    found = flat_limit.summary(samples)
    assert fails <= found[f"cholesky_fails_at_{dtype}_{centers}"] * (1 + 1e-6) < works
    assert found[f"cholesky_error_{dtype}_{centers}"] is None
    assert found[f"graded_fails_at_{dtype}_{centers}"] is None


@pytest.mark.parametrize("kernel", ["kernel=exponential", "kernel=gaussian"])
def test_run_directory_holds_table_figure_and_metrics(kernel: str, tmp_path: Path) -> None:
    cfg = settings(kernel, "figures=false", "flat_limit.counts=[3,6]", "flat_limit.radii.smallest=1e-3")
    returned = flat_limit.run(cfg, tmp_path)
    files = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert files == {"metrics.json", "flat_limit.md", "flat_limit.csv"}
    metrics = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert metrics == returned
    assert metrics["graded_error_float64"] <= 5e-15
    assert metrics["graded_error_float32"] <= 5e-7
    rows = list(csv.DictReader(io.StringIO((tmp_path / "flat_limit.csv").read_text())))
    assert len(rows) == 2 * 2 * 15  # 1e-3 to 10^-0.4 by fifths of a decade, and 0.5
    of64 = [float(row["graded"]) for row in rows if row["dtype"] == "float64"]
    assert max(of64) == metrics["graded_error_float64"]
    assert "fails" in (tmp_path / "flat_limit.md").read_text()


def test_figure_marks_failures_and_leaves_a_gap_there() -> None:
    panel = ErrorPanel(
        "3 centers", 2e-16, [1e-3, 1e-2, 1e-1], {"one": [math.inf, 1e-3, 1e-9], "two": [0.0, 1e-16, 1e-15]}
    )
    figure = draw_errors([panel, panel], rows=2)
    axes = figure.axes[0]
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert math.isnan(lines["one"].get_ydata()[0])
    marks = [line for line in axes.get_lines() if line.get_marker() == "x" and len(line.get_xdata()) == 1]
    assert [list(line.get_xdata()) for line in marks] == [[1e-3]]
    low, high = axes.get_ylim()
    assert low < min(lines["two"].get_ydata()) < 2e-16  # the exact result is seen at the bottom
    assert marks[0].get_ydata()[0] < high


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("kernel=matern", r"`staf kernel=...` must be exponential or gaussian"),
        ("target=quadratic", r"`staf target=...` must be paper"),
        ("flat_limit.counts=[]", r"`staf flat_limit.counts=...` must not be empty"),
        ("flat_limit.counts=[0]", r"`staf flat_limit.counts=...` must be at least 1"),
        ("flat_limit.counts=[7]", r"rings"),
        ("flat_limit.radii.smallest=1", r"`staf flat_limit.radii.smallest=...` must be at least 1e-30"),
        ("flat_limit.radii.per_decade=0", r"`staf flat_limit.radii.per_decade=...` must be at least 1"),
        ("figures=1", r"`staf figures=...` must be true or false"),
    ],
)
def test_wrong_settings_are_named_before_anything_is_written(
    override: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        flat_limit.run(settings(override), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_blocks_of_rows_change_nothing() -> None:
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 0.1))
    x = uniform(3, 2000, 2, seed=1).requires_grad_()
    values = uniform(2, 1, 2000, 6, seed=2)  # broadcasts against the states
    together = basis.local(x).fit(values)
    assert together.shape == (2, 3, 2000, 6)
    torch.testing.assert_close(together[1, 2], basis.local(x[2]).fit(values[1, 0]), rtol=1e-13, atol=1e-14)
    (slope,) = torch.autograd.grad(together[:, 1, 40:50].sum(), x)
    assert bool((slope[1, 40:50] != 0).all())
    assert float(slope.norm()) == pytest.approx(float(slope[1, 40:50].norm()))
