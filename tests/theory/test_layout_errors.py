"""Errors of layouts and smallest counts: what is asked of the target, ties, blocks, and layouts that fail."""

from __future__ import annotations

import re

import pytest
import torch
from helpers import tensor
from torch import Tensor
from variants import LAYOUTS, directions_of

import staf_torch as st
from staf_torch import theory
from staf_torch.local_basis import GradedBasis
from staf_torch.local_basis.graded import graded_basis
from staf_torch.targets import Cosine, Paper
from staf_torch.theory import power_function
from staf_torch.theory.uniform_approximation import ball_grid, supremum

LINE = tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.5, 0.0]])
STATES = tensor([[1.0, 0.0], [0.3, -0.9], [-1.2, 0.4], [0.2, 0.1], [0.0, 0.8], [-0.5, -0.5], [0.9, 0.9]])
MODULE = theory.layout_errors.__globals__


def complete_degree(graded: GradedBasis) -> int:
    found: int = MODULE["_complete_degree"](graded)
    return found


@pytest.mark.parametrize(("dim", "points"), [(1, 1 + 6 * 2), (2, 1 + 6 * 128), (3, 1 + 6 * 256)])
def test_errors_of_layouts_are_suprema_over_a_grid_of_the_ball(dim: int, points: int) -> None:
    states = theory.disc(1.0, dim=dim, count=4)
    layouts = [st.ball(2, dim), st.ball(dim + 1, dim)]
    asked: list[torch.Size] = []
    waves = Cosine(1.5)

    def target(y: Tensor) -> Tensor:
        asked.append(y.shape)
        return waves(y)

    found = theory.layout_errors(target, st.GaussianKernel(0.7), states, 0.4, layouts)
    assert asked.count(torch.Size((4, points, dim))) == len(layouts)
    grid = 0.4 * ball_grid(dim, 6, {1: 2, 2: 128}.get(dim, 256))
    for layout, errors in zip(layouts, found, strict=True):
        basis = st.StaFBasis(st.GaussianKernel(0.7), st.StateFollowingCenters(layout, 0.4))
        for x, error in zip(states, errors, strict=True):
            staf = st.StaF(basis).fit_(x, waves)

            def left(z: Tensor, x: Tensor = x, staf: st.StaF = staf) -> Tensor:
                y = (x + z).reshape(-1, dim)
                return (waves(y) - staf(y)).abs().detach()[None]

            largest = supremum(left, grid, 0.4)
            assert float(error) == pytest.approx(float(largest), rel=1e-4)


def test_states_are_taken_in_blocks_that_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = theory.layout_errors(Paper(), st.ExponentialKernel(), STATES, 0.2, [st.rings(3)])
    for block, rows in ((3 * 769 * 3, [3, 3, 1]), (769, [1] * 7), (1, [1] * 7), (769 * 3 * 7, [7])):
        asked: list[int] = []

        def target(y: Tensor, asked: list[int] = asked) -> Tensor:
            if y.shape[-2] == 769:
                asked.append(len(y))
            return Paper()(y)

        monkeypatch.setitem(MODULE, "_BLOCK", block)
        found = theory.layout_errors(target, st.ExponentialKernel(), STATES, 0.2, [st.rings(3)])
        assert asked == rows
        torch.testing.assert_close(found, whole, rtol=1e-8, atol=1e-12)


def test_an_error_that_equals_what_is_allowed_is_allowed() -> None:
    layouts = [st.rings(3), st.rings(6), st.rings(10)]
    kernel = st.ExponentialKernel()
    errors = theory.layout_errors(Paper(), kernel, STATES, 0.1, layouts)
    for k, layout in enumerate(layouts):
        epsilon = float(errors[k].max())
        assert theory.minimal_count(Paper(), kernel, STATES, 0.1, epsilon, layouts).count == len(layout)


def test_the_best_layout_that_fails_is_named_and_none_that_has_no_error() -> None:
    """The target is no number at a center of the smaller layout, which no point of the grid meets."""
    x, kernel = tensor([[0.4, 0.2]]), st.ExponentialKernel()
    layouts = [st.ball(5, 2), st.rings(6), st.rings(3)]
    hole = x[0] + 0.1 * layouts[0][1]

    def target(y: Tensor) -> Tensor:
        values: Tensor = torch.where((y - hole).norm(dim=-1) < 1e-12, torch.nan, Paper()(y))
        return values

    errors = theory.layout_errors(target, kernel, x, 0.1, layouts)
    assert errors.isnan().flatten().tolist() == [True, False, False]
    with pytest.raises(ValueError, match=r"the best one \(6 centers\)") as caught:
        theory.minimal_count(target, kernel, x, 0.1, 1e-12, layouts)
    said = re.search(r"an error of ([0-9.e-]+)", str(caught.value))
    assert said is not None
    assert float(said[1]) == pytest.approx(float(errors[1]), rel=1e-2)


