"""The misprints that staf_torch/theory/README.md lists: what is printed fails, what is computed holds."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from torch import Tensor

from staf_torch import (
    ExponentialKernel,
    MaternKernel,
    StaFBasis,
    StateFollowingCenters,
    adp,
    rings,
    systems,
    targets,
    theory,
)

KERNEL = ExponentialKernel()
POINT = torch.tensor([0.6, -0.4], dtype=torch.float64)


def section(y: Tensor) -> Tensor:
    """K(., p): in the native space, with the norm sqrt(K(p, p))."""
    return (y @ POINT).exp()


def native_error(weights: Tensor, centers: Tensor) -> Tensor:
    """||K(., p) - sum_i a_i K(., c_i)||^2, by the reproducing property alone."""
    points = torch.cat((POINT[None], centers))
    signed = torch.cat((-torch.ones(1, dtype=torch.float64), weights))
    return signed @ KERNEL(points, points) @ signed


def basis(count: int = 3, radius: float = 0.1) -> StaFBasis:
    return StaFBasis(KERNEL, StateFollowingCenters(rings(count), radius=radius))


# --- section 3: the ideal weights and the native norm -------------------------------------------------------


def test_least_native_error_has_the_inverse_gram_matrix() -> None:
    """F(W, c) = ||V||^2 - V(c)' K^-1 V(c); printed: V(c)' K V(c)."""
    x = torch.tensor([1.0, 0.0], dtype=torch.float64)
    gram, values = basis().gram(x), section(basis().centers(x))
    least = native_error(basis().ideal_weights(x, section), basis().centers(x))
    norm = section(POINT)
    torch.testing.assert_close(least, norm - values @ torch.linalg.solve(gram, values), rtol=0, atol=1e-9)
    printed = norm - values @ gram @ values
    assert printed < -1  # a squared norm would be negative


def test_error_of_the_feasibility_proof_starts_from_the_squared_norm() -> None:
    """E^2 = ||V||^2 - 2 sum w_i V(c_i) + w'Kw vanishes for the kernel itself; printed with ||V||."""
    left = -2 * section(POINT) + KERNEL(POINT[None], POINT[None]).squeeze()  # one center at p, weight 1
    assert float(section(POINT) + left) == pytest.approx(0.0, abs=1e-15)
    assert float(section(POINT).sqrt() + left) < -0.3  # no square of anything


def test_native_norm_bounds_the_values_by_the_root_of_the_kernel_and_no_less() -> None:
    """|f(y)| <= sqrt(K(y, y)) ||f||; printed: the native norm dominates the supremum norm."""
    far = torch.tensor([[2.0, 1.0]], dtype=torch.float64)
    diagonal = KERNEL(far, far)
    unit = KERNEL(far, far) / diagonal.sqrt()  # K(., y) / ||K(., y)|| at y itself
    torch.testing.assert_close(unit, diagonal.sqrt())
    assert float(unit) == pytest.approx(math.exp(2.5))  # and not at most 1


def test_target_of_the_paper_is_not_in_the_native_space() -> None:
    """||sum_a b_a x^a||^2 = sum_a a! b_a^2; of tanh(x1 x2) this is the sum of the squared tangent numbers.

    So F is infinite, and only the excess F(a, c) - F(w, c) means something.
    """
    numbers, polynomial = [], [0, 1]  # the derivatives of T = tanh(t) are polynomials in T; T' = 1 - T^2
    for order in range(1, 20):
        slope = [k * c for k, c in enumerate(polynomial)][1:]
        polynomial = [a - b for a, b in zip([*slope, 0, 0], [0, 0, *slope], strict=True)]
        if order % 2:
            numbers.append(abs(polynomial[0]))  # at t = 0: j! times the coefficient of t^j
    assert numbers[:6] == [1, 2, 16, 272, 7936, 353792]
    assert all(later >= 2 * earlier for earlier, later in itertools.pairwise(numbers))
    x = torch.tensor([[0.3, 0.2]], dtype=torch.float64)
    rest = targets.Paper()(x) - x[:, 0] ** 2 - 5 * x[:, 1] ** 2
    series = sum(
        (-1) ** k * number / math.factorial(2 * k + 1) * x.prod(-1) ** (2 * k + 1)
        for k, number in enumerate(numbers)
    )
    torch.testing.assert_close(rest, series)


