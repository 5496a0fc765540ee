"""Layouts, radii and the centers that they make."""

from __future__ import annotations

import math
import re
import warnings

import pytest
import torch
from helpers import tensor, uniform
from variants import KERNELS, LAYOUTS, RADII, by_turns, directions_of, over

import staf_torch as st
from staf_torch.approximation.conditioning import lebesgue_constant, sup_error
from staf_torch.centers import probe_points
from staf_torch.targets import Cosine, Paper


def monomials(points: torch.Tensor, degree: int) -> torch.Tensor:
    """All products of at most ``degree`` coordinates, by recursion on the number of variables."""
    if points.shape[1] == 0:
        return points.new_ones(points.shape[0], 1)
    first, rest = points[:, :1], points[:, 1:]
    return torch.cat([first**k * monomials(rest, degree - k) for k in range(degree + 1)], dim=1)


@over(LAYOUTS)
def test_points_of_a_layout_are_as_many_as_it_says_apart_and_in_the_closed_unit_ball_every_time(
    name: str,
) -> None:
    case, directions = LAYOUTS[name], directions_of(name)
    assert directions.shape == (case.count, case.dim)
    assert directions.dtype == torch.float64
    assert directions.norm(dim=-1).max() <= 1 + 4e-16
    st.StateFollowingCenters(directions, 0.1)
    if case.count > 1:
        assert torch.pdist(directions).min() > 0.5 * case.count ** (-1 / case.dim)
    torch.rand(3)
    assert torch.equal(directions, case.make())


@over(LAYOUTS)
def test_layout_determines_polynomials_of_its_degree(name: str) -> None:
    case = LAYOUTS[name]
    vandermonde = monomials(directions_of(name), case.degree)
    singular = torch.linalg.svdvals(vandermonde)
    assert singular.shape[0] == vandermonde.shape[1]
    assert singular[-1] > 1e-3 * singular[0]


@pytest.mark.parametrize("count", [3, 6, 10, 15, 21, 28])
def test_rings_have_the_radii_of_bos(count: int) -> None:
    sizes = {3: [3], 6: [5, 1], 10: [7, 3], 15: [9, 5, 1], 21: [11, 7, 3], 28: [13, 9, 5, 1]}[count]
    radii = {3: [1], 6: [1, 0], 10: [1, 0.43], 15: [1, 0.63, 0], 21: [1, 0.75, 0.28], 28: [1, 0.82, 0.46, 0]}
    expected = [r for size, r in zip(sizes, radii[count], strict=True) for _ in range(size)]
    torch.testing.assert_close(st.rings(count).norm(dim=-1), tensor(expected), rtol=1e-15, atol=1e-15)


def test_rings_of_three_are_the_triangle_of_the_paper() -> None:
    expected = tensor([[0, 1], [math.sqrt(3) / 2, -0.5], [-math.sqrt(3) / 2, -0.5]])
    torch.testing.assert_close(st.rings(3), expected, rtol=1e-15, atol=1e-15)
    assert torch.equal(st.rings(3), st.polygon(3))


@pytest.mark.parametrize("dim", [1, 2, 3, 4, 7])
def test_simplex_is_regular_and_centred(dim: int) -> None:
    corners = st.simplex(dim)
    expected = torch.full((dim + 1, dim + 1), -1 / dim, dtype=torch.float64).fill_diagonal_(1.0)
    torch.testing.assert_close(corners @ corners.mT, expected, rtol=1e-14, atol=1e-14)
    assert corners.sum(0).abs().max() < 1e-14


@pytest.mark.parametrize("dim", [1, 2, 3, 6])
def test_cross_polytope_is_plus_and_minus_every_axis(dim: int) -> None:
    rows = {tuple(row) for row in st.cross_polytope(dim).tolist()}
    assert rows == {tuple(s * float(i == k) for i in range(dim)) for k in range(dim) for s in (1, -1)}


