"""Rows, tables and pictures of bounds, layouts and what is feasible, of numbers made up."""

from __future__ import annotations

import csv
import io
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

from staf_torch import theory
from staf_torch.experiments import exponential_bound, feasibility, laws, layouts
from staf_torch.experiments.comparison import Comparison
from staf_torch.experiments.registry import log_slope
from staf_torch.results.progress import Progress
from staf_torch.results.run_directory import RunDirectory


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_layouts_of_every_dimension_are_the_recorded_ones(dim: int, record: Record) -> None:
    found = layouts.layouts(dim)
    record({"layouts": " | ".join(f"{each.family} {len(each.directions)} {each.order}" for each in found)})
    for each in found:
        assert each.directions.shape[1] == dim
        assert len(each.directions) <= 130
        if each.family in ("ball", "rings"):
            degree = each.order - 1
            assert len(each.directions) == math.comb(dim + degree, dim)


def test_layout_errors_are_the_worst_of_the_states_and_slopes_above_rounding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    radii, count = [0.1, 0.2, 0.4], len(layouts.layouts(2))

    def layout_errors(
        target: Any, kernel: Any, states: Tensor, radius: float, shapes: list[Tensor]
    ) -> Tensor:
        assert len(shapes) == count
        worst = radius**3 * torch.arange(1, count + 1).double()
        worst[0] = 100 * 2.0**-52 * 8.0 if radius < 0.15 else radius**2  # no more than a hundred roundings
        return torch.stack((0.5 * worst, worst), dim=-1)

    monkeypatch.setattr(theory, "layout_errors", layout_errors)
    problem: Any = SimpleNamespace(
        states=tensor([[1.0, 0.0], [2.0, 0.0]]), target=lambda x: -4 * x[:, 0], kernel=None, radius=0.3
    )
    found = layouts.solve(problem, radii)
    assert len(found) == count
    assert found[0].slope == pytest.approx(2.0)
    assert found[1].slope == pytest.approx(3.0)
    assert found[3].error == pytest.approx(4 * 0.3**3)
    np.testing.assert_allclose(found[3].errors, [4 * radius**3 for radius in radii])
    assert [each.centers for each in found] == [len(each.directions) for each in layouts.layouts(2)]
    rows = layouts._rows(found[3:4], radii)
    assert rows == [
        {
            **{
                "layout": "rings",
                "count": 15,
                "error": pytest.approx(0.108),
                "order": 5,
                "slope": found[3].slope,
            },
            **{f"r{radius:g}": pytest.approx(4 * radius**3) for radius in radii},
        }
    ]


def test_the_smallest_count_is_the_first_that_is_good_at_every_state(tmp_path: Path) -> None:
    counts = torch.tensor([3, 6, 10])
    errors = tensor([[[0.5, 0.05, 0.005], [0.05, 0.05, 0.05], [0.005, 0.5, 0.005]], [[9.0] * 3] * 3])
    needed = feasibility.Needed(
        counts,
        errors,
        torch.tensor([[[6, 3, 3], [10, 0, 3]], [[0, 0, 0], [0, 0, 0]]]),
        torch.tensor([[6, 0], [0, 0]]),
    )
    found = feasibility._write(RunDirectory(tmp_path), needed, [0.1, 0.2], [0.1, 0.01])
    assert found == {
        "r0.1.eps0.1.count": 6,
        "r0.1.eps0.01.count": None,
        "r0.2.eps0.1.count": None,
        "r0.2.eps0.01.count": None,
    }
    rows = list(csv.DictReader(io.StringIO((tmp_path / "feasibility.csv").read_text())))
    assert list(rows[0].values()) == ["0.1", "0.1", "6", "3", "0.05"]
    assert list(rows[1].values()) == ["0.1", "0.01", "", "", ""]  # at one state none does
    lines = (tmp_path / "feasibility.md").read_text().splitlines()
    assert [cell.strip() for cell in lines[0].split("|")[1:-1]] == ["r", "eps = 0.1", "eps = 0.01"]
    problem: Any = SimpleNamespace(time=tensor([0.0, 0.5, 1.0]), states=uniform(3, 2, seed=1), radius=0.1)
    table = feasibility._pointwise(problem, needed.pointwise[0], [0.1, 0.01]).csv().splitlines()
    assert table[0] == "time,x1,x2,eps0.1,eps0.01"
    assert [line.split(",")[3:] for line in table[1:]] == [["6", "10"], ["3", ""], ["3", "3"]]
    assert [float(line.split(",")[0]) for line in table[1:]] == [0.0, 0.5, 1.0]
    drawn = feasibility._drawn(problem, needed, [0.1, 0.2], [0.1, 0.01])
    np.testing.assert_array_equal(drawn.pointwise, needed.pointwise[0].numpy())
    assert (drawn.radius, drawn.radii.tolist(), drawn.epsilons.tolist()) == (0.1, [0.1, 0.2], [0.1, 0.01])
    np.testing.assert_array_equal(drawn.state, problem.states.numpy())
    np.testing.assert_array_equal(drawn.overall, needed.overall.numpy())
    np.testing.assert_array_equal(drawn.counts, [3, 6, 10])
    np.testing.assert_array_equal(drawn.time, [0.0, 0.5, 1.0])