def test_layouts_of_other_dimensions_grow_by_a_degree_each(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [layout.shape for layout in theory.standard_layouts(1)] == [(k, 1) for k in range(1, 8)]
    monkeypatch.setitem(MODULE, "_MOST_CENTERS", 20)
    assert [layout.shape for layout in theory.standard_layouts(3)] == [(k, 3) for k in (1, 4, 10, 20)]
    monkeypatch.setitem(MODULE, "_MOST_CENTERS", 19)
    assert [len(layout) for layout in theory.standard_layouts(3)] == [1, 4, 10]


def test_what_names_no_layout_is_refused() -> None:
    for call in (theory.layout_errors, theory.minimal_count):
        given = (Paper(), st.GaussianKernel(), STATES, 0.1)
        more = (1e-2, []) if call is theory.minimal_count else ([],)
        with pytest.raises(ValueError, match=rf"`{call.__name__}\(layouts=...\)` must name at least one"):
            call(*given, *more)  # type: ignore[operator]
    with pytest.raises(ValueError, match=r"`layout_errors\(layouts=...\)` must have 2 entries"):
        theory.layout_errors(Paper(), st.GaussianKernel(), STATES, 0.1, [st.ball(3, 3)])
    with pytest.raises(ValueError, match=r"`layout_errors\(states=...\)` must be a floating-point"):
        theory.layout_errors(Paper(), st.GaussianKernel(), STATES.long(), 0.1, [st.rings(3)])
    with pytest.raises(ValueError, match=r"`minimal_count\(states=...\)` must be a floating-point"):
        theory.minimal_count(Paper(), st.GaussianKernel(), STATES.long(), 0.1, 0.1)


# --- the power function -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", [name for name, case in LAYOUTS.items() if case.degree is not None and case.count < 30]
)
def test_polynomials_that_a_layout_determines_are_counted(name: str) -> None:
    assert complete_degree(graded_basis(directions_of(name))) == LAYOUTS[name].degree


def test_on_a_line_no_linear_polynomial_is_determined() -> None:
    assert complete_degree(graded_basis(LINE)) == 0


@pytest.mark.parametrize(
    "kernel", [st.ExponentialKernel(), st.GaussianKernel(0.8)], ids=["exponential", "gaussian"]
)
@pytest.mark.parametrize("layout", [LINE, LINE[:3], st.rings(6)], ids=["line", "short line", "rings"])
@pytest.mark.parametrize("x", [tensor([0.3, -0.4]), STATES[:3], STATES[:6].view(2, 3, 2)])
def test_the_power_function_is_that_of_its_formula_where_nothing_cancels(
    kernel: st.Kernel, layout: Tensor, x: Tensor
) -> None:
    basis = st.StaFBasis(kernel, st.StateFollowingCenters(layout, 0.9))
    z = 0.9 * tensor([[0.1, 0.9], [0.7, -0.6], [-0.3, -0.5], [0.2, 0.3]]).expand(*x.shape[:-1], 4, 2)
    y, c = x.unsqueeze(-2) + z, basis.centers(x)
    across, gram = kernel(y, c), kernel(c, c)
    own = kernel(y.unsqueeze(-2), y.unsqueeze(-2)).squeeze(-1).squeeze(-1)
    left = own - (across * torch.linalg.solve(gram, across.mT).mT).sum(-1)
    found = power_function(basis, x, z)
    assert found.shape == (*x.shape[:-1], 4)
    torch.testing.assert_close(found, left.sqrt(), rtol=1e-4, atol=0)
    torch.testing.assert_close(
        power_function(basis, x, z, relative=True), (left / own).sqrt(), rtol=1e-4, atol=0
    )


def test_centers_in_one_point_have_their_limit() -> None:
    """At the origin, where a radius that shrinks to nothing leaves all centers in one place."""
    basis = st.StaFBasis(
        st.ExponentialKernel(), st.StateFollowingCenters(st.rings(3), st.StateRadius(0.5, 0.0))
    )
    x = tensor([[0.0, 0.0], [0.6, 0.0]])
    z = tensor([[0.0, 0.0], [0.05, 0.02]])
    both = power_function(basis, x, z)
    assert both[0].tolist() == [0.0, 0.0]
    torch.testing.assert_close(both[1], power_function(basis, x[1], z))
    assert float(both[1, 1]) > 0


@pytest.mark.parametrize("kernel", [st.ExponentialKernel(), st.MaternKernel(2.5)], ids=["smooth", "matern"])
def test_states_and_points_of_the_power_function_are_of_the_dimension_of_the_basis(kernel: st.Kernel) -> None:
    basis = st.StaFBasis(kernel, st.StateFollowingCenters(st.rings(3), 0.5))
    two, three = torch.zeros(1, 2).double(), torch.zeros(1, 3).double()
    with pytest.raises(ValueError, match=r"`power_function\(x=...\)` must have 2 entries"):
        power_function(basis, three, two)
    with pytest.raises(ValueError, match=r"`power_function\(z=...\)` must have 2 entries"):
        power_function(basis, two, three)
    with pytest.raises(ValueError, match=r"`power_function\(z=...\)` must have at least 2 dimensions"):
        power_function(basis, two, two[0])
