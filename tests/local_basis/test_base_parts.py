"""The parts of local bases one by one: blocks of rows, series, functionals, which basis a kernel gets."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

import staf_torch as st
from staf_torch.local_basis import base, choice
from staf_torch.local_basis.elimination import (
    Degrees,
    _independent,
    degrees_of,
    eliminate,
    functionals_of,
    homogeneous,
)
from staf_torch.local_basis.graded import Interpolation, _terms, graded_basis, over_points, phi, ridges

SIZES = [((4096,), 1), ((4097,), 2), ((3, 4096), 3), ((2, 2, 2049), 3), ((), 1)]


@pytest.mark.parametrize(("lead", "calls"), SIZES)
@pytest.mark.parametrize("share", [False, True])
def test_a_large_batch_goes_in_blocks_of_rows_and_comes_out_the_same(
    lead: tuple[int, ...], calls: int, share: bool
) -> None:
    asked = []

    def function(values: Tensor, state: Tensor) -> Tensor:
        asked.append(values.shape)
        return values * state.sum(-1, keepdim=True) + state[..., :1]

    values, state = uniform(*lead, 3, seed=1), uniform(*([] if share else lead), 2, seed=2)
    found = base.in_blocks(function, values, state)
    assert len(asked) == calls
    torch.testing.assert_close(found, values * state.sum(-1, keepdim=True) + state[..., :1])
    assert found.shape == (*lead, 3)
    if calls == 2:
        assert asked == [(4096, 3), (1, 3)]


@pytest.mark.parametrize("lead", [(), (5,), (4, 5), (2, 4, 5)])
def test_a_matrix_is_applied_to_the_last_dimension_of_rows(lead: tuple[int, ...]) -> None:
    matrix, rows = uniform(3, 2, seed=3), uniform(*lead, 2, seed=4)
    torch.testing.assert_close(base.rows_last(matrix, rows), torch.einsum("mk,...k->...m", matrix, rows))


@pytest.mark.parametrize("lead", [(), (3,), (2, 3)])
@pytest.mark.parametrize("outputs", [None, 2])
def test_a_value_comes_with_its_gradient(lead: tuple[int, ...], outputs: int | None) -> None:
    z = uniform(*lead, 4, 2, seed=5)

    def function(at: Tensor) -> Tensor:
        one = at[..., 0] ** 2 + 3 * at[..., 0] * at[..., 1]
        return one if outputs is None else torch.stack((one, at[..., 1].sin()))

    value, gradient = base.with_gradient(function, z)
    torch.testing.assert_close(value, function(z))
    first = torch.stack((2 * z[..., 0] + 3 * z[..., 1], 3 * z[..., 0]), -1)
    second = torch.stack((0 * z[..., 0], z[..., 1].cos()), -1)
    torch.testing.assert_close(gradient, first if outputs is None else torch.stack((first, second)))


def test_scales_of_kernels_are_one_where_they_have_none() -> None:
    x, z, w = uniform(3, 2, seed=6), uniform(3, 4, 2, seed=7), uniform(3, 4, seed=8)
    plain, steep = st.MaternKernel(2.5), st.ExponentialKernel()
    assert base.scale(plain, x, z).shape == ()
    assert float(base.scale(plain, x, z)) == 1.0
    product = (z * x.unsqueeze(-2)).sum(-1)
    torch.testing.assert_close(base.scale(steep, x, z), product.exp())
    torch.testing.assert_close(base.scale(steep, x, z, -1.0), (-product).exp())
    assert base.to_scaled(plain, x, w) is w
    grown = base.to_scaled(steep, x, w)
    torch.testing.assert_close(grown, w * x.square().sum(-1, keepdim=True).exp())
    torch.testing.assert_close(base.from_scaled(steep, x, grown), w)
    far = torch.tensor([[30.0, 0.0]]).double()
    zero = base.to_scaled(steep, far, tensor([[0.0, 1.0]]))
    assert zero.tolist() == [[0.0, math.inf]]
    lost = base.from_scaled(plain, x, torch.where(w > 0.5, w, math.inf))
    assert torch.equal(lost.isnan(), w <= 0.5)


def test_a_scaled_value_has_the_gradient_of_the_product() -> None:
    x, z = uniform(3, 2, seed=9), uniform(3, 4, 2, seed=10)
    sums, slope = z[..., 0] * z[..., 1], torch.stack((z[..., 1], z[..., 0]), -1)
    value, gradient = base.scaled_gradient(st.ExponentialKernel(), x, z, sums, slope)
    factor = (z * x.unsqueeze(-2)).sum(-1).exp()
    torch.testing.assert_close(value, sums * factor)
    wanted = (slope + sums.unsqueeze(-1) * x.unsqueeze(-2)) * factor.unsqueeze(-1)
    torch.testing.assert_close(gradient, wanted)
    same = base.scaled_gradient(st.MaternKernel(2.5), x, z, sums, slope)
    assert same[0] is sums
    assert same[1] is slope


# Series


def share(k: int, j: int) -> float:
    return math.factorial(k) / math.factorial(k + j)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("top", [1, 2, 5, 12])
def test_a_series_has_the_terms_that_are_above_rounding(top: int, dtype: torch.dtype) -> None:
    small = 5e-17 if dtype == torch.float64 else 3e-8
    rest = [math.factorial(top) / math.factorial(top + k) for k in range(40)]
    assert _terms(top, dtype) == next(k for k, each in enumerate(rest) if each <= small * (1 + 1e-12))
    t = torch.tensor([-1.0, -0.5, 1.0], dtype=dtype)
    for k, found in enumerate(phi(t, top)):
        exact = sum(t.double() ** j * share(k, j) for j in range(40))
        torch.testing.assert_close(found.double(), exact, rtol=0, atol=2e-15 if small < 1e-16 else 5e-7)


def test_an_exponential_alone_is_no_series() -> None:
    t = tensor([-3.0, 0.0, 2.0])
    (found,) = phi(t, 0)
    assert torch.equal(found, t.exp())
    (alone,) = ridges(t, tensor(0.5), 0)
    assert torch.equal(alone, (0.5 * t).exp())


@pytest.mark.parametrize("r2", [0.0, 0.3, 2.0])
def test_ridges_are_powers_times_the_tails_of_the_exponential(r2: float) -> None:
    tau = tensor([-0.9, 0.1, 0.8])
    for k, found in enumerate(ridges(tau, tensor(r2), 4)):
        tail = sum((r2 * tau) ** j * share(k, j) for j in range(40))
        torch.testing.assert_close(found, tau**k * tail, rtol=1e-13, atol=1e-15)


def test_a_number_has_no_dimensions_of_points() -> None:
    number = tensor(2.0)
    assert over_points(number) is number
    assert over_points(uniform(3, 2)).shape == (3, 2, 1, 1)


@pytest.mark.parametrize("bound", [0.5, 1.0, None, 1.5])
def test_a_series_of_inverses_is_that_of_every_radius_up_to_a_bound_of_one(bound: float | None) -> None:
    basis, r2 = graded_basis(st.rings(6)), tensor([0.0, 0.1, 0.49])
    values = uniform(3, 6, seed=11)
    found = Interpolation.of(basis, r2, None if bound is None else tensor(bound))
    assert (found.chebyshev is None) is (bound is None)
    assert not found.shared()
    each = torch.stack([Interpolation.of(basis, at, None).solve(v) for at, v in zip(r2, values, strict=True)])
    if bound == 1.5:
        assert bool(found.solve(values).isnan().all())
    else:
        torch.testing.assert_close(found.solve(values), each, rtol=1e-11, atol=1e-11)
    one = Interpolation.of(basis, r2[1], tensor(0.5))
    assert one.shared()
    torch.testing.assert_close(one.solve(values)[1], each[1])
    assert one.solve(values.float()).dtype == torch.float32


@pytest.mark.parametrize("serves", [True, False])
def test_a_bound_of_every_row_serves_the_states_of_that_row(serves: bool) -> None:
    basis = graded_basis(st.rings(3))
    bounds, r2 = tensor([[0.2], [0.9]]), tensor([[0.0, 0.1, 0.2], [0.3, 0.6, 0.9]])
    values = uniform(2, 3, 3, seed=12)
    found = Interpolation.of(basis, r2, bounds if serves else None).solve(values)
    together = Interpolation.of(basis, r2, tensor([0.2, 0.9])).solve(values)  # the largest for all
    torch.testing.assert_close(found, together, rtol=1e-11, atol=1e-11)


# Functionals


@pytest.mark.parametrize(("dim", "count"), [(1, 4), (2, 6), (2, 7), (3, 9)])
def test_functionals_are_orthonormal_and_blind_to_lower_degrees(dim: int, count: int) -> None:
    points = uniform(count, dim, low=-1.0, seed=count)
    points = points / points.norm(dim=-1).max()
    found = eliminate(points)
    q = found.functionals
    torch.testing.assert_close(q.mT @ q, torch.eye(count).double(), rtol=0, atol=1e-12)
    assert list(found.degrees) == sorted(found.degrees)
    for j, degree in enumerate(found.degrees):
        for k in range(degree):
            assert float((q[:, j] @ homogeneous(points, k)).abs().max()) < 1e-12
        seen = float((q[:, j] @ homogeneous(points, degree)).norm())
        assert seen == pytest.approx(float(found.strengths[j]), rel=1e-9)
        assert seen > 1e-6
    for k in range(max(found.degrees)):
        assert found.degrees.count(k) == math.comb(dim + k - 1, k)


def test_homogeneous_monomials_have_the_norm_of_the_power() -> None:
    points = uniform(5, 3, low=-1.0, seed=13)
    for degree in range(4):
        rows = homogeneous(points, degree)
        assert rows.shape == (5, math.comb(2 + degree, degree))
        torch.testing.assert_close(rows @ rows.mT, (points @ points.mT) ** degree)


def test_degrees_come_back_from_lists_and_count_their_monomials() -> None:
    found = degrees_of(0.3 * st.rings(6))
    assert found.reach == pytest.approx(0.3)
    assert found.sizes() == (1, 2, 3)
    assert found.each() == (0, 1, 1, 2, 2, 2)
    assert [sum(row) for block in found.monomials for row in block] == [0, 1, 1, 2, 2, 2]
    listed = {"monomials": [[list(row) for row in block] for block in found.monomials], "reach": found.reach}
    assert Degrees.of(listed) == found
    assert degrees_of(torch.zeros(1, 2).double()) == Degrees((((0, 0),),), 1.0)


def test_points_that_coincide_are_refused_with_their_number() -> None:
    points = torch.cat((st.rings(3), st.rings(3)[:2] + 1e-16))
    with pytest.raises(ValueError, match=r"must be told apart by polynomials: 2 of 5 directions coincide"):
        eliminate(points)


# Which basis


@pytest.mark.parametrize(
    ("kernel", "count", "kind"),
    [
        (st.ExponentialKernel(), 6, "graded"),
        (st.GaussianKernel(0.5), 3, "graded"),
        (st.MaternKernel(1.5), 3, "newton"),
        (st.PolynomialKernel(2), 6, "polynomial"),
        (st.PolynomialKernel(3), 6, "polynomial"),
        (st.PolynomialKernel(1), 6, "newton"),
        (st.PolynomialKernel(1), 3, "polynomial"),
    ],
)
def test_a_kernel_gets_the_basis_that_it_allows(kernel: st.Kernel, count: int, kind: str) -> None:
    found, degrees = choice.choose(kernel, st.rings(count))
    assert found == kind
    assert (degrees is None) is (kind == "newton")
    empty = torch.empty(count, 2, device="meta")
    named, nothing = choice.choose(kernel, empty)
    assert nothing is None
    assert named == ("polynomial" if isinstance(kernel, st.PolynomialKernel) else kind)


@pytest.mark.parametrize(
    ("radius", "width", "learned", "serves"),
    [(0.5, 0.5, False, True), (0.501, 0.5, False, False), (0.3, 0.5, True, False)],
)
def test_one_series_serves_where_the_squared_radius_is_at_most_one(
    radius: float, width: float, learned: bool, serves: bool
) -> None:
    given = torch.nn.Parameter(tensor(width)) if learned else width
    centers = st.StateFollowingCenters(st.rings(3), st.StateRadius(radius, 0.1))
    basis = st.StaFBasis(st.GaussianKernel(given), centers)
    assert basis._local_basis._series_serves(basis.kernel, basis.centers) is serves
    assert basis._local_basis._analytic is serves
    found = basis._local_basis._bound(basis.kernel, basis.centers)
    assert (found is None) is not serves
    newton = st.StaFBasis(st.MaternKernel(1.5), basis.centers)
    assert newton._local_basis._series_serves(newton.kernel, newton.centers) is False


def test_functionals_that_have_one_value_span_the_same_and_see_their_own_monomial_with_a_plus() -> None:
    for points in (st.rings(10), st.ball(7, 3), uniform(4, 1, low=-1.0, seed=14)):
        degrees = degrees_of(points)
        found = functionals_of(points / degrees.reach, degrees)
        assert found.degrees == degrees.each()
        q = found.functionals
        torch.testing.assert_close(q.mT @ q, torch.eye(len(points)).double(), rtol=0, atol=1e-12)
        whole = eliminate(points / degrees.reach)
        alphas = [row for block in degrees.monomials for row in block]
        for j, (degree, alpha) in enumerate(zip(found.degrees, alphas, strict=True)):
            for k in range(degree):
                assert float((q[:, j] @ homogeneous(points, k)).abs().max()) < 1e-11
            monomial = (points ** torch.tensor(alpha)).prod(-1)
            assert float(q[:, j] @ monomial) > 0
            assert float((q[:, j] @ homogeneous(points / degrees.reach, degree)).norm()) > 1e-6
        for k in set(found.degrees):
            ours, theirs = (
                each.functionals[:, [j for j, degree in enumerate(each.degrees) if degree == k]]
                for each in (found, whole)
            )
            torch.testing.assert_close(ours @ ours.mT, theirs @ theirs.mT, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kernel", [st.GaussianKernel(0.7), st.PolynomialKernel(3, 0.5)])
def test_functionals_of_a_space_see_polynomials_of_their_degree_with_the_norm_one(
    kernel: st.Kernel,
) -> None:
    basis = st.StaFBasis(kernel, st.StateFollowingCenters(0.8 * st.rings(6), 0.3))
    space: Any = basis.local(tensor([0.4, -1.0]))
    graded = isinstance(kernel, st.GaussianKernel)
    rows = space.basis.functionals if graded else space.weights_
    points = space.basis.directions if graded else space.directions
    degrees = space.basis.degree.tolist() if graded else space.degrees
    assert list(degrees) == [0, 1, 1, 2, 2, 2]
    for j, k in enumerate(degrees):
        assert float((rows[:, j] @ homogeneous(points, k)).norm()) == pytest.approx(1.0, rel=1e-6)


def test_columns_are_chosen_where_they_are_long_the_first_of_many() -> None:
    lengths = torch.diag(tensor([0.5, 0.7, 1.0, 0.9]))
    assert _independent(lengths, 1) == (1,)  # .7^2 is above .37 of the longest
    assert _independent(lengths, 2) == (1, 2)
    assert _independent(torch.diag(tensor([0.6, 0.7, 1.0])), 1) == (1,)
    assert _independent(torch.diag(tensor([0.61, 0.7, 1.0])), 1) == (0,)
    twice = tensor([[1.0, 1.0, 0.0], [0.0, 1e-6, 1.0]])
    assert _independent(twice, 2) == (0, 2)
    assert _independent(torch.eye(3).double(), 3) == (0, 1, 2)
