"""Full accuracy at every radius: graded and polynomial bases against interpolants in high precision."""

from __future__ import annotations

import copy

import mpmath as mp
import pytest
import torch
from truth import LAYOUTS, RADII, Truth, ball_points, paper, smooth, smooth_target, value_error, worst

import staf_torch as st
from staf_torch.approximation.conditioning import lebesgue_constant
from staf_torch.local_basis import NewtonSpace, PolynomialSpace, phi

KERNELS = {"exponential": (st.ExponentialKernel, None), "gaussian": (lambda: st.GaussianKernel(0.8), 0.8)}


def problem(
    directions: torch.Tensor, kernel: str, radius: float, seed: int
) -> tuple[st.StaF, Truth, float, torch.Tensor]:
    """The fitted module, its truth and points zeta of the unit ball, at a random state."""
    generator = torch.Generator().manual_seed(seed)
    dim = directions.shape[1]
    make, width = KERNELS[kernel]
    # What every dtype sees alike: numbers that float32 can hold.
    x = ball_points(1, dim, generator)[0].float().double()
    zeta = ball_points(4, dim, generator).float().double()
    radius = float(torch.tensor(radius, dtype=torch.float32))
    target, value = (st.targets.Paper(), paper) if dim == 2 else (smooth_target, smooth)
    staf = st.StaF(st.StaFBasis(make(), st.StateFollowingCenters(directions, radius))).fit_(x, target)
    return staf, Truth(directions, radius, x, value, width), radius, zeta


def single(staf: st.StaF) -> st.StaF:
    """The same problem in single precision."""
    target = st.targets.Paper() if staf.basis.dim == 2 else smooth_target
    basis = copy.deepcopy(staf.basis).float()
    return st.StaF(basis).float().fit_(staf.state.float(), target)


@pytest.mark.parametrize(
    ("layout", "kernel", "radius"),
    [
        (layout, kernel, radius)
        for n, layout in enumerate(LAYOUTS)
        for k, kernel in enumerate(KERNELS)
        for r, radius in enumerate(RADII)
        # The truth of 45 centers takes seconds: once each way there.
        if (
            (n + k + r) % 4 == 0
            if layout != "ball45_8"
            else (kernel, radius) in (("exponential", 0.5), ("gaussian", 1e-3))
        )
    ],
)
def test_value_is_exact_to_rounding_at_every_radius(layout: str, kernel: str, radius: float) -> None:
    found = problem(LAYOUTS[layout](), kernel, radius, 1)
    assert value_error(*found) <= 5e-15
    assert value_error(single(found[0]), *found[1:]) <= 5e-7


@pytest.mark.parametrize("seed", range(8))  # every dimension with both kernels
def test_random_offsets_lose_no_more_than_their_lebesgue_constant(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    dim = 1 + seed % 4
    count = 2 + int(torch.randint(9, (), generator=generator))
    directions = ball_points(count, dim, generator)
    radius = float(10 ** (-8 * torch.rand((), generator=generator, dtype=torch.float64) - 0.3))
    kernel = list(KERNELS)[seed // 4]
    found = problem(directions, kernel, radius, seed)
    constant = float(lebesgue_constant(found[0].basis, found[0].state))
    assert constant >= 0.9
    assert value_error(*found) <= 5e-15 * max(1.0, constant)
    assert value_error(single(found[0]), *found[1:]) <= 5e-7 * max(1.0, constant)


@pytest.mark.parametrize(
    ("layout", "kernel", "radius"),
    [
        (layout, kernel, radius)
        for n, layout in enumerate(("rings6", "rings15", "rings28", "ball15_4"))
        for k, kernel in enumerate(KERNELS)
        for r, radius in enumerate(RADII)
        if (n + k + r) % 4 == 0
    ],
)
def test_gradient_is_exact_up_to_the_division_by_the_radius(layout: str, kernel: str, radius: float) -> None:
    directions = LAYOUTS[layout]()
    staf, truth, radius, zeta = problem(directions, kernel, radius, 3)
    y = staf.state + radius * zeta
    z = (y - staf.state) / radius  # what is left of zeta beside x
    expected = [e for row in z for e in truth.gradient(row)]
    found = staf.gradient(y).detach().flatten()
    gap = max(abs(mp.mpf(float(f)) - e) for f, e in zip(found, expected, strict=True))
    constant = float(lebesgue_constant(staf.basis, staf.state))
    # A sample is V at x + d rounded: an error of eps (|V| + |grad V|), which the 1/r of the gradient meets.
    size = float(max(map(abs, expected)) + max(abs(truth.value(row)) for row in z))
    assert float(gap) <= (1e-15 / radius + 1e-13) * constant * size


def test_far_states_lose_nothing() -> None:
    for norm in (20.0, 100.0, 1000.0):
        x = norm * torch.tensor([0.6, -0.8], dtype=torch.float64)
        basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 1e-3 / norm * 20))
        staf = st.StaF(basis).fit_(x, smooth_target)
        radius = float(basis.centers.radius.radius)
        truth = Truth(st.rings(6), radius, x, smooth, None)
        zeta = ball_points(4, 2, torch.Generator().manual_seed(5))
        assert value_error(staf, truth, radius, zeta) <= 1e-12


def test_far_states_with_a_wide_ball_warn_and_are_still_exact() -> None:
    x = torch.tensor([600.0, -800.0], dtype=torch.float64)
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 0.1))
    with pytest.warns(UserWarning, match=r"\|x\| r = 100 > 1.*GaussianKernel"):
        staf = st.StaF(basis).fit_(x, smooth_target)
    truth = Truth(st.rings(6), 0.1, x, smooth, None)
    # Each point by itself: over this ball V^ spans a factor e^200.
    for z in ball_points(6, 2, torch.Generator().manual_seed(6)):
        assert worst(staf.at_offsets((0.1 * z).unsqueeze(0)), [truth.value(z)]) <= 1e-12


