"""The experiments on the theorems: the orders, counts and digits that they claim, and what they refuse."""

from __future__ import annotations

import math
from decimal import Decimal
from pathlib import Path

import mpmath as mp
import pytest
from composing import settings
from helpers import uniform
from helpers_experiments import ran, run, words
from truth import Truth, paper

import staf_torch as st
from staf_torch.experiments import flat_limit, theorems
from staf_torch.experiments.registry import log_slope

SPACE = (
    "target=quadratic system=linear system.matrix=[[-1,0,0],[0,-1,0],[0,0,-2]] "
    "initial_state=[1,0.5,0.2] centers=ball"
)


def test_the_local_basis_has_the_order_of_its_layout() -> None:
    found = ran("layouts").metrics
    for count, order in ((3, 2), (6, 3), (10, 4)):
        assert found[f"rings{count}.slope"] == pytest.approx(order, abs=0.15)
    assert found["polygon15.slope"] == pytest.approx(2, abs=0.1)  # however many centers
    for row in ran("layouts").rows("layouts"):
        assert float(row["r0.2"]) > float(row["r0.1"])


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_layout_of_order_k_has_as_many_centers_as_polynomials_below_it(dim: int) -> None:
    layouts = theorems.all_layouts(dim)
    for each in layouts:
        assert each.directions.shape[1] == dim
        assert len(each.directions) <= 130
        if each.family in ("ball", "rings"):
            assert len(each.directions) == math.comb(dim + each.order - 1, dim)
    assert {each.family for each in layouts} == {"ball", "simplex", "cross_polytope"} | (
        {"rings", "polygon"} if dim == 2 else set()
    )


def test_the_bound_of_the_paper_is_far_above_what_is_needed() -> None:
    bound = ran("exponential_bound").metrics
    names = ("N", "S", "count", "one_polynomial_count", "measured_count")
    assert [bound[f"r0.1.eps0.001.{name}"] for name in names] == [3, 2, 21, 10, 10]
    for row in ran("exponential_bound").rows("exponential_bound"):
        assert float(row["measured_count"]) <= float(row["one_polynomial_count"]) <= float(row["count"])
        assert float(row["error"]) <= float(row["epsilon"])


def test_the_bound_has_no_numbers_where_no_degree_does() -> None:
    small = [f"exponential_bound.{word}" for word in ("states=5", "epsilons=[1e-6]", "max_degree=1")]
    cfg = settings(*words("exponential_bound"), *small)
    (none,) = theorems.bounds(cfg).values()
    assert none["N"] is none["degree"] is none["count"] is None


def test_fewer_centers_are_needed_where_more_error_is_allowed_and_at_each_state_than_at_all() -> None:
    result = ran("feasibility")
    assert result.metrics == {"r0.1.eps0.1.count": 3, "r0.1.eps0.01.count": 6}
    for row in result.rows("feasibility"):
        assert int(row["least_pointwise"]) <= int(row["count"])
        assert float(row["error"]) <= float(row["epsilon"])
    along = result.rows("feasibility_pointwise")
    assert len(along) == 16
    assert all(int(row["eps0.1"]) <= 3 and int(row["eps0.01"]) <= 6 for row in along)


def test_another_kernel_a_dtype_and_three_states_hold_for_feasibility(tmp_path: Path) -> None:
    other = ("kernel=gaussian", "dtype=float32", "feasibility.states=2", "figures=false", *SPACE.split())
    result = run(tmp_path, *words("feasibility"), *other)
    assert any(value is not None for value in result.metrics.values())
    assert not (tmp_path / "figures").exists()
    tiny = run(tmp_path, *words("feasibility"), "feasibility.epsilons=[1e-300]", *other).metrics
    assert not any(tiny.values())  # no layout is good enough


@pytest.mark.parametrize("count", [1, 3, 15])
@pytest.mark.parametrize("radius", [1e-8, 0.5])
@pytest.mark.parametrize("width", [None, 0.8])
def test_the_truth_of_the_flat_limit_agrees_with_another_implementation_to_25_digits(
    count: int, radius: float, width: float | None
) -> None:
    directions = st.polygon(1) if count == 1 else st.rings(count)
    x, zeta = uniform(2, seed=count), uniform(3, 2, low=-0.7, high=0.7, seed=7)
    truth = Truth(directions, radius, x, paper, width)
    for value, z in zip(flat_limit.interpolant(directions, radius, x, zeta, width), zeta, strict=True):
        expected = Decimal(mp.nstr(truth.value(z), 40))
        assert abs(value - expected) <= Decimal("1e-25") * abs(expected)


