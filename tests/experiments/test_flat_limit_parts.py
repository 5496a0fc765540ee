"""What `flat_limit` asks for and what it makes of the errors, with errors that are made up."""

from __future__ import annotations

import math
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import basis_of, tensor, uniform

import staf_torch as st
from staf_torch.experiments import flat_limit
from staf_torch.experiments.flat_limit import METHODS, Problem, Sample

INF = math.inf


def cfg_of(*more: str) -> Any:
    return settings("experiment=flat_limit", *more)


def sample(centers: int, dtype: str, radius: float, *errors: float) -> Sample:
    return Sample(centers, dtype, radius, dict(zip(METHODS, errors, strict=True)))


# Two counts, two dtypes, three radii: a decade in two steps and the end.
RADII = [0.01, 0.0316, 0.1, 0.2]
SAMPLES = [
    sample(count, dtype, radius, *(number * scale for number in (1e-3, 2e-3, 3e-3, 4e-3)))
    for count in (3, 6)
    for radius, scale in zip(RADII, (INF if count == 6 else 8.0, 4.0, 2.0, 1.0), strict=True)
    for dtype in ("float64", "float32")
]
SAMPLES[2].error["cholesky"] = INF  # 3 centers, float64, a radius of 0.0316


def test_the_summary_has_the_worst_errors_and_the_largest_radius_of_a_failure() -> None:
    found = flat_limit.summary(SAMPLES)
    for k, method in enumerate(METHODS, start=1):
        for dtype in ("float64", "float32"):
            failing = method == "cholesky" and dtype == "float64"
            assert found[f"{method}_error_{dtype}"] is None  # six centers fail at the smallest radius
            assert found[f"{method}_error_{dtype}_6"] is None
            assert found[f"{method}_fails_at_{dtype}_6"] == 0.01
            worst = found[f"{method}_error_{dtype}_3"]
            assert worst is None if failing else worst == pytest.approx(8e-3 * k)
            assert found[f"{method}_fails_at_{dtype}_3"] == (0.0316 if failing else None)
    few = [each for each in SAMPLES if each.centers == 3]
    assert flat_limit.summary(few)["graded_error_float32"] == pytest.approx(32e-3)
    assert len(found) == 4 * 2 * (1 + 2 * 2)


def test_tables_show_every_decade_and_hold_every_number() -> None:
    problem = Problem(st.ExponentialKernel(), st.targets.Paper(), torch.zeros(2), [3, 6], RADII, 2)
    shown = flat_limit._shown(problem, SAMPLES).markdown()
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in shown.splitlines()]
    assert lines[0] == ["dtype", "centers", "method", "r = 1e-02", "r = 1e-01", "worst"]
    assert lines[2] == ["float64", "3", "Cholesky", "8e-03", "2e-03", "fails"]
    names = ["Cholesky", "Cholesky, jitter 1e-12", "pivoted Cholesky", "graded basis"]
    dtypes = ["float64", "float32"]
    assert [line[:3] for line in lines[2:]] == [[d, str(c), n] for d in dtypes for c in (3, 6) for n in names]
    assert lines[-1][3:] == ["fails", "8e-03", "fails"]
    rows = flat_limit._every(SAMPLES).csv().splitlines()
    assert rows[0] == "dtype,centers,radius,cholesky,jitter,pivoted,graded"
    assert len(rows) == 1 + len(SAMPLES)
    assert [float(cell or "nan") for cell in rows[1].split(",")[1:]] == pytest.approx(
        [3, 0.01, 0.008, 0.016, 0.024, 0.032]
    )
    assert rows[3].split(",")[3] == ""
    assert (flat_limit._cell(INF), flat_limit._cell(0.00123)) == ("fails", "1e-03")


def test_a_panel_is_of_one_dtype_and_count() -> None:
    panels = flat_limit._panels(SAMPLES)
    assert [panel.title for panel in panels] == [
        *("3 centers, float64", "6 centers, float64", "3 centers, float32", "6 centers, float32")
    ]
    assert [panel.rounding for panel in panels] == [2.0**-52] * 2 + [2.0**-23] * 2
    assert all(panel.radius == RADII for panel in panels)
    assert panels[0].error["Cholesky"] == pytest.approx([8e-3, INF, 2e-3, 1e-3])
    assert panels[3].error["graded basis"] == pytest.approx([INF, 16e-3, 8e-3, 4e-3])