def test_weights_that_cannot_be_represented_are_refused_and_named() -> None:
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 1e-3))
    x = torch.tensor([[1.0, 0.0], [600.0, -800.0]], dtype=torch.float64)
    staf = st.StaF(basis, (2,)).fit_(x, smooth_target)
    assert torch.isfinite(staf(x.unsqueeze(-2))).all()
    weights = basis.ideal_weights(x, smooth_target)
    assert torch.isfinite(weights[0]).all()
    assert torch.isnan(weights[1]).all()
    with pytest.raises(ValueError, match=r"`StaF.weights` of the batch entries \[\[1\]\] must be"):
        _ = staf.weights


def test_a_sample_that_is_not_a_number_spoils_its_row_only() -> None:
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(6), st.StateRadius(0.5, 0.1)))
    x = torch.randn(5, 2, dtype=torch.float64)
    values = basis.values(x, smooth_target)
    space = basis.local(x)
    clean = space.fit(values)
    values[3, 2] = torch.nan
    spoiled = space.fit(values)
    assert torch.isnan(spoiled[3]).all()
    others = [0, 1, 2, 4]
    torch.testing.assert_close(spoiled[others], clean[others], rtol=1e-14, atol=1e-14)


def test_phi_functions_agree_with_their_series() -> None:
    t = torch.tensor(
        [-30.0, -4.0, -1.01, -1.0, -0.3, -1e-9, 0.0, 1e-3, 0.7, 1.0, 1.2, 9.0], dtype=torch.float64
    )
    found = phi(t, 6)

    def exact_phi(k: int, at: float) -> mp.mpf:
        return mp.factorial(k) * mp.nsum(lambda j: mp.mpf(at) ** int(j) / mp.factorial(k + int(j)), [0, 200])

    for k, values in enumerate(found):
        for at, value in zip(t, values, strict=True):
            with mp.workdps(60):
                exact = exact_phi(k, float(at))
            loss = 1.0 if abs(float(at)) <= 1 else mp.factorial(k)
            assert abs(mp.mpf(float(value)) - exact) <= 4e-16 * loss * abs(exact) + 4e-16 * (loss > 1) * loss


def test_directions_that_coincide_to_rounding_are_refused() -> None:
    u = torch.tensor([[0.5, 0.0], [0.5 + 1e-15, 0.0], [0.0, 1.0]], dtype=torch.float64)
    with pytest.raises(ValueError, match="must be told apart"):
        st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(u, 0.1))


@pytest.mark.parametrize(("size", "lead"), [(0.2, ()), (0.6, (9,)), (1.0, (2, 3)), (0.2, (2, 1, 3))])
def test_directions_of_any_length_and_states_of_any_leading_dimensions(
    size: float, lead: tuple[int, ...]
) -> None:
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(*lead, 2, dtype=torch.float64, generator=generator)
    moving = st.StateFollowingCenters(size * st.rings(6), st.StateRadius(0.5 / size, 0.05 / size))
    basis = st.StaFBasis(st.GaussianKernel(0.8), moving)
    staf = st.StaF(basis, lead).fit_(x, smooth_target)
    found = staf.at_offsets(moving.offsets(x))
    torch.testing.assert_close(found, smooth_target(basis.centers(x)), rtol=1e-12, atol=1e-13)


def test_directions_that_are_learned_are_set_up_anew_at_every_call() -> None:
    x = torch.randn(4, 2, dtype=torch.float64)
    centers = st.StateFollowingCenters(torch.nn.Parameter(st.rings(6)), 0.3)
    basis = st.StaFBasis(st.GaussianKernel(0.8), centers)
    for turn in (0.0, 0.4):
        with torch.no_grad():
            centers.directions.mul_(1 - turn * torch.rand(6, 2, dtype=torch.float64))
        fixed = st.StaFBasis(
            st.GaussianKernel(0.8), st.StateFollowingCenters(centers.directions.detach().clone(), 0.3)
        )
        weights = [each.ideal_weights(x, smooth_target) for each in (basis, fixed)]
        torch.testing.assert_close(*weights, rtol=1e-6, atol=1e-6)


# The polynomial kernel.


@pytest.mark.parametrize(
    ("layout", "degree", "bias"),
    [("rings3", 3, 1.0), ("rings6", 2, 0.2), ("rings10", 5, 1.0), ("rings15", 6, 0.5), ("ball15_4", 2, 1.0)],
)
def test_polynomial_kernel_is_exact_to_rounding_at_every_radius(
    layout: str, degree: int, bias: float
) -> None:
    directions = LAYOUTS[layout]()
    dim = directions.shape[1]
    generator = torch.Generator().manual_seed(11)
    x, zeta = 2 * ball_points(1, dim, generator)[0], ball_points(4, dim, generator)
    target, value = (st.targets.Paper(), paper) if dim == 2 else (smooth_target, smooth)
    for radius in RADII:
        centers = st.StateFollowingCenters(directions, radius)
        staf = st.StaF(st.StaFBasis(st.PolynomialKernel(degree, bias), centers)).fit_(x, target)
        assert isinstance(staf.basis.local(x), PolynomialSpace)
        truth = Truth(directions, radius, x, value, polynomial=(degree, bias))
        assert value_error(staf, truth, radius, zeta) <= 5e-15, radius


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
