"""A sufficient number of exponential kernels: the theorem of the paper's section 4, its proof computed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..centers.layouts import monomials
from ..lanes.per_row.objects import refuse_rows
from ..numerics.checks import fail, integer, positive_real, sampled, trailing
from ..signs import Sign
from .uniform_approximation import ball_grid, near_best, supremum

_BETWEEN = 1.01  # for what the search for a supremum may have missed
_MOST_TERMS = 3000  # monomials of a polynomial; more would take gigabytes
_LARGEST_M = 2**50
_FINENESS = 3  # of the grid of a supremum, against the one of the fit


@dataclasses.dataclass(frozen=True)
class Construction:
    """F_m(x + z) = e^{x'z} prod_k g_k(tau(z)), tau_i(z) = m (e^{z_i/m} - 1), at every state x of a domain.

    tau(z) -> z as m grows, and prod_i tau_i^{a_i} is a combination of the exponentials e^{z'l/m} with whole
    numbers 0 <= l_i <= a_i: so F_m is a combination of `count` exponential kernels with the centers
    x + l/m, |l|/m <= degree/m < radius. It is evaluated in this product form only. The binomial sum over
    the centers, as printed, needs weights of the size m^degree and loses every digit.

    Source: Rosenfeld et al., section 4, proof of the theorem on the exponential kernel.
    """

    states: Tensor  # x, (D, n) float64
    radius: float  # of the balls
    m: int  # the centers stand 1/m apart
    factors: tuple[Tensor, ...]  # of each g_k the coefficients of (z / radius)^a, (D, C_k), graded
    degrees: tuple[int, ...]  # of the g_k
    error: float  # sup |V - F_m| over the balls: see `exponential_bound`

    @property
    def degree(self) -> int:
        """Degree of the product of the g_k."""
        return sum(self.degrees)

    @property
    def count(self) -> int:
        """C(n + degree, n): exponential kernels that the construction takes at a state."""
        return math.comb(self.states.shape[-1] + self.degree, self.degree)

    def __call__(self, z: Tensor) -> Tensor:
        """F_m(x + z) at the offsets z (P, n), the same at each state, or (D, P, n): -> (D, P) float64.

        Raises:
            ValueError: if ``z`` has another shape.
        """
        trailing("Construction", "z", z, dims=2, last=self.states.shape[-1])
        if z.dim() > 3 or (z.dim() == 3 and z.shape[0] != self.states.shape[0]):
            rule = f"must have the shape (P, n) or (D, P, n) with D = {self.states.shape[0]} states"
            raise fail("Construction", "z", rule, tuple(z.shape))
        z = z.to(self.states)
        tau = self.m * torch.expm1(z / self.m) / self.radius
        result = (z @ self.states.unsqueeze(-1)).squeeze(-1).exp()
        for coefficients, degree in zip(self.factors, self.degrees, strict=True):
            result = result * (monomials(tau, degree) @ coefficients.unsqueeze(-1)).squeeze(-1)
        return result


class Functions(NamedTuple):
    """Functions on the balls, one a state, to approximate in a weighted uniform norm."""

    what: str
    values: Callable[[Tensor], Tensor]  # offsets (P, n) or (D, P, n) -> (D, P)
    tolerance: Tensor  # (D,) weighted errors to stay within
    weight: Callable[[Tensor], Tensor] | None = None  # likewise; None for ones

    def evaluate(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Values and weights, (D, P)."""
        values = self.values(z)
        return values, torch.ones_like(values) if self.weight is None else self.weight(z)


class DomainProblem(NamedTuple):
    """The function that the proof approximates, on the balls around the states of a domain."""

    call: str
    target: Callable[[Tensor], Tensor]
    dtype: torch.dtype  # of the target's arguments; everything else is in float64
    states: Tensor  # (D, n)
    radius: float
    epsilon: float
    max_degree: int

    def one_polynomial(self) -> Construction:
        """By one polynomial for V(y) e^{-x'y}."""
        degree, g = self.smallest_degree(self.product())
        return self.construct((g,), (degree,))

    def offsets(self, degree: int, fineness: int) -> Tensor:
        """Points of the ball of the radius that resolve polynomials of a degree: (P, n)."""
        dim = self.states.shape[-1]
        shells = degree + 2 + 2 * fineness
        terms = math.comb(dim + degree, degree)
        directions = 12 * (degree + 1) if dim <= 2 else -(-6 * terms // shells)
        return self.radius * ball_grid(dim, shells, fineness * directions).to(self.states)

    def values(self, z: Tensor) -> Tensor:
        """V(x + z): (P, n) or (D, P, n) -> (D, P)."""
        points = (self.states.unsqueeze(-2) + z).to(self.dtype)
        values = sampled(self.target, self.target(points), points).double()
        if not bool(torch.isfinite(values).all()):
            raise ValueError(f"`{self.call}(target=...)` must be finite on the balls of the domain.")
        return values

    def exponent(self, z: Tensor) -> Tensor:
        """x'z: (P, n) or (D, P, n) -> (D, P)."""
        return (z @ self.states.unsqueeze(-1)).squeeze(-1)

    def factors(self) -> tuple[Functions, Functions]:
        """V, to eps' / (2 A), and e^{-x'y}, to eps' / (2 A |V|), with eps' + eps'^2 / (4 A |V|) = epsilon.

        The latter is e^{-x'x} e^{-x'z}: both sides are divided by e^{-x'x}, which can underflow.
        """
        # Where V is smaller than epsilon, the larger number keeps V = 0 from dividing anything.
        size = max(float(self.values(self.offsets(4, 2)).abs().max()), self.epsilon)  # |V|
        norm = self.states.norm(dim=-1)
        growth = (norm * (norm + self.radius)).max()  # log A
        k = math.exp(-float(growth)) / (4 * size)
        half = 0.5 * (2 * self.epsilon / (1 + math.sqrt(1 + 4 * k * self.epsilon)))  # eps' / 2
        unweighted = Functions("V", self.values, (half * (-growth).exp()).expand(len(self.states)))
        share = half / size * (self.states.square().sum(-1) - growth).exp()
        return unweighted, Functions("e^{-x'y}", lambda z: (-self.exponent(z)).exp(), share)

    def product(self) -> Functions:
        """V(y) e^{-x'z} in the norm weighted by e^{x'z}, to epsilon."""
        tolerance = self.states.new_full((len(self.states),), self.epsilon)

        def weight(z: Tensor) -> Tensor:
            return self.exponent(z).exp()

        return Functions("V(y) e^{-x'y}", lambda z: self.values(z) / weight(z), tolerance, weight)

    def smallest_degree(self, functions: Functions) -> tuple[int, Tensor]:
        """The smallest degree that meets the tolerance at all states, and the coefficients (D, C)."""
        dim, degree, shortfall = self.states.shape[-1], 0, math.inf
        while degree <= self.max_degree and math.comb(dim + degree, degree) <= _MOST_TERMS:
            z = self.offsets(degree, 1)
            fit = near_best(z / self.radius, degree, *functions.evaluate(z), functions.tolerance)
            shortfall = float((fit.lower / functions.tolerance).max())
            if bool((fit.error <= functions.tolerance).all()):
                error = _BETWEEN * self.largest(functions, degree, fit.coefficients)
                shortfall = float((error / functions.tolerance).max())
                if shortfall <= 1:
                    return degree, fit.coefficients
            degree += 1
        raise ValueError(
            f"`{self.call}(epsilon=...)` must be in the reach of polynomials of degree {degree - 1} "
            f"({math.comb(dim + degree - 1, dim)} terms), but theirs leave {functions.what} an error "
            f"of {shortfall:.3g} times what is allowed ({float(functions.tolerance.min()):.3g}) on a ball: "
            f"a larger epsilon or max_degree, or a smaller radius or domain, may do; got {self.epsilon!r}."
        )

    def largest(self, functions: Functions, degree: int, coefficients: Tensor) -> Tensor:
        """The largest weighted error of polynomials on the balls, (D,)."""

        def error(z: Tensor) -> Tensor:
            values, weight = functions.evaluate(z)
            powers = monomials(z / self.radius, degree)
            return weight * (values - (powers @ coefficients.unsqueeze(-1)).squeeze(-1)).abs()

        return supremum(error, self.offsets(degree, _FINENESS), self.radius)

    def error_of(self, built: Construction, grid: Tensor) -> float:
        """sup |V - F_m| over the balls."""
        worst = supremum(lambda z: (self.values(z) - built(z)).abs(), grid, self.radius)
        return _BETWEEN * float(worst.max())

    def construct(self, factors: tuple[Tensor, ...], degrees: tuple[int, ...]) -> Construction:
        """With the smallest m among doubled ones that leaves the error within epsilon."""
        degree = sum(degrees)
        grid = self.offsets(degree, _FINENESS)
        m = math.floor(degree / self.radius) + 1
        while True:
            built = Construction(self.states, self.radius, m, factors, degrees, error=math.nan)
            error = self.error_of(built, grid)
            if error <= self.epsilon:
                return dataclasses.replace(built, error=error)
            if m > _LARGEST_M:
                raise ValueError(
                    f"`{self.call}(epsilon=...)` is met by the polynomials of degree {degree}, but not "
                    f"by exponentials in their place ({error:.3g} with centers 1/{m} apart); "
                    f"got {self.epsilon!r}."
                )
            m *= 2


@dataclasses.dataclass(frozen=True)
class ExponentialBound:
    """Result of `exponential_bound`."""

    N: int  # degree of the polynomials that approximate V
    S: int  # degree of the polynomials that approximate e^{-x'y}
    two_polynomials: Construction  # the paper's, of degree N + S
    one_polynomial: Construction  # one polynomial for V(y) e^{-x'y}, of a smaller degree

    @property
    def count(self) -> int:
        """The paper's bound, C(n + N + S, N + S)."""
        return self.two_polynomials.count

    @property
    def one_polynomial_count(self) -> int:
        """C(n + b, n) with the degree b of the one polynomial."""
        return self.one_polynomial.count


@Sign("exponential_bound")
def exponential_bound(
    target: Callable[[Tensor], Tensor],
    domain: Tensor,
    radius: float,
    epsilon: float,
    *,
    max_degree: int = 16,
) -> ExponentialBound:
    """Exponential kernels that approximate V to ``epsilon`` on the ball of every state of a domain.

    With p ~ V and q ~ e^{-x'y} on the ball N_r(x), of degrees N and S, the function e^{x'y} q p is V up to
    the errors of both, and up to O(1/m) a combination of C(n+N+S, N+S) kernels e^{c'y}, |c - x| < r. N and
    S are the smallest degrees that do for all x of the domain D in the way of the proof:

        sup |p - V| <= eps' / (2 A),  sup |q - e^{-x'y}| <= eps' / (2 A |V|),
        eps' + eps'^2 / (4 A |V|) = epsilon,

    with A = sup e^{y'x} and |V| = sup |V(y)|, both over x in D and y in N_r(x). (The paper takes the norms
    over D itself, but y leaves D.) The best uniform approximations are found by Lawson's iteration.

    The proof is wasteful: its factor 1/A in the first inequality is not needed, as e^{x'y} q ~ 1, and one
    polynomial of degree b for V(y) e^{-x'y}, with e^{x'y} |error| <= epsilon, gives C(n+b, n) kernels.

    Example:
        >>> bound = exponential_bound(targets.Paper(), disc(1.0), radius=0.1, epsilon=1e-3)
        >>> bound.N, bound.S, bound.count, bound.one_polynomial_count
        (3, 2, 21, 10)

        Shown by `staf experiment=exponential_bound`.

    Args:
        target: V, points (..., n) to values (...).
        domain: states that cover D, (D, n); see `disc`. What is found holds at these states. The target
            is called in their dtype; the rest is computed in float64.
        radius: r of the balls, in the units of the state.
        epsilon: the largest error allowed, in the units of V.
        max_degree: of each polynomial.

    Returns:
        Degrees, counts, and both constructions with an m that is large enough for the centers
        (m > degree / r) and for the O(1/m). Their `error` is the largest that a search over the balls
        found, and 1 % more for what it may have missed (measured: under 0.002 %); it is at most ``epsilon``.

    Raises:
        ValueError: if an argument breaks its rule, the target returns another shape or a number that is
            not finite, or no polynomial of degree ``max_degree`` (3000 terms at most) is good enough.

    Source: Rosenfeld et al., section 4; MATH.md section 3 has its misprints.
    """
    refuse_rows("exponential_bound", target=target)
    problem = _problem("exponential_bound", target, domain, radius, epsilon, max_degree)
    with torch.no_grad():
        value, exponential = problem.factors()
        N, p = problem.smallest_degree(value)
        S, q = problem.smallest_degree(exponential)
        return ExponentialBound(N, S, problem.construct((p, q), (N, S)), problem.one_polynomial())


@Sign("one_polynomial_bound")
def one_polynomial_bound(
    target: Callable[[Tensor], Tensor],
    domain: Tensor,
    radius: float,
    epsilon: float,
    *,
    max_degree: int = 16,
) -> Construction:
    """The one-polynomial half of `exponential_bound` alone: the construction of degree b, its count and m.

    It needs no factor 1/A, and so it also holds on domains far from the origin, where A = e^{|x|^2 + r|x|}
    puts the other half out of reach.

    Example:
        >>> one_polynomial_bound(targets.Paper(), disc(1.0), radius=0.1, epsilon=1e-3).count
        10

        Shown by `staf experiment=exponential_bound`.

    Arguments and errors are those of `exponential_bound`.
    """
    refuse_rows("one_polynomial_bound", target=target)
    problem = _problem("one_polynomial_bound", target, domain, radius, epsilon, max_degree)
    with torch.no_grad():
        return problem.one_polynomial()


def _problem(
    call: str,
    target: Callable[[Tensor], Tensor],
    domain: Tensor,
    radius: float,
    epsilon: float,
    max_degree: int,
) -> DomainProblem:
    trailing(call, "domain", domain, dims=2)
    if domain.dim() != 2 or 0 in domain.shape:
        raise fail(call, "domain", "must have the shape (D, n)", tuple(domain.shape))
    if not bool(torch.isfinite(domain).all()):
        raise fail(call, "domain", "must be finite", domain)
    return DomainProblem(
        call,
        target,
        domain.dtype,
        domain.double(),
        positive_real(call, "radius", radius),
        positive_real(call, "epsilon", epsilon),
        integer(call, "max_degree", max_degree, least=0),
    )
