"""Interpolants in high precision, independent of the library: mpmath on the textbook formulas."""

from __future__ import annotations

import math
from collections.abc import Sequence

import mpmath as mp
import torch
from torch import Tensor

import staf_torch as st

Point = Sequence[mp.mpf]


def paper(x: Point) -> mp.mpf:
    return x[0] ** 2 + 5 * x[1] ** 2 + mp.tanh(x[0] * x[1])


def smooth(x: Point) -> mp.mpf:
    return 2 + mp.cos(mp.fsum(x) + mp.mpf(1) / 4)


def smooth_target(x: Tensor) -> Tensor:
    return 2 + (x.sum(-1) + 0.25).cos()


RADII = (1e-8, 3.7e-5, 1e-3, 0.1, 0.5)
LAYOUTS = {f"rings{count}": (lambda count=count: st.rings(count)) for count in (3, 6, 10, 15, 21, 28)} | {
    "polygon4": lambda: st.polygon(4),
    "simplex5": lambda: st.simplex(5),
    "cross_polytope3": lambda: st.cross_polytope(3),
    "ball10_2": lambda: st.ball(10, 2),
    "ball15_4": lambda: st.ball(15, 4),
    "ball45_8": lambda: st.ball(45, 8),
    "ball6_1": lambda: st.ball(6, 1),
    "ball8_2": lambda: st.ball(8, 2),
}


class Truth:
    """V^ of ideal weights at one state: values and gradients (centers frozen) at x + r zeta."""

    def __init__(
        self,
        directions: Tensor,
        radius: float,
        x: Tensor,
        value: object,
        width: float | None = None,
        polynomial: tuple[int, float] | None = None,
    ) -> None:
        # kappa grows like r^(-2 degree); keep forty digits beyond it.
        degree = 1
        while math.comb(directions.shape[1] + degree, degree) < len(directions):
            degree += 1
        degree = max(degree, len(directions) // 2) if directions.shape[1] <= 2 else degree
        spread = 2 * float(x.norm()) * radius  # the exponential kernel's range over the ball, e^{+-spread}
        self.digits = 50 + int(2 * (degree + 1) * max(0.0, -math.log10(radius)) + 2 * spread)
        self.width, self.polynomial = width, polynomial
        with mp.workdps(self.digits):
            self.radius = mp.mpf(radius)
            self.x = _exact(x)
            self.d = [[self.radius * e for e in _exact(row)] for row in directions]
            gram = mp.matrix([[self.kernel(a, b) for b in self.d] for a in self.d])
            samples = mp.matrix([value(self._at(d)) for d in self.d])  # type: ignore[operator]
            self.b = mp.cholesky_solve(gram, samples)

    def _at(self, z: Point) -> list[mp.mpf]:
        return [a + e for a, e in zip(self.x, z, strict=True)]

    def kernel(self, z: Point, d: Point) -> mp.mpf:
        """k(x + z, x + d) without the constant e^{x'x}."""
        if self.polynomial is not None:
            degree, bias = self.polynomial
            return (mp.mpf(bias) + _dot(self._at(z), self._at(d))) ** degree
        if self.width is None:
            return mp.exp(_dot(self.x, z) + _dot(self.x, d) + _dot(z, d))
        gap = mp.fsum((a - e) ** 2 for a, e in zip(z, d, strict=True))
        return mp.exp(-gap / (2 * mp.mpf(self.width) ** 2))

    def value(self, zeta: Tensor) -> mp.mpf:
        with mp.workdps(self.digits):
            z = [self.radius * e for e in _exact(zeta)]
            return mp.fsum(b * self.kernel(z, d) for b, d in zip(self.b, self.d, strict=True))

    def gradient(self, zeta: Tensor) -> list[mp.mpf]:
        with mp.workdps(self.digits):
            z = [self.radius * e for e in _exact(zeta)]
            rows = [(b * self.kernel(z, d), d) for b, d in zip(self.b, self.d, strict=True)]
            if self.width is None:
                return [mp.fsum(k * (self.x[i] + d[i]) for k, d in rows) for i in range(len(z))]
            square = mp.mpf(self.width) ** 2
            return [mp.fsum(k * (d[i] - z[i]) / square for k, d in rows) for i in range(len(z))]


def worst(found: Tensor, expected: Sequence[mp.mpf]) -> float:
    """max |found - expected| / max |expected|."""
    gap = max(abs(mp.mpf(float(f)) - e) for f, e in zip(found.detach().flatten(), expected, strict=True))
    return float(gap / max(abs(e) for e in expected))


def ball_points(count: int, dim: int, generator: torch.Generator) -> torch.Tensor:
    z = torch.randn(count, dim, dtype=torch.float64, generator=generator)
    z /= z.norm(dim=-1, keepdim=True)
    return z * torch.rand(count, 1, dtype=torch.float64, generator=generator) ** (1 / (dim + 1))


def value_error(staf: st.StaF, truth: Truth, radius: float, zeta: torch.Tensor) -> float:
    found = staf.at_offsets((radius * zeta).to(staf.state))
    return worst(found, [truth.value(z) for z in zeta])


def _exact(values: Tensor) -> list[mp.mpf]:
    return [mp.mpf(float(v)) for v in values]


def _dot(a: Point, b: Point) -> mp.mpf:
    return mp.fsum(p * q for p, q in zip(a, b, strict=True))