def test_smooth_kernel_sections_do_not_make_the_ideal_weights_as_smooth() -> None:
    """The Matern kernel 3/2 is C^2 in y, and w(c) only C^1 in c: the theorem needs K in C^{m,m}."""
    kernel = MaternKernel(1.5)
    staf = StaFBasis(kernel, StateFollowingCenters(torch.zeros(1, 1, dtype=torch.float64), radius=0.1))

    def kink(y: Tensor) -> Tensor:  # in the native space H^2 of this kernel: its second derivative jumps
        return (y * y.abs() * torch.exp(-y.square())).squeeze(-1)

    h = 1e-4

    def second(function: object, at: float) -> float:
        x = torch.tensor([[at - h], [at], [at + h]], dtype=torch.float64)
        f = function(x).flatten()  # type: ignore[operator]
        return float((f[0] - 2 * f[1] + f[2]) / h**2)

    def ideal(x: Tensor) -> Tensor:
        return staf.ideal_weights(x, kink)

    def of_kernel(x: Tensor) -> Tensor:
        return kernel(x, torch.zeros(1, 1, dtype=torch.float64))

    assert second(of_kernel, 2 * h) == pytest.approx(second(of_kernel, -2 * h), abs=1e-2)
    assert second(ideal, 2 * h) == pytest.approx(2.0, abs=1e-2)
    assert second(ideal, -2 * h) == pytest.approx(-2.0, abs=1e-2)
    norms = []  # V(c)'K^-1 V(c) on finer grids: bounded, and so V is in the space
    for count in (21, 41, 81, 161):
        grid = torch.linspace(-4, 4, count, dtype=torch.float64).unsqueeze(-1)
        norms.append(float(kink(grid) @ torch.linalg.solve(kernel(grid, grid), kink(grid))))
    growth = [b - a for a, b in itertools.pairwise(norms)]
    assert all(later < 0.6 * earlier for earlier, later in itertools.pairwise(growth))


# --- section 4: the bound for the exponential kernel --------------------------------------------------------


def test_number_of_kernels_can_be_the_binomial_coefficient() -> None:
    """M <= C(n + N + S, N + S); printed: <. For V(y) = y at the origin N + S = 1: two kernels, never one."""
    y = torch.linspace(-0.5, 0.5, 201, dtype=torch.float64)
    one = torch.stack([w * torch.exp(y * c) for w in (-0.4, 0.0, 0.4) for c in (-0.5, 0.0, 0.5)])
    assert (y - one).abs().amax(-1).min() >= 0.5 - 1e-12  # w > 0 fails at -r, w < 0 at r, by r and more
    bound = theory.exponential_bound(
        lambda v: v[..., 0], torch.zeros(1, 1, dtype=torch.float64), radius=0.5, epsilon=1e-3
    )
    assert (bound.N, bound.S, bound.count) == (1, 0, 2)


@pytest.mark.parametrize("power", [1, 2, 3])
def test_binomial_sum_has_its_last_term(power: int) -> None:
    """l_i <= alpha_i; with l_i < alpha_i, as printed once, the sum is not near y^alpha."""
    y, m = torch.linspace(-0.5, 0.5, 11, dtype=torch.float64), 1000

    def binomial(last: int) -> Tensor:
        terms = [math.comb(power, j) * (-1) ** (power - j) * torch.exp(y * j / m) for j in range(last + 1)]
        return m**power * torch.stack(terms).sum(0)

    assert (binomial(power) - y**power).abs().max() < 1e-3
    assert (binomial(power - 1) - y**power).abs().max() > 100


def test_centers_reach_the_ball_from_m_above_degree_over_radius_on() -> None:
    """The farthest center stands (N + S) / m from the state: the construction takes m > (N + S) / r."""
    built = theory.exponential_bound(targets.Paper(), theory.disc(1.0, count=9), 0.1, 1e-2).two_polynomials
    assert built.m > built.degree / 0.1
    assert built.degree / math.floor(built.degree / 0.1) >= 0.1


def test_monomials_are_taken_around_the_state() -> None:
    """In y - x the error of m (e^{z/m} - 1) is that of the ball; in y, as printed, that of |x|."""
    z, x, m = torch.linspace(-0.1, 0.1, 41, dtype=torch.float64), 4.0, 100

    def error(of: Tensor) -> float:
        return float((m * torch.expm1(of / m) - of).abs().max())

    assert error(z) < 0.1**2 / (2 * m) * 1.01
    assert error(x + z) > 1000 * error(z)