def test_a_polygon_of_five_or_more_corners_warns_with_the_reason() -> None:
    with pytest.warns(UserWarning, match=r"polygon\(5\).*conic.*second-order.*rings\(6\)"):
        st.polygon(5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        st.polygon(4)


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_probe_points_fill_the_ball_and_start_at_its_center(dim: int) -> None:
    points = probe_points(193, dim)
    assert points.shape == (193, dim)
    assert torch.equal(points[0], torch.zeros(dim).double())
    norms = points.norm(dim=-1)
    assert norms.max() == pytest.approx(1, abs=1e-15)
    assert norms.max() <= 1 + 4e-16
    directions = torch.cat((st.cross_polytope(dim), st.simplex(dim)))
    assert (directions @ points.mT).amax(-1).min() > (0.99 if dim <= 2 else 0.75)


@pytest.mark.parametrize(("name", "batch"), by_turns(RADII, [(), (4,), (2, 3)]))
def test_centers_are_the_state_plus_the_radius_times_the_directions(
    name: str, batch: tuple[int, ...]
) -> None:
    make, formula = RADII[name]
    directions = st.rings(6)
    centers = st.StateFollowingCenters(directions, make())
    x = uniform(*batch, 2)
    got = centers(x)
    assert got.shape == (*batch, 6, 2)
    assert torch.equal(got, x.unsqueeze(-2) + centers.offsets(x))
    for at, found in zip(x.reshape(-1, 2), got.reshape(-1, 6, 2), strict=True):
        expected = at + formula(at.tolist()) * directions
        torch.testing.assert_close(found, expected, rtol=1e-14, atol=1e-15)
    assert centers(x.float()).dtype == torch.float32


def test_gradient_reaches_the_state_through_a_shrinking_radius() -> None:
    centers = st.StateFollowingCenters(st.rings(6), st.StateRadius(0.7, 0.01))
    assert torch.autograd.gradcheck(centers, (uniform(3, 2).requires_grad_(),))


@over(KERNELS)
def test_permuted_centers_permute_the_weights_and_leave_the_estimate(name: str) -> None:
    kernel, order = KERNELS[name].make(), [4, 2, 0, 5, 1, 3]
    target = Cosine([1.0, 2.0])
    x, y = uniform(2, low=0.5), uniform(4, 2)
    plain, moved = (
        st.StaFBasis(kernel, st.StateFollowingCenters(directions, 0.4))
        for directions in (st.rings(6), st.rings(6)[order])
    )
    first, second = plain.ideal_weights(x, target), moved.ideal_weights(x, target)
    torch.testing.assert_close(second, first[order], rtol=1e-8, atol=1e-8 * float(first.abs().max()))
    fits = [st.StaF(basis).fit_(x, target)(y) for basis in (plain, moved)]
    torch.testing.assert_close(fits[1], fits[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: st.rings(4), "`rings(count=...)` must be one of 3, 6, 10, 15, 21, 28; got 4."),
        (lambda: st.StateFollowingCenters(2 * st.rings(3), 0.1), "must lie in the closed unit ball"),
        (lambda: st.StateFollowingCenters(torch.zeros(2, 2), 0.1), "must be distinct, but direction 0"),
        (lambda: st.StateFollowingCenters(torch.zeros(0, 2), 0.1), "must have the shape (M, n); got (0, 2)"),
    ],
)
def test_a_bad_argument_is_named_with_its_value(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=re.escape(message)):
        make()


@pytest.mark.parametrize(("dim", "degree"), [(6, 2), (12, 1), (3, 4)])
def test_ball_is_unisolvent_and_well_conditioned_up_to_twelve_dimensions(dim: int, degree: int) -> None:
    count = math.comb(dim + degree, degree)
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.ball(count, dim), 1e-3))
    st.ball(count, dim).zero_()  # a copy
    assert int(torch.linalg.matrix_rank(monomials(st.ball(count, dim), degree))) == count
    # Of Fekete points at most the number of points; these stay well below it.
    assert float(lebesgue_constant(basis, torch.zeros(dim).double(), points=2000)) < 0.4 * count + 1


def test_ball_is_no_worse_than_the_rings_in_the_plane() -> None:
    x = torch.tensor([[0.9, 0.2], [-0.3, 0.8], [0.1, -1.0]]).double()
    for count in (3, 10, 28):
        errors = [
            sup_error(st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(u, 0.1)), x, Paper())
            for u in (st.ball(count, 2), st.rings(count))
        ]
        assert (errors[0] <= 3 * errors[1]).all()


@pytest.mark.parametrize(("offset", "gain"), [(0.05, 1.5), (2.0, 1.5), (0.0, 0.5), (1.0, 1.0)])
def test_a_radius_stays_below_its_bound_and_comes_as_near_as_one_likes(offset: float, gain: float) -> None:
    radius = st.StateRadius(0.7, offset, gain)
    nu = radius(tensor([[0.0, 0.0], *([10.0**k, 0.0] for k in range(-3, 7))]))
    bound = float(radius.bound())
    assert bool((nu <= bound * (1 + 1e-12)).all())
    assert float(nu.max()) == pytest.approx(bound, rel=1e-9)
    assert radius.constant is False
    assert float(st.ConstantRadius(0.2).bound()) == 0.2
