"""The polynomial kernel's local basis against interpolants in high precision."""

from __future__ import annotations

import pytest
import torch
from truth import LAYOUTS, RADII, Truth, ball_points, paper, smooth, smooth_target, value_error

import staf_torch as st
from staf_torch.local_basis import NewtonSpace, PolynomialSpace


@pytest.mark.parametrize("radius", RADII)
@pytest.mark.parametrize(
    ("layout", "degree", "bias"),
    [("rings3", 3, 1.0), ("rings6", 2, 0.2), ("rings10", 5, 1.0), ("rings15", 6, 0.5), ("ball15_4", 2, 1.0)],
)
def test_polynomial_kernel_is_exact_to_rounding_at_every_radius(
    layout: str, degree: int, bias: float, radius: float
) -> None:
    directions = LAYOUTS[layout]()
    dim = directions.shape[1]
    generator = torch.Generator().manual_seed(11)
    x, zeta = 2 * ball_points(1, dim, generator)[0], ball_points(4, dim, generator)
    target, value = (st.targets.Paper(), paper) if dim == 2 else (smooth_target, smooth)
    centers = st.StateFollowingCenters(directions, radius)
    staf = st.StaF(st.StaFBasis(st.PolynomialKernel(degree, bias), centers)).fit_(x, target)
    assert isinstance(staf.basis.local(x), PolynomialSpace)
    truth = Truth(directions, radius, x, value, polynomial=(degree, bias))
    assert value_error(staf, truth, radius, zeta) <= 5e-15


def test_polynomial_kernel_with_a_moving_radius_agrees_with_the_constant_one_row_by_row() -> None:
    kernel, directions = st.PolynomialKernel(4, 0.7), st.rings(10)
    moving = st.StateFollowingCenters(directions, st.StateRadius(0.5, 0.0))
    x = torch.randn(9, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(12))
    x[4], x[6] = 0.0, torch.nan
    basis = st.StaFBasis(kernel, moving)
    space = basis.local(x)
    assert space.rank.tolist() == [10, 10, 10, 10, 1, 10, 1, 10, 10]
    zeta = ball_points(5, 2, torch.Generator().manual_seed(13))
    nu = moving.radius(x)
    found = space.evaluate(nu[:, None, None] * zeta, space.fit(basis.values(x, smooth_target)))
    for row in (0, 3, 8):
        fixed = st.StaFBasis(kernel, st.StateFollowingCenters(directions, float(nu[row])))
        expected = st.StaF(fixed).fit_(x[row], smooth_target).at_offsets(nu[row] * zeta)
        torch.testing.assert_close(found[row], expected.detach(), rtol=1e-12, atol=1e-12)
    assert torch.isnan(found[6]).all()


def test_polynomial_kernels_without_the_full_space_use_the_newton_basis_and_report_its_rank() -> None:
    x = torch.rand(2, dtype=torch.float64)
    homogeneous = st.StaFBasis(st.PolynomialKernel(2, 0.0), st.StateFollowingCenters(st.rings(3), 0.3))
    assert isinstance(homogeneous.local(x), NewtonSpace)
    with pytest.warns(UserWarning, match="conic"):
        hexagon = st.polygon(6)
    conic = st.StaFBasis(st.PolynomialKernel(2), st.StateFollowingCenters(hexagon, 0.3))
    assert int(conic.local(x).rank) == 5  # six points of a conic, where five quadratics differ
