"""The power function against its formula in high precision."""

from __future__ import annotations

import mpmath as mp
import pytest
import torch
from helpers import basis_of, uniform
from truth import Truth, smooth
from variants import KERNELS, over

import staf_torch as st
from staf_torch.theory import power_function

LAYOUTS = {
    "rings3": st.rings(3),
    "rings6": st.rings(6),
    "rings10": st.rings(10),
    "ball10_3": st.ball(10, 3),
    "polygon4": st.polygon(4),
    "ball8_2": st.ball(8, 2),
    "cross_polytope3": st.cross_polytope(3),
    "one": torch.zeros(1, 2, dtype=torch.float64),
}


@pytest.mark.parametrize("radius", [1e-8, 1e-3, 0.1, 0.5])
@pytest.mark.parametrize("width", [None, 0.7])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_power_function_keeps_its_digits_at_every_radius(
    layout: str, width: float | None, radius: float
) -> None:
    u = LAYOUTS[layout]
    dim = u.shape[1]
    x = uniform(dim, low=-0.6, high=0.6, seed=1)
    zeta = uniform(5, dim, low=-0.57, high=0.57, seed=2)
    kernel = st.ExponentialKernel() if width is None else st.GaussianKernel(width)
    basis = st.StaFBasis(kernel, st.StateFollowingCenters(u, radius))
    found = power_function(basis, x, radius * zeta)
    truth = Truth(u, radius, x, smooth, width)
    with mp.workdps(truth.digits):
        gram = mp.matrix([[truth._kernel(a, b) for b in truth.d] for a in truth.d])
        for point, value in zip(zeta, found, strict=True):
            z = [truth.radius * mp.mpf(float(e)) for e in point]
            row = mp.matrix([truth._kernel(z, d) for d in truth.d])
            square = truth._kernel(z, z) - (row.T * mp.cholesky_solve(gram, row))[0]
            gain = mp.exp(mp.fsum(e * e for e in truth.x) / 2) if width is None else 1
            expected = mp.sqrt(square) * gain
            assert abs(mp.mpf(float(value)) - expected) <= mp.mpf(1e-11) * expected


@over(KERNELS)
def test_power_function_vanishes_at_the_centers_and_bounds_the_error_of_kernel_functions(name: str) -> None:
    basis, x = basis_of(name, 6, 0.4), uniform(3, 2, low=0.3)
    offsets = basis.centers.offsets(x)
    size = float(basis.gram(x).abs().max()) ** 0.5
    assert float(power_function(basis, x, offsets).max()) <= 1e-6 * size
    z = 0.4 * uniform(4, 2, low=-0.6, high=0.6)
    # V = k(., v): ||V - V^|| = P(v), so |V(y) - V^(y)| <= P(y) P(v).
    v = x + 0.3
    error = basis.kernel(x.unsqueeze(-2) + z, v.unsqueeze(-2)).squeeze(-1)
    space = basis.local(x)
    samples = basis.kernel(basis.centers(x), v.unsqueeze(-2)).squeeze(-1)
    error = (error - space.evaluate(z, space.fit(samples))).abs()
    bound = power_function(basis, x, z) * power_function(basis, x, torch.full((1, 2), 0.3).double())
    assert (error <= bound * (1 + 1e-6) + 1e-9 * size**2).all()


def test_relative_power_function_is_finite_where_the_kernel_overflows() -> None:
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 1e-3))
    z = 1e-3 * uniform(4, 2, low=-0.5, high=0.5)
    near, far = (
        power_function(basis, torch.tensor([s, 0.0]).double(), z, relative=True) for s in (0.0, 1000.0)
    )
    torch.testing.assert_close(far, near, rtol=1e-9, atol=0)
    with pytest.raises(ValueError, match=r"`power_function\(z=...\)` must have 2 entries"):
        power_function(basis, torch.zeros(2).double(), torch.zeros(4, 3).double())
