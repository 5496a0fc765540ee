"""How many exponential kernels are enough: the theorem of the paper's section 4, computed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from .._checks import fail, integer, positive_real, trailing
from .construction import Construction
from .domain import DomainProblem


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
    problem = _problem("exponential_bound", target, domain, radius, epsilon, max_degree)
    with torch.no_grad():
        N, p = problem.smallest_degree(problem.value())
        S, q = problem.smallest_degree(problem.exponential())
        return ExponentialBound(N, S, problem.construct((p, q), (N, S)), problem.one_polynomial())


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

    Args:
        target: V, points (..., n) to values (...).
        domain: states that cover D, (D, n).
        radius: r of the balls, in the units of the state.
        epsilon: the largest error allowed, in the units of V.
        max_degree: of the polynomial.

    Raises:
        ValueError: as `exponential_bound`.
    """
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
