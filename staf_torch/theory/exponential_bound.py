"""How many exponential kernels are enough: the theorem of the paper's section 4, computed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .._checks import fail, integer, positive_real, sampled, trailing
from .construction import Construction
from .polynomials import monomials, near_best
from .sampling import ball_grid

_BETWEEN = 1.01  # for what lies between the points of a supremum: measured to be under 0.2 %
_MOST_TERMS = 3000  # monomials of a polynomial; more would take gigabytes
_LARGEST_M = 2**50


@dataclasses.dataclass(frozen=True)
class ExponentialBound:
    """What `exponential_bound` returns."""

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


class _Functions(NamedTuple):
    """Functions on the balls, one a state, to approximate in a weighted uniform norm."""

    what: str
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]]  # offsets (P, n) -> values, weights (D, P)
    tolerance: Tensor  # (D,) weighted errors to stay within


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

    Args:
        target: V, points (..., n) to values (...).
        domain: states that cover D, (D, n); see `disc`. What is found holds at these states.
        radius: r of the balls, in the units of the state.
        epsilon: the largest error allowed, in the units of V.
        max_degree: of each polynomial.

    Returns:
        Degrees, counts, and both constructions with an m that is large enough for the centers
        (m > degree / r) and for the O(1/m). Their `error` is the largest over a grid of the balls that
        resolves the degree, and 1 % more for what lies between its points; it is at most ``epsilon``.

    Raises:
        ValueError: if an argument breaks its rule, the target returns another shape or a number that is
            not finite, or no polynomial of degree ``max_degree`` (3000 terms at most) is good enough.

    Source: Rosenfeld et al., section 4; MATH.md section 3 has its misprints.
    """
    call = "exponential_bound"
    trailing(call, "domain", domain, dims=2)
    if domain.dim() != 2 or 0 in domain.shape:
        raise fail(call, "domain", "must have the shape (D, n)", tuple(domain.shape))
    if not bool(torch.isfinite(domain).all()):
        raise fail(call, "domain", "must be finite", domain)
    problem = _Problem(
        target,
        domain,
        positive_real(call, "radius", radius),
        positive_real(call, "epsilon", epsilon),
        integer(call, "max_degree", max_degree, least=0),
    )
    with torch.no_grad():
        return problem.solve()


