"""The smallest counts of centers: the reference numbers, and what must hold."""

from __future__ import annotations

import math

import mpmath as mp
import pytest
import torch
from helpers import basis_of, tensor, uniform
from helpers_theory import random_offsets
from truth import Truth, smooth
from variants import KERNELS, by_turns, over

import staf_torch as st
from staf_torch import (
    ExponentialKernel,
    GaussianKernel,
    MaternKernel,
    StaFBasis,
    StateFollowingCenters,
    ball,
    polygon,
    rings,
    targets,
    theory,
)
from staf_torch.targets import Paper
from staf_torch.theory import power_function

PAPER = targets.Paper()
CIRCLE_ANGLES = torch.arange(32, dtype=torch.float64) * (2 * math.pi / 32)
CIRCLE = torch.stack((CIRCLE_ANGLES.cos(), -CIRCLE_ANGLES.sin()), dim=-1)

REFERENCE_COUNTS = {0.05: (2, 6, 6, 10, 15), 0.1: (3, 6, 10, 10, 21), 0.2: (6, 10, 15, 15, 28)}
EPSILONS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)


@pytest.mark.parametrize("radius", REFERENCE_COUNTS)
def test_smallest_counts_along_the_unit_circle_are_the_reference(radius: float) -> None:
    found = theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE, radius, EPSILONS[-1])
    worst = found.errors.amax(-1)
    counts = [int(found.counts[worst <= epsilon][0]) for epsilon in EPSILONS]
    assert tuple(counts) == REFERENCE_COUNTS[radius]
    assert found.count == counts[-1]


def test_errors_of_layouts_are_the_reference() -> None:
    """MATH.md section 1, worst of six states (which are not stated: hence 10 %)."""
    layouts = [rings(3), rings(6), rings(10), rings(15)]
    with pytest.warns(UserWarning, match="conic"):
        layouts += [polygon(6), polygon(10), polygon(15)]
    angle = torch.arange(6, dtype=torch.float64) * (math.pi / 3)
    states = torch.stack((angle.cos(), angle.sin()), dim=-1)
    errors = theory.layout_errors(PAPER, ExponentialKernel(), states, 0.1, layouts).amax(-1)
    reference = torch.tensor([5.2e-2, 2.4e-3, 7.1e-5, 1.1e-6, 2.35e-2, 2.35e-2, 2.35e-2]).double()
    torch.testing.assert_close(errors, reference, rtol=0.1, atol=0)
    torch.testing.assert_close(errors[-1], errors[-2], rtol=1e-3, atol=0)  # more corners gain nothing


@pytest.mark.parametrize(
    ("kernel", "dim"), [(ExponentialKernel(), 1), (GaussianKernel(0.7), 2), (MaternKernel(2.5), 3)]
)
def test_errors_of_layouts_bound_the_error_at_random_points(kernel: torch.nn.Module, dim: int) -> None:
    target, radius = targets.Cosine(1.5), 0.3
    states = theory.disc(1.0, dim=dim, count=4)
    layout = ball(math.comb(dim + 2, 2), dim)
    error = theory.layout_errors(target, kernel, states, radius, [layout])[0]  # type: ignore[arg-type]
    space = StaFBasis(kernel, StateFollowingCenters(layout, radius)).local(states)  # type: ignore[arg-type]
    coefficients = space.fit(target(states.unsqueeze(-2) + radius * layout))
    z = random_offsets(radius, 4, 1000, dim)
    found = (target(states.unsqueeze(-2) + z) - space.evaluate(z, coefficients)).abs().amax(-1)
    assert (found <= error * 1.001).all()
    assert (found > 0.5 * error).all()


def test_pointwise_counts_are_the_smallest_at_each_state() -> None:
    found = theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE[:12].reshape(3, 4, 2), 0.1, 1e-3)
    assert found.pointwise.shape == (3, 4)
    assert found.errors.shape == (len(found.counts), 3, 4)
    for b in range(3):
        for t in range(4):
            enough = found.counts[found.errors[:, b, t] <= 1e-3]
            assert found.pointwise[b, t] == enough[0] <= found.count
    alone = theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE[5], 0.1, 1e-3)
    assert alone.pointwise == found.pointwise[1, 1]