def error(method: str, dtype: str, centers: int, radius: float) -> float:
    """A relative error of the case; inf where the method fails."""
    (row,) = [
        row
        for row in ran("flat_limit").rows("flat_limit")
        if (row["dtype"], int(row["centers"])) == (dtype, centers)
        and math.isclose(float(row["radius"]), radius, rel_tol=1e-6)
    ]
    return float(row[method] or "inf")


def test_the_graded_basis_keeps_all_digits_at_every_radius() -> None:
    for row in ran("flat_limit").rows("flat_limit"):
        assert float(row["graded"]) <= {"float64": 5e-15, "float32": 5e-7}[row["dtype"]]
    assert ran("flat_limit").metrics["graded_error_float64"] <= 5e-15


LOST = {
    "cholesky": {(3, 1e-6): 3e-10, (6, 1e-1): 3e-13, (6, 1e-3): 4e-9, (15, 1e-1): 2e-10},
    "jitter": {
        **{(3, 1e-1): 9e-12, (3, 1e-6): 5e-7, (6, 1e-1): 7e-10, (6, 1e-3): 2e-6, (6, 1e-6): 4e-7},
        **{(15, 1e-1): 5e-7, (15, 1e-6): 2e-7},
    },
    "pivoted": {(3, 1e-6): 3e-10, (6, 1e-3): 3e-9, (6, 1e-6): 3e-10, (15, 1e-2): 2e-8},
}
"""Of a method, of centers and a radius, the error that the reference says."""
FAILS = [
    ("float64", 6, 1e-5, 1e-3),
    ("float64", 15, 1e-3, 1e-1),
    ("float32", 3, 1e-4, 1e-3),
    ("float32", 6, 1e-2, 1e-1),
    ("float32", 15, 1e-1, 0.5),
]
"""Of a dtype and centers, a radius at which plain Cholesky fails and one at which it works."""


def test_other_methods_lose_what_the_reference_says_and_plain_cholesky_fails_below_its_radius() -> None:
    # Rounding error is a random number, and another state or processor gives another one: a factor of 10.
    for method, numbers in LOST.items():
        for (centers, radius), expected in numbers.items():
            found = error(method, "float64", centers, radius)
            assert expected / 10 <= found <= 10 * expected, (method, centers, radius)
    metrics = ran("flat_limit").metrics
    for dtype, centers, fails, works in FAILS:
        assert error("cholesky", dtype, centers, fails) == math.inf
        assert math.isfinite(error("cholesky", dtype, centers, works))
        assert fails <= metrics[f"cholesky_fails_at_{dtype}_{centers}"] * (1 + 1e-6) < works
        assert metrics[f"graded_fails_at_{dtype}_{centers}"] is None


def test_the_flat_limit_is_a_gaussian_s_too(tmp_path: Path) -> None:
    few = ("flat_limit.counts=6", "flat_limit.radii.smallest=1e-2", "flat_limit.radii.per_decade=1")
    result = run(tmp_path, "experiment=flat_limit", "kernel=gaussian", *few, "figures=false")
    assert result.metrics["graded_error_float64"] <= 5e-15


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("exponential_bound", "kernel=gaussian", "must be exponential"),
        ("layouts", "centers.shrink.offset=0.1", "constant radius"),
        ("flat_limit", "kernel=matern", r"`staf kernel=...` must be exponential or gaussian"),
        ("flat_limit", "target=quadratic", r"`staf target=...` must be paper"),
        ("flat_limit", "flat_limit.radii.smallest=0.5", r"below the largest radius \(0.5\)"),
    ],
)
def test_wrong_settings_are_named_before_anything_is_written(
    name: str, override: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        run(tmp_path, *words(name), override)
    assert not list(tmp_path.iterdir())


def test_a_slope_is_of_the_points_that_are_known_and_above_the_floor() -> None:
    x = [0.1, 0.2, 0.4, 0.8, 1.6]
    cubes: list[float | None] = [2 * step**3 for step in x]
    assert log_slope(x, cubes) == pytest.approx(3.0)
    assert log_slope(x, [None, *cubes[1:3], 0.0, None]) == pytest.approx(3.0)
    assert log_slope(x, [1e-3, *cubes[1:]], above=2e-3) == pytest.approx(3.0)  # of what is above alone
    assert log_slope(x, [None, None, None, None, 1.0]) is None