def test_norms_of_the_proof_are_taken_over_the_balls_and_not_over_the_domain() -> None:
    """The points y of the ball of a state on the boundary lie outside D: so must the suprema be taken."""
    domain, radius = theory.disc(1.0, count=97), 0.5
    y = domain * (1 + radius)
    over_domain = max(float((domain @ domain.mT).exp().max()), float(targets.Paper()(domain).max()))
    assert float((y * domain).sum(-1).exp().max()) > math.exp(0.5) * 0.99 * math.exp(1.0)
    assert float(targets.Paper()(y).max()) > 2 * over_domain


# --- section 6: the gradient chase --------------------------------------------------------------------------


def test_speed_of_all_centers_has_the_root_of_their_number() -> None:
    """|c'| = sqrt(M) (R_0 + R_3) for centers that move alike; printed without sqrt(M)."""
    x = torch.tensor([[1.0, 0.0], [0.0, 1.0], [-0.6, 0.8]], dtype=torch.float64)
    velocity = systems.Oscillator().drift(x)
    step = theory.paper_step(basis(), targets.Paper(), x, velocity, excess=0.35)
    assert step.speed == pytest.approx(math.sqrt(3) * float(velocity.norm(dim=-1).max()))


def test_drift_of_the_excess_needs_the_gradient_in_the_centers() -> None:
    """R_1 bounds |grad_c F(a, c)|; printed: grad_a, which vanishes at the ideal weights."""
    x = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    staf, target = basis(), targets.Paper()
    w = staf.ideal_weights(x, target)
    gram, values = staf.gram(x), target(staf.centers(x))
    in_weights = 2 * (torch.einsum("bij,bj->bi", gram, w) - values)
    step = theory.paper_step(staf, target, x, systems.Oscillator().drift(x), excess=0.35)
    assert in_weights.norm() < 1e-9
    assert step.ideal_gradient > 1
    velocity = 3 * systems.Oscillator().drift(x)
    again = theory.paper_step(staf, lambda y: 2 * target(y), x, velocity, excess=0.7)
    assert again.gradient == pytest.approx(4 * step.gradient)  # F is quadratic in the weights, and so in V
    assert again.dt == pytest.approx(2 * step.dt / (3 * 4))


def test_forward_euler_inflates_the_circle_of_the_simulation() -> None:
    """The integrator is not stated: Euler's adds 5.8 % to |x| in 5 + 2 pi s, the flow nothing."""
    x = torch.tensor([1.0, 0.0], dtype=torch.float64)
    plant, steps = systems.Oscillator(), 1128
    exact = systems.simulate(plant, x[None], dt=0.01, steps=steps)[0, -1]
    for _ in range(steps):
        x = x + 0.01 * plant.drift(x)
    assert float(x.norm()) == pytest.approx(1.058, abs=5e-4)
    assert float(exact.norm()) == pytest.approx(1.0, abs=1e-12)


# --- the appendix: optimal regulation -----------------------------------------------------------------------


def hamiltonian(plant: systems.TwoState, x: Tensor, sign: float) -> Tensor:
    """x'x + u^2 + grad V*'(f + g u) with u = sign/2 g' grad V*: zero where V* and u are optimal."""
    slope = torch.stack((x[:, 0], 2 * x[:, 1]), dim=-1)
    g = plant.effectiveness(x).squeeze(-1)
    u = sign * 0.5 * (g * slope).sum(-1)
    rate = plant.drift(x) + g * u.unsqueeze(-1)
    return x.square().sum(-1) + u.square() + (slope * rate).sum(-1)


def test_optimal_control_has_a_minus_and_the_drift_a_one_minus() -> None:
    """u* = -1/2 g' grad V*, printed +; f2 = -x1/2 - x2/2 (1 - (cos 2x1 + 2)^2), printed without "1 -"."""
    x = torch.cartesian_prod(*[torch.linspace(-2, 2, 21, dtype=torch.float64)] * 2)
    assert hamiltonian(systems.TwoState(), x, -1.0).abs().max() < 1e-12
    assert hamiltonian(systems.TwoState(), x, +1.0).abs().max() > 10
    assert hamiltonian(systems.TwoState(as_printed=True), x, -1.0).abs().max() == pytest.approx(68.0)
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    printed = systems.TwoState(as_printed=True)
    assert printed.optimal_value(x, cost.q, cost.r) is None
    assert torch.linalg.eigvals(printed.linearisation().matrix).real.max() < 0  # nothing to stabilise