@pytest.mark.parametrize(
    ("smallest", "largest", "per_decade", "expected"),
    [
        (1e-3, 1.0, 1, [1e-3, 1e-2, 1e-1, 1.0]),  # a whole number of decades has its end once
        (1e-2, 0.05, 2, [1e-2, 10**-1.5, 0.05]),
        (0.1, 0.11, 3, [0.1, 0.11]),
        (1e-30, 1e-29, 1, [1e-30, 1e-29]),
    ],
)
def test_radii_are_a_logarithmic_grid_and_its_end_as_float32_holds_them(
    smallest: float, largest: float, per_decade: int, expected: list[float]
) -> None:
    cfg = cfg_of(f"flat_limit.radii.smallest={smallest}", f"flat_limit.radii.largest={largest}")
    found = flat_limit._radii(cfg, per_decade)
    assert found == pytest.approx(expected, rel=1e-6)
    assert found == torch.tensor(found, dtype=torch.float32).tolist()


@pytest.mark.parametrize("smallest", ["0.9e-30", "0.5", "0.6"])
def test_the_smallest_radius_is_above_what_float32_holds_and_below_the_largest(smallest: str) -> None:
    cfg = cfg_of(f"flat_limit.radii.smallest={smallest}", "flat_limit.radii.largest=0.5")
    rule = r"must be at least 1e-30 and below the largest radius \(0.5\)"
    with pytest.raises(ValueError, match=rf"`staf flat_limit.radii.smallest=...` {rule}"):
        flat_limit._radii(cfg, 1)


def test_a_count_may_stand_alone_and_a_state_is_as_float32_holds_it() -> None:
    assert flat_limit._counts(cfg_of("flat_limit.counts=10")) == [10]
    assert flat_limit._counts(cfg_of("flat_limit.counts=[1,3]")) == [1, 3]
    problem = flat_limit.problem_of(cfg_of("initial_state=[0.1,0.7]", "kernel=gaussian", "dtype=float32"))
    assert problem.state.dtype == torch.float64
    assert problem.state.tolist() == torch.tensor([0.1, 0.7], dtype=torch.float32).tolist()
    assert all(each.dtype == torch.float64 for each in problem.kernel.buffers())
    assert isinstance(problem.kernel, st.GaussianKernel)


@pytest.mark.parametrize("kernel", ["exponential", "gaussian"])
def test_every_method_interpolates_where_the_centers_are_far_apart(kernel: str) -> None:
    basis, x, z = basis_of(kernel, 6, 0.5), uniform(2, seed=1), uniform(4, 2, low=-0.4, high=0.4, seed=2)
    target = st.targets.Paper()
    centers = basis.centers(x)
    weights = torch.linalg.solve(basis.kernel(centers, centers), target(centers))
    expected = basis.kernel(x + z, centers) @ weights
    for _, method in METHODS.values():
        torch.testing.assert_close(method(basis, target, x, z), expected, rtol=1e-6, atol=1e-6)


def test_a_jitter_is_added_to_the_diagonal() -> None:
    basis = st.StaFBasis(st.GaussianKernel(0.8), st.StateFollowingCenters(st.rings(3), 0.5))
    x, z = uniform(2, seed=1), uniform(4, 2, seed=2)
    target, centers = st.targets.Paper(), basis.centers(x)
    scale = (-(centers - x).square().sum(-1) / 0.8**2).exp()  # of K0 = exp(d'd / width^2), twice
    for jitter in (0.25, 1e-12):
        raised = basis.kernel(centers, centers) + jitter * torch.diag(scale)
        expected = basis.kernel(x + z, centers) @ torch.linalg.solve(raised, target(centers))
        found = flat_limit.cholesky(basis, target, x, z, jitter)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    assert flat_limit.JITTER == 1e-12
    assert torch.equal(flat_limit.jittered(basis, target, x, z), found)
    assert not torch.equal(flat_limit.cholesky(basis, target, x, z), found)
    same = st.StaFBasis(st.GaussianKernel(0.8), st.StateFollowingCenters(st.rings(3), 1e-9))
    assert bool(flat_limit.cholesky(same, target, x, z).isnan().all())
    assert flat_limit.cholesky(basis.float(), target, x.float(), z.float()).dtype == torch.float32