def test_standard_layouts_grow_and_start_below_a_triangle() -> None:
    assert [len(layout) for layout in theory.standard_layouts(2)] == [1, 2, 3, 6, 10, 15, 21, 28]
    assert [len(layout) for layout in theory.standard_layouts(3)][:4] == [1, 4, 10, 20]


def test_state_with_nan_spoils_its_own_error_only() -> None:
    states = CIRCLE[:4].clone()
    clean = theory.layout_errors(PAPER, ExponentialKernel(), states, 0.1, [rings(6)])
    states[2] = torch.nan
    errors = theory.layout_errors(PAPER, ExponentialKernel(), states, 0.1, [rings(6)])
    assert errors.isnan().tolist() == [[False, False, True, False]]
    torch.testing.assert_close(errors[:, [0, 1, 3]], clean[:, [0, 1, 3]], rtol=0, atol=1e-14)


FINE = {"target": PAPER, "kernel": ExponentialKernel(), "states": CIRCLE[:4], "radius": 0.1, "epsilon": 1e-2}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"epsilon": 1e-18}, r"in the reach of a layout.*got 1e-18"),
        ({"layouts": []}, "at least one layout"),
        ({"layouts": [ball(4, 3)]}, r"minimal_count\(layouts=\.\.\.\)` must have 2 entries"),
        ({"target": lambda y: y}, r"must map points of shape \(\.\.\., n\)"),
    ],
)
def test_bad_arguments_of_the_smallest_count_are_named(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        theory.minimal_count(**(FINE | wrong))  # type: ignore[arg-type]


STATES = tensor([[1.0, 0.0], [0.3, -0.9], [-1.2, 0.4], [0.2, 0.1], [0.0, 0.8], [-0.5, -0.5], [0.9, 0.9]])


def test_an_error_that_equals_what_is_allowed_is_allowed() -> None:
    layouts = [st.rings(10), st.rings(3), st.rings(6)]  # tried from the fewest centers on
    kernel = st.ExponentialKernel()
    errors = theory.layout_errors(Paper(), kernel, STATES, 0.1, layouts)
    for k, layout in enumerate(layouts):
        epsilon = float(errors[k].max())
        assert theory.minimal_count(Paper(), kernel, STATES, 0.1, epsilon, layouts).count == len(layout)


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


POWER_LAYOUTS = {
    "rings3": st.rings(3),
    "rings6": st.rings(6),
    "rings10": st.rings(10),
    "ball10_3": st.ball(10, 3),
    "cross_polytope3": st.cross_polytope(3),
    "one": torch.zeros(1, 2, dtype=torch.float64),
}


RADII_AND_WIDTHS = [(1e-8, None), (0.5, None), (0.1, 0.7), (1e-8, 0.7), (0.1, None), (0.5, 0.7)]


@pytest.mark.parametrize(("layout", "given"), by_turns(POWER_LAYOUTS, RADII_AND_WIDTHS))
def test_power_function_keeps_its_digits_at_every_radius(
    layout: str, given: tuple[float, float | None]
) -> None:
    radius, width = given
    u = POWER_LAYOUTS[layout]
    dim = u.shape[1]
    x = uniform(dim, low=-0.6, high=0.6, seed=1)
    zeta = uniform(5, dim, low=-0.57, high=0.57, seed=2)
    kernel = st.ExponentialKernel() if width is None else st.GaussianKernel(width)
    basis = st.StaFBasis(kernel, st.StateFollowingCenters(u, radius))
    found = power_function(basis, x, radius * zeta)
    truth = Truth(u, radius, x, smooth, width)
    with mp.workdps(truth.digits):
        gram = mp.matrix([[truth.kernel(a, b) for b in truth.d] for a in truth.d])
        for point, value in zip(zeta, found, strict=True):
            z = [truth.radius * mp.mpf(float(e)) for e in point]
            row = mp.matrix([truth.kernel(z, d) for d in truth.d])
            square = truth.kernel(z, z) - (row.T * mp.cholesky_solve(gram, row))[0]
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
