"""The bound for the exponential kernel and the smallest counts: the reference numbers, and what must hold."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

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
from staf_torch.theory.polynomials import monomials, near_best
from staf_torch.theory.sampling import ball_grid, supremum

PAPER = targets.Paper()
CIRCLE_ANGLES = torch.arange(64, dtype=torch.float64) * (2 * math.pi / 64)
CIRCLE = torch.stack((CIRCLE_ANGLES.cos(), -CIRCLE_ANGLES.sin()), dim=-1)


def random_offsets(radius: float, states: int, count: int, dim: int, seed: int = 0) -> Tensor:
    """Uniform in the ball, and as many on its surface: (states, 2 count, dim)."""
    generator = torch.Generator().manual_seed(seed)
    inside, surface = (torch.randn(states, count, dim, generator=generator).double() for _ in range(2))
    depth = torch.rand(states, count, 1, generator=generator).double() ** (1 / dim)
    units = [u / u.norm(dim=-1, keepdim=True) for u in (inside, surface)]
    return radius * torch.cat((depth * units[0], units[1]), dim=1)


# --- the bound for the exponential kernel ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("radius", "epsilon", "N", "S", "count", "one"),
    [
        (0.1, 1e-2, 2, 2, 15, 6),
        (0.1, 1e-3, 3, 2, 21, 10),
        (0.1, 1e-4, 3, 3, 28, 10),
        (0.5, 1e-2, 5, 4, 55, 15),
        (0.5, 1e-4, 8, 5, 105, 28),
    ],
)
@pytest.mark.parametrize("states", [17, 41, 53])
def test_bound_of_the_paper_example_is_the_reference(
    radius: float, epsilon: float, N: int, S: int, count: int, one: int, states: int
) -> None:
    bound = theory.exponential_bound(PAPER, theory.disc(1.0, count=states), radius, epsilon)
    assert (bound.N, bound.S, bound.count, bound.one_polynomial_count) == (N, S, count, one)
    assert bound.two_polynomials.degree == N + S


DOMAINS = {
    "paper": (PAPER, theory.disc(1.0, count=17), 0.2),
    "line": (targets.Cosine(2.0), theory.disc(1.5, dim=1, count=5), 0.3),
    "space": (targets.Cosine([1.0, 2.0, -1.0]), theory.disc(1.0, dim=3, count=7), 0.3),
    "aside": (PAPER, theory.disc(0.5, count=7, center=[0.8, -0.6]), 0.2),
}


@pytest.mark.parametrize("name", DOMAINS)
@pytest.mark.parametrize("epsilon", [1e-1, 1e-3])
def test_verified_error_bounds_the_error_at_random_points_and_is_within_epsilon(
    name: str, epsilon: float
) -> None:
    target, domain, radius = DOMAINS[name]
    bound = theory.exponential_bound(target, domain, radius, epsilon)
    z = random_offsets(radius, len(domain), 2000, domain.shape[-1])
    for built in (bound.two_polynomials, bound.one_polynomial):
        worst = float((target(domain.unsqueeze(-2) + z) - built(z)).abs().max())
        assert worst <= built.error <= epsilon
        assert worst > 0.5 * built.error  # and it is no empty bound


@pytest.mark.parametrize("name", DOMAINS)
def test_construction_is_a_combination_of_kernels_with_centers_in_the_ball(name: str) -> None:
    """The binomial sum over the centers x + l/m is the product form, where it can still be computed."""
    target, domain, radius = DOMAINS[name]
    built = theory.one_polynomial_bound(target, domain, radius, 0.3)
    dim, m = domain.shape[-1], built.m
    assert built.degree / m < radius
    assert built.count == math.comb(dim + built.degree, dim)
    index = torch.cartesian_prod(*[torch.arange(built.degree + 1)] * dim).reshape(-1, dim)
    index = index[index.sum(-1) <= built.degree].double()
    z = random_offsets(radius, 1, 4 * built.count, dim)[0]
    span = torch.exp(z @ (index / m).mT)  # e^{z'l/m}, |l| <= degree
    scaled = built(z) * torch.exp(-domain @ z.mT)
    assert span.shape[1] == built.count
    fitted = span @ torch.linalg.lstsq(span, scaled.mT, driver="gelsd").solution
    assert (fitted - scaled.mT).abs().max() < 1e-7 * scaled.abs().max()


def test_construction_takes_offsets_of_each_state_or_of_all() -> None:
    domain = theory.disc(1.0, count=5)
    built = theory.one_polynomial_bound(PAPER, domain, 0.1, 1e-2)
    z = random_offsets(0.1, 1, 10, 2)[0]
    torch.testing.assert_close(built(z), built(z.expand(5, 20, 2)))
    for wrong in (torch.zeros(3), torch.zeros(4, 3), torch.zeros(4, 6, 2), torch.zeros(1, 5, 6, 2)):
        with pytest.raises(ValueError, match="Construction"):
            built(wrong)


def test_one_polynomial_never_needs_more_kernels_and_holds_far_from_the_origin() -> None:
    for epsilon in (1e-1, 1e-2, 1e-3):
        bound = theory.exponential_bound(PAPER, theory.disc(1.0, count=9), 0.3, epsilon)
        assert bound.one_polynomial_count <= bound.count
    far = theory.disc(0.5, count=5, center=[4.0, 3.0])
    assert theory.one_polynomial_bound(PAPER, far, 0.1, 1e-2).error <= 1e-2
    with pytest.raises(ValueError, match=r"exponential_bound\(epsilon=.*degree 16"):
        theory.exponential_bound(PAPER, far, 0.1, 1e-2)


def test_polynomial_target_at_the_origin_needs_its_own_degree() -> None:
    origin = torch.zeros(1, 2, dtype=torch.float64)
    bound = theory.exponential_bound(targets.Quadratic(), origin, 0.5, 1e-9)
    assert (bound.N, bound.S, bound.one_polynomial.degree) == (2, 0, 2)


def test_zero_target_needs_nothing() -> None:
    bound = theory.exponential_bound(lambda y: 0 * y[..., 0], theory.disc(1.0, count=5), 0.1, 1e-3)
    assert (bound.N, bound.S, bound.count, bound.one_polynomial.error) == (0, 0, 1, 0.0)


def test_domain_in_single_precision_gives_the_same_degrees_where_they_are_clear() -> None:
    bound = theory.exponential_bound(PAPER, theory.disc(1.0, count=17).float(), 0.1, 1e-3)
    assert (bound.N, bound.S, bound.count, bound.one_polynomial_count) == (3, 2, 21, 10)


GOOD = {"target": PAPER, "domain": theory.disc(1.0, count=5), "radius": 0.1, "epsilon": 1e-2}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"epsilon": 0.0}, r"exponential_bound\(epsilon=\.\.\.\)` must be positive; got 0.0"),
        ({"epsilon": -1.0}, r"epsilon=\.\.\.\)` must be positive; got -1.0"),
        ({"epsilon": math.nan}, r"epsilon=\.\.\.\)` must be finite"),
        ({"radius": 0.0}, r"exponential_bound\(radius=\.\.\.\)` must be positive; got 0.0"),
        ({"radius": "0.1"}, r"radius=\.\.\.\)` must be a number"),
        ({"domain": torch.zeros(2).double()}, "at least 2 dimensions"),
        ({"domain": torch.zeros(0, 2).double()}, r"must have the shape \(D, n\)"),
        ({"domain": torch.zeros(1, 3, 2).double()}, r"must have the shape \(D, n\)"),
        ({"domain": torch.tensor([[math.inf, 0.0]])}, r"domain=\.\.\.\)` must be finite"),
        ({"domain": [[0.0, 0.0]]}, "must be a tensor"),
        ({"target": lambda y: y}, r"must map points of shape \(\.\.\., n\)"),
        ({"target": lambda y: y[..., 0] / 0}, "must be finite on the balls"),
        ({"max_degree": -1}, "max_degree"),
        ({"epsilon": 1e-4, "max_degree": 2}, r"polynomials of degree 2 \(6 terms\).*got 0.0001"),
        ({"target": lambda y: y.norm(dim=-1), "epsilon": 1e-5}, "reach of polynomials of degree 16"),
    ],
)
def test_bad_arguments_of_the_bound_are_named(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        theory.exponential_bound(**(GOOD | wrong))  # type: ignore[arg-type]


# --- polynomials, grids, suprema ------------------------------------------------------------------------


def test_near_best_polynomial_of_a_power_is_chebyshevs() -> None:
    """The best approximation of t^(d+1) on [-1, 1] by degree d leaves 2^-d, and nothing can be better."""
    z = torch.cos(torch.linspace(0, math.pi, 400, dtype=torch.float64)).unsqueeze(-1)
    for degree in range(7):
        f = z[:, 0] ** (degree + 1)
        tolerance = torch.full((1,), 2.0**-degree * 1.01, dtype=torch.float64)
        fit = near_best(z, degree, f.unsqueeze(0), torch.ones(1, 400).double(), tolerance)
        assert fit.lower <= 2.0**-degree * (1 + 1e-9)
        assert 2.0**-degree * (1 - 1e-3) <= fit.error <= 2.0**-degree * 1.05
        left = f - (monomials(z, degree) @ fit.coefficients[0])
        torch.testing.assert_close(left.abs().max(), fit.error[0])


def test_rows_of_a_fit_do_not_depend_on_the_other_rows() -> None:
    z = ball_grid(2, 5, 24)
    f = torch.stack([(z @ torch.tensor(a).double()).exp() for a in ([1.0, 0.0], [0.3, -0.7], [2.0, 1.0])])
    weight, inexact = torch.ones_like(f), torch.full((3,), 1e9, dtype=torch.float64)
    squares = near_best(z, 3, f, weight, inexact).error  # the first iterate: least squares
    for share in ([1.5, 1.1, 1.2], [1.1, 1.5, 1.2]):  # of it: one row is done at once, others later
        tolerance = squares * torch.tensor(share).double()
        together = near_best(z, 3, f, weight, tolerance)
        assert (together.error <= tolerance).all()
        for row in range(3):
            alone = near_best(z, 3, f[row : row + 1], weight[:1], tolerance[row : row + 1])
            torch.testing.assert_close(
                alone.coefficients[0], together.coefficients[row], rtol=1e-9, atol=1e-12
            )


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_grid_and_covering_lie_in_their_balls(dim: int) -> None:
    grid = ball_grid(dim, 4, 16)
    assert grid[0].norm() == 0
    assert grid.norm(dim=-1).max() <= 1 + 1e-15
    states = theory.disc(2.0, dim=dim, count=20, center=[1.0] * dim)
    assert states.shape == (20, dim)
    assert torch.equal(states[0], torch.ones(dim).double())
    assert (states - 1).norm(dim=-1).max() <= 2 + 1e-12


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_supremum_climbs_to_peaks_between_the_points_of_the_grid(dim: int) -> None:
    generator = torch.Generator().manual_seed(dim)
    peaks = random_offsets(0.5, 1, 4, dim, seed=dim)[0]
    height = 1 + torch.rand(len(peaks), generator=generator).double()

    def bumps(z: Tensor) -> Tensor:
        distance = (z - peaks.unsqueeze(-2)).square().sum(-1)  # (D, P)
        return height.unsqueeze(-1) * torch.exp(-30 * distance)

    found = supremum(bumps, 0.5 * ball_grid(dim, 3, 9), 0.5)
    torch.testing.assert_close(found, height, rtol=1e-4, atol=0)


# --- the smallest counts --------------------------------------------------------------------------------

REFERENCE_COUNTS = {0.05: (2, 6, 6, 10, 15), 0.1: (3, 6, 10, 10, 21), 0.2: (6, 10, 15, 15, 28)}
EPSILONS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)


@pytest.mark.parametrize("radius", REFERENCE_COUNTS)
def test_smallest_counts_along_the_unit_circle_are_the_reference(radius: float) -> None:
    counts = [
        theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE, radius, epsilon).count
        for epsilon in EPSILONS
    ]
    assert tuple(counts) == REFERENCE_COUNTS[radius]


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


@pytest.mark.parametrize("kernel", [ExponentialKernel(), GaussianKernel(0.7), MaternKernel(2.5)])
@pytest.mark.parametrize("dim", [1, 2, 3])
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


def test_layouts_of_a_users_own_are_tried_from_the_fewest_centers_on() -> None:
    own = [ball(10, 2), ball(3, 2), ball(6, 2)]
    found = theory.minimal_count(PAPER, ExponentialKernel(), CIRCLE, 0.1, 1e-2, own)
    assert found.counts.tolist() == [3, 6, 10]
    assert found.count == 6


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
        ({"epsilon": 0.0}, r"minimal_count\(epsilon=\.\.\.\)` must be positive; got 0.0"),
        ({"radius": -0.1}, r"radius=\.\.\.\)` must be positive; got -0.1"),
        ({"epsilon": 1e-18}, r"in the reach of a layout.*got 1e-18"),
        ({"layouts": []}, "at least one layout"),
        ({"layouts": [ball(4, 3)]}, r"minimal_count\(layouts=\.\.\.\)` must have 2 entries"),
        ({"states": CIRCLE.long()}, "floating-point"),
        ({"target": lambda y: y}, r"must map points of shape \(\.\.\., n\)"),
        ({"kernel": "exponential"}, "must be a Kernel"),
    ],
)
def test_bad_arguments_of_the_smallest_count_are_named(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        theory.minimal_count(**(FINE | wrong))  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [{"radius": 0}, {"dim": 0}, {"count": 1}, {"center": [0.0]}])
def test_bad_arguments_of_the_domain_are_named(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"disc\("):
        theory.disc(**wrong)  # type: ignore[arg-type]
