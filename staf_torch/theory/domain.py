"""The polynomials of the proof of `exponential_bound`, and the exponentials in their place."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .._checks import sampled
from .construction import Construction
from .polynomials import monomials, near_best
from .sampling import ball_grid, supremum

_BETWEEN = 1.01  # for what the search for a supremum may have missed
_MOST_TERMS = 3000  # monomials of a polynomial; more would take gigabytes
_LARGEST_M = 2**50
_FINENESS = 3  # of the grid of a supremum, against the one of the fit


class Functions(NamedTuple):
    """Functions on the balls, one a state, to approximate in a weighted uniform norm."""

    what: str
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor]]  # offsets (P, n) or (D, P, n) -> both (D, P)
    tolerance: Tensor  # (D,) weighted errors to stay within


class DomainProblem(NamedTuple):
    """What the proof approximates, on the balls around the states of a domain."""

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

    def value(self) -> Functions:
        """V, to eps' / (2 A)."""
        _, growth = self.norms()
        tolerance = 0.5 * self.split() * (-growth.max()).exp()

        def evaluate(z: Tensor) -> tuple[Tensor, Tensor]:
            values = self.values(z)
            return values, torch.ones_like(values)

        return Functions("V", evaluate, tolerance.expand(len(self.states)))

    def exponential(self) -> Functions:
        """e^{-x'y} = e^{-x'x} e^{-x'z}, to eps' / (2 A |V|): divided by e^{-x'x}, which can underflow."""
        size, growth = self.norms()
        tolerance = 0.5 * self.split() / size * (self.states.square().sum(-1) - growth.max()).exp()

        def evaluate(z: Tensor) -> tuple[Tensor, Tensor]:
            values = (-self.exponent(z)).exp()
            return values, torch.ones_like(values)

        return Functions("e^{-x'y}", evaluate, tolerance)

    def product(self) -> Functions:
        """V(y) e^{-x'z} in the norm weighted by e^{x'z}, to epsilon."""

        def evaluate(z: Tensor) -> tuple[Tensor, Tensor]:
            growth = self.exponent(z).exp()
            return self.values(z) / growth, growth

        return Functions("V(y) e^{-x'y}", evaluate, self.states.new_full((len(self.states),), self.epsilon))

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
