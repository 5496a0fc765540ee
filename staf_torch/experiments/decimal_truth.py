"""Interpolants in high precision with nothing but the standard library: the truth of `flat_limit`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal, localcontext

from torch import Tensor

Point = list[Decimal]


def paper(x: Point) -> Decimal:
    """V(x) = x1^2 + 5 x2^2 + tanh(x1 x2), as `targets.Paper`."""
    square = (2 * x[0] * x[1]).exp()
    return x[0] * x[0] + 5 * x[1] * x[1] + (square - 1) / (square + 1)


def interpolant(
    directions: Tensor, radius: float, x: Tensor, zeta: Tensor, width: float | None
) -> list[Decimal]:
    """V^(x + r zeta) of the ideal weights for V of `paper`, by elimination on the textbook Gram matrix.

    Every float argument is taken as the exact number that it is. The condition number grows like
    r^(-2 degree), and the digits with it.

    Args:
        directions: u, (M, 2).
        radius: r.
        x: the state, (2,).
        zeta: points of the unit ball, (P, 2).
        width: of the Gaussian kernel, or None for the exponential one.

    Returns:
        P numbers, to 30 digits or more.
    """
    count = len(directions)
    with localcontext() as context:
        context.prec = _digits(count, radius)
        r, at = Decimal(radius), _exact(x)
        offsets = [[r * e for e in _exact(u)] for u in directions]
        points = [[r * e for e in _exact(z)] for z in zeta]
        gram = [[_core(d, e, width) for e in offsets] for d in offsets]
        samples = [paper(_sum(at, d)) * _scale(at, d, width, -1) for d in offsets]
        b = _solve(gram, samples)
        return [
            _scale(at, z, width, 1)
            * sum((_core(z, d, width) * c for d, c in zip(offsets, b, strict=True)), Decimal(0))
            for z in points
        ]


def relative_error(found: Tensor, truth: Sequence[Decimal]) -> float:
    """max |found - truth| / max |truth|; not finite where a value found is not."""
    if not bool(found.isfinite().all()):
        return math.inf
    gaps = [abs(Decimal(float(f)) - t) for f, t in zip(found.flatten(), truth, strict=True)]
    return float(max(gaps) / max(abs(t) for t in truth))


def _digits(count: int, radius: float) -> int:
    """Forty digits beyond log10 of the condition number, whose degree M points of the plane cannot exceed
    by more than the layouts here do: (k + 1)(k + 2) / 2 >= M, and one degree to spare."""
    degree = math.ceil((math.sqrt(8 * count + 1) - 3) / 2) + 1
    return 50 + math.ceil(2 * degree * max(0.0, -math.log10(radius)))


def _core(z: Point, d: Point, width: float | None) -> Decimal:
    """k0(z, d) = exp(q z'd), q = 1 or 1 / width^2."""
    rate = Decimal(1) if width is None else 1 / Decimal(width) ** 2
    return (rate * _dot(z, d)).exp()


def _scale(x: Point, z: Point, width: float | None, sign: int) -> Decimal:
    """e^{sign s(x, z)}, s = x'z or -|z|^2 / (2 width^2)."""
    s = _dot(x, z) if width is None else -_dot(z, z) / (2 * Decimal(width) ** 2)
    return (sign * s).exp()


def _solve(matrix: list[Point], right: Point) -> Point:
    """Gaussian elimination of a positive definite matrix, which needs no pivoting."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    size = len(rows)
    for k in range(size):
        for row in rows[k + 1 :]:
            factor = row[k] / rows[k][k]
            for j in range(k + 1, size + 1):
                row[j] -= factor * rows[k][j]
    solved = [Decimal(0)] * size
    for k in reversed(range(size)):
        known = sum((rows[k][j] * solved[j] for j in range(k + 1, size)), Decimal(0))
        solved[k] = (rows[k][size] - known) / rows[k][k]
    return solved


def _exact(values: Tensor) -> Point:
    return [Decimal(float(v)) for v in values]


def _sum(a: Point, b: Point) -> Point:
    return [p + q for p, q in zip(a, b, strict=True)]


def _dot(a: Point, b: Point) -> Decimal:
    return sum((p * q for p, q in zip(a, b, strict=True)), Decimal(0))