def test_what_is_needed_is_counted_for_every_radius_and_epsilon(monkeypatch: pytest.MonkeyPatch) -> None:
    def layout_errors(
        target: Any, kernel: Any, states: Tensor, radius: float, shapes: list[Tensor]
    ) -> Tensor:
        (shape,) = shapes
        return (radius / len(shape) * states[:, 0]).unsqueeze(0)

    monkeypatch.setattr(theory, "layout_errors", layout_errors)
    problem: Any = SimpleNamespace(states=tensor([[1.0, 0.0], [2.0, 0.0]]), target=None, kernel=None)
    told: list[float] = []
    found = feasibility.solve(problem, [0.3, 0.6], [0.1, 0.2], Progress(told.append))
    counts = [len(each) for each in theory.standard_layouts(2)]
    assert found.counts.tolist() == counts
    torch.testing.assert_close(found.errors[1, 2], 0.6 / counts[2] * tensor([1.0, 2.0]))

    def least(radius: float, epsilon: float, far: float) -> int:
        return next((m for m in counts if radius / m * far <= epsilon), 0)

    for i, radius in enumerate((0.3, 0.6)):
        for j, epsilon in enumerate((0.1, 0.2)):
            assert found.pointwise[i, j].tolist() == [least(radius, epsilon, far) for far in (1.0, 2.0)]
            assert int(found.overall[i, j]) == least(radius, epsilon, 2.0)
    assert told == [0.5, 1.0]


def test_a_bound_is_measured_by_the_first_layout_that_is_good_enough(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[Any] = []
    count = len(theory.standard_layouts(2))

    def layout_errors(target: Any, kernel: Any, domain: Tensor, radius: float, shapes: Any) -> Tensor:
        asked.append((len(domain), radius))
        return torch.stack((torch.zeros(count), radius / torch.arange(1.0, count + 1)), dim=-1)

    def one(target: Any, domain: Tensor, radius: float, epsilon: float, max_degree: int) -> Any:
        asked.append((radius, epsilon, max_degree))
        return SimpleNamespace(degree=1, count=2, m=3.0, error=4.0)

    def two(*given: Any, max_degree: int) -> Any:
        if given[3] < 0.02:
            raise ValueError("no degree does")
        return SimpleNamespace(N=5, S=6, two_polynomials=SimpleNamespace(count=7, m=8.0, error=9.0))

    monkeypatch.setattr(theory, "layout_errors", layout_errors)
    monkeypatch.setattr(theory, "one_polynomial_bound", one)
    monkeypatch.setattr(theory, "exponential_bound", two)
    words = (
        "exponential_bound.radii=[0.1]",
        "exponential_bound.epsilons=[0.001,0.05]",
        "exponential_bound.max_degree=0",
    )
    found = exponential_bound.solve(
        settings("experiment=exponential_bound", *words, "exponential_bound.states=2")
    )
    assert [*found] == [(0.1, 0.05), (0.1, 0.001)]
    assert asked[1:] == [(0.1, 0.05, 0), (0.1, 0.001, 0)]
    first, second = found.values()
    counts = [len(each) for each in theory.standard_layouts(2)]
    assert first == {
        **{"N": 5, "S": 6, "count": 7, "m": 8.0, "error": 9.0},
        **{"degree": 1, "one_polynomial_count": 2, "one_polynomial_m": 3.0, "one_polynomial_error": 4.0},
        "measured_count": counts[1],  # 0.1 / 2
    }
    assert second["measured_count"] is None
    assert (second["N"], second["degree"]) == (None, 1)
    assert caplog.messages == ["r = 0.1: no degree does"]


def test_a_comparison_has_rows_metrics_and_lines(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    both = Comparison({"method": "method", "a_b": "A", "c": "C"}, ("a_b",), laws._log)
    both.add("", {"a_b": 1.23456789, "c": None}, method="mine")
    both.add("other_", {"a_b": math.inf, "c": 2.0}, method="other")
    assert both.metrics == {"a_b": 1.23456789, "c": None, "other_a_b": None, "other_c": 2.0}
    assert caplog.messages[0] == "mine: a b 1.2346"
    assert len(caplog.messages) == 2
    both.write(RunDirectory(tmp_path), "both", digits=5)
    assert "| 1.2346 |" in (tmp_path / "both.md").read_text().replace("  ", " ")
    both.write(RunDirectory(tmp_path), "more")
    assert "1.2346" not in (tmp_path / "more.md").read_text()


def test_a_slope_needs_two_points_above_the_floor() -> None:
    assert log_slope([1.0, 2.0], [1.0, 8.0]) == pytest.approx(3.0)
    assert log_slope([1.0, 2.0, 4.0], [0.5, 8.0, 16.0], above=0.5) == pytest.approx(1.0)
    assert log_slope([1.0, 2.0], [0.5, 8.0], above=0.5) is None