class _Problem(NamedTuple):
    target: Callable[[Tensor], Tensor]
    states: Tensor  # (D, n)
    radius: float
    epsilon: float
    max_degree: int

    def solve(self) -> ExponentialBound:
        N, p = self.smallest_degree(self.value())
        S, q = self.smallest_degree(self.exponential())
        b, g = self.smallest_degree(self.product())
        two, one = self.construct((p, q), (N, S)), self.construct((g,), (b,))
        return ExponentialBound(N, S, two, one)

    def offsets(self, degree: int, fineness: int) -> Tensor:
        """Points of the ball of the radius that resolve polynomials of a degree: (P, n)."""
        dim = self.states.shape[-1]
        shells = degree // 2 + 2 + 2 * fineness
        terms = math.comb(dim + degree, degree)
        directions = 12 * (degree + 1) if dim <= 2 else -(-6 * terms // shells)
        return self.radius * ball_grid(dim, shells, fineness * directions).to(self.states)

    def values(self, z: Tensor) -> Tensor:
        """V(x + z): (P, n) -> (D, P)."""
        points = self.states.unsqueeze(-2) + z
        values = sampled(self.target, self.target(points), points)
        if not bool(torch.isfinite(values).all()):
            raise ValueError("`exponential_bound(target=...)` must be finite on the balls of the domain.")
        return values

    def norms(self) -> tuple[float, Tensor]:
        """|V| and log e^{x'y}, both largest over y in N_r(x), the latter for each state: (), (D,)."""
        # Where V is smaller than epsilon, the larger number keeps V = 0 from dividing anything.
        size = max(float(self.values(self.offsets(4, 2)).abs().max()), self.epsilon)
        norm = self.states.norm(dim=-1)
        return size, norm * (norm + self.radius)

    def split(self) -> float:
        """eps' with eps' + eps'^2 / (4 A |V|) = epsilon."""
        size, growth = self.norms()
        k = math.exp(-float(growth.max())) / (4 * size)
        return 2 * self.epsilon / (1 + math.sqrt(1 + 4 * k * self.epsilon))

    def value(self) -> _Functions:
        """V, to eps' / (2 A)."""
        _, growth = self.norms()
        tolerance = 0.5 * self.split() * (-growth.max()).exp()

        def evaluate(z: Tensor) -> tuple[Tensor, Tensor]:
            values = self.values(z)
            return values, torch.ones_like(values)

        return _Functions("V", evaluate, tolerance.expand(len(self.states)))

    def exponential(self) -> _Functions:
        """e^{-x'y} = e^{-x'x} e^{-x'z}, to eps' / (2 A |V|): divided by e^{-x'x}, which can underflow."""
        size, growth = self.norms()
        tolerance = 0.5 * self.split() / size * (self.states.square().sum(-1) - growth.max()).exp()

        def evaluate(z: Tensor) -> tuple[Tensor, Tensor]:
            values = (-self.states @ z.mT).exp()
            return values, torch.ones_like(values)

        return _Functions("e^{-x'y}", evaluate, tolerance)

    def product(self) -> _Functions:
        """V(y) e^{-x'z} in the norm weighted by e^{x'z}, to epsilon."""

        def evaluate(z: Tensor) -> tuple[Tensor, Tensor]:
            growth = (self.states @ z.mT).exp()
            return self.values(z) / growth, growth

        return _Functions("V(y) e^{-x'y}", evaluate, self.states.new_full((len(self.states),), self.epsilon))

    def smallest_degree(self, functions: _Functions) -> tuple[int, Tensor]:
        """The smallest degree that meets the tolerance at all states, and the coefficients (D, C)."""
        dim, degree, shortfall = self.states.shape[-1], 0, math.inf
        while degree <= self.max_degree and math.comb(dim + degree, degree) <= _MOST_TERMS:
            z = self.offsets(degree, 1)
            fit = near_best(z / self.radius, degree, *functions.evaluate(z), functions.tolerance)
            shortfall = float((fit.lower / functions.tolerance).max())
            if bool((fit.error <= functions.tolerance).all()):
                fine = self.offsets(degree, 4)
                values, weight = functions.evaluate(fine)
                left = values - fit.coefficients @ monomials(fine / self.radius, degree).mT
                error = _BETWEEN * (weight * left.abs()).amax(-1)
                shortfall = float((error / functions.tolerance).max())
                if shortfall <= 1:
                    return degree, fit.coefficients
            degree += 1
        raise ValueError(
            f"`exponential_bound(epsilon=...)` must be in the reach of polynomials of degree {degree - 1} "
            f"({math.comb(dim + degree - 1, dim)} terms), but theirs leave {functions.what} an error "
            f"of {shortfall:.3g} times what is allowed ({float(functions.tolerance.min()):.3g}) on a ball: "
            f"a larger epsilon or max_degree, or a smaller radius or domain, may do; got {self.epsilon!r}."
        )

    def construct(self, factors: tuple[Tensor, ...], degrees: tuple[int, ...]) -> Construction:
        """With the smallest m among doubled ones that leaves the error within epsilon."""
        degree = sum(degrees)
        fine = self.offsets(degree, 4)
        values = self.values(fine)
        m = math.floor(degree / self.radius) + 1
        while True:
            built = Construction(self.states, self.radius, m, factors, degrees, error=math.nan)
            error = _BETWEEN * float((values - built(fine)).abs().max())
            if error <= self.epsilon:
                return dataclasses.replace(built, error=error)
            if m > _LARGEST_M:
                raise ValueError(
                    f"`exponential_bound(epsilon=...)` is met by the polynomials of degree {degree}, but not "
                    f"by exponentials in their place ({error:.3g} with centers 1/{m} apart); "
                    f"got {self.epsilon!r}."
                )
            m *= 2