def test_the_truth_has_digits_enough_for_its_condition() -> None:
    # Degree k with (k + 1)(k + 2) / 2 points and one to spare: 2 (k + 1) digits a decade.
    assert [flat_limit._digits(count, 1e-3) for count in (1, 3, 4, 6, 10, 15)] == [56, 62, 68, 68, 74, 80]
    assert flat_limit._digits(6, 1.0) == flat_limit._digits(6, 7.0) == 50
    assert flat_limit._digits(6, 0.5) == 52
    truth = [Decimal(3), Decimal("-0.5")]
    assert flat_limit.relative_error(tensor([3.0, -0.25]), truth) == pytest.approx(0.25 / 3)
    assert flat_limit.relative_error(tensor([INF, -0.25]), truth) == INF
    point = [Decimal("0.3"), Decimal("-1.25")]
    expected = 0.09 + 5 * 1.5625 + math.tanh(0.3 * -1.25)
    assert float(flat_limit.paper(point)) == pytest.approx(expected, rel=1e-14)


def test_elimination_solves_and_leaves_what_it_was_given() -> None:
    matrix = [[4, 1, 2], [1, 5, 3], [2, 3, 6]]
    rows = [[Decimal(entry) for entry in row] for row in matrix]
    right = [Decimal(entry) for entry in (1, -2, 3)]
    found = [float(each) for each in flat_limit._solve(rows, right)]
    np.testing.assert_allclose(found, np.linalg.solve(np.array(matrix), [1, -2, 3]), rtol=1e-12)
    assert rows == [[Decimal(entry) for entry in row] for row in matrix]


def test_a_run_tries_every_method_at_every_count_radius_and_dtype(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def method(basis: st.StaFBasis, target: object, x: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        asked.append((basis.count, float(basis.centers.radius(x)), x.dtype, x, z))
        return z[:, 0]

    def interpolant(
        directions: torch.Tensor, radius: float, x: torch.Tensor, zeta: torch.Tensor, width: Any
    ) -> Any:
        asked.append((len(directions), radius, width, x, zeta))
        return [Decimal(1)] * len(zeta)

    monkeypatch.setattr(flat_limit, "METHODS", {"mine": ("Mine", method)})
    monkeypatch.setattr(flat_limit, "interpolant", interpolant)
    for kernel, width in ((st.GaussianKernel(0.8), 0.8), (st.ExponentialKernel(), None)):
        asked.clear()
        state = tensor([0.5, 0.25])
        problem = Problem(kernel.double(), st.targets.Paper(), state, [3, 6], [0.25, 0.5], 1)
        samples = flat_limit.solve(problem)
        assert [(s.centers, s.dtype, s.radius) for s in samples] == [
            (count, dtype, radius)
            for count in (3, 6)
            for radius in (0.25, 0.5)
            for dtype in ("float64", "float32")
        ]
        reference, first, second, *_ = asked
        assert reference[:3] == (3, 0.25, pytest.approx(width))
        assert torch.equal(reference[3], state)
        zeta = st.centers.probe_points(9, 2).float().double()
        assert torch.equal(reference[4], zeta)
        for each, dtype in ((first, torch.float64), (second, torch.float32)):
            assert each[:3] == (3, 0.25, dtype)
            torch.testing.assert_close(each[4], (0.25 * zeta).to(dtype))
        assert samples[0].error["mine"] == pytest.approx(float((0.25 * zeta[:, 0] - 1).abs().max()))
        assert kernel.double() is problem.kernel  # which is as it was
        assert all(buffer.dtype == torch.float64 for buffer in kernel.buffers())
