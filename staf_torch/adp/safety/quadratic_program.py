"""The nearest point of a box that satisfies a few linear inequalities, exactly and row by row.

Every row solves a quadratic program of few unknowns and few inequalities at every control. The solution is
found by enumeration: one unknown is an interval, of two the candidates are the feet and corners of all
edges, of more the stationary points of all active sets; the candidate that meets the optimality conditions
best is it. An active-set or interior-point iteration would do less work for one row, but how many passes it
takes differs from row to row, and it stops near the solution; here the operations are the same for all
rows, which a vector lane computes side by side, and a wanted point that is admissible comes back bit for
bit.

Source: the conditions of Karush, Kuhn and Tucker, in Nocedal and Wright, "Numerical Optimization" (2006),
ch. 16.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes import each, repeat
from ...systems import Bounds

MOST_CASES = 1000  # sets of active inequalities and bounds that are compared at most
_ROUNDED, _OWN = 64, 2**20  # roundings by which a point may miss an inequality, and one on whose edge it is


class _Small(NamedTuple):
    """Tolerances: small beside 1, and yet not lost in it."""

    firm: float  # shortfall of a unit normal's inequality a unit of its multiplier, where it holds
    soft: float  # the same, where it cannot hold
    give: float  # of the squares of u - wanted, beside those of what is missing
    met: float  # error of a case, in units of u, below which it is the solution


_DOUBLE, _SINGLE = _Small(1e-14, 1e-10, 1e-9, 1e-9), _Small(1e-6, 1e-4, 1e-5, 1e-4)


class Nearest(NamedTuple):
    """The nearest admissible point."""

    point: Tensor  # u, (..., m)
    shortfall: (
        Tensor  # max_i (c_i - a_i'u) / |a_i|, at least 0, (...): 0 up to 1e-8 where there is a solution
    )


def cases(count: int, low: Sequence[float], high: Sequence[float]) -> Tensor:
    """Return which inequalities (1 or 0) of ``count`` and which of m bounds (-1 low, 1 high, 0 none),
    infinite for none, may hold with equality: (P, k + m) float64, at first the case of none.

    Raises:
        ValueError: if there are more than a thousand cases.
    """
    bounds = [
        (0, *([-1] if below > -torch.inf else []), *([1] if above < torch.inf else []))
        for below, above in zip(low, high, strict=True)
    ]
    active = list(itertools.product((0, 1), repeat=count))
    total = 1 + (len(active) - 1) * len(list(itertools.product(*bounds)))
    if total > MOST_CASES:
        raise ValueError(
            f"{count} inequalities of {len(bounds)} bounded unknowns have {total} cases, more than "
            f"{MOST_CASES}: join some, for example by their smooth minimum."
        )
    held = [(*ones, *sides) for ones in active[1:] for sides in itertools.product(*bounds)]
    return torch.tensor([(0,) * (count + len(bounds)), *held], dtype=torch.float64, device="cpu")


def sides_of(bounds: Bounds) -> tuple[list[float], list[float]]:
    """Return bounds for `cases`, which reads where there are some: 0 in place of the finite ones."""
    low, high = (torch.where(torch.isfinite(end), 0.0, end).tolist() for end in (bounds.low, bounds.high))
    return low, high


def nearest_admissible(
    wanted: Tensor, normals: Tensor, least: Tensor, low: Tensor, high: Tensor, table: Tensor
) -> Nearest:
    """argmin |u - wanted|^2 over low <= u <= high with a_i'u >= c_i, i = 1..k; NaN where an input is NaN.

    Where no u satisfies all, the bounds hold and the squares of (c_i - a_i'u) / |a_i| have the least sum;
    for one unknown, the largest of them is least. One unknown is an interval. For two the solution is on one
    of the edges or where two of them meet: the nearest of these points that satisfies all. For more the
    stationary points of all cases are compared: with multipliers l >= 0 the solution is u = clip(wanted +
    A'l), and the case that satisfies all of these conditions best is it. A ``wanted`` that is admissible is
    returned as it is.

    Args:
        wanted: (..., m), beside it ``low`` and ``high``, (m,), infinite for none.
        normals: a_i, (..., k, m); a zero normal is an inequality that u cannot change.
        least: c_i, (..., k).
        table: of `cases`.
    """
    length = normals.square().sum(-1).sqrt()
    length = torch.where(length == 0, 1.0, length)
    unit, far = normals / length.unsqueeze(-1), least / length
    size = wanted.shape[-1]
    if size == 1:
        point = _interval(wanted, unit, far, low, high)
    elif size == 2:
        point = _in_plane(wanted, unit, far, low, high)
    else:
        point = _best_case(wanted, unit, far, low, high, table)
    fits = ((wanted >= low) & (wanted <= high)).all(-1) & ((unit * wanted.unsqueeze(-2)).sum(-1) >= far).all(
        -1
    )
    point = torch.where(fits.unsqueeze(-1), wanted, point)
    short = (far - (unit * point.unsqueeze(-2)).sum(-1)).amax(-1)
    return Nearest(point, torch.where(short < 0, 0.0, short))


def _interval(wanted: Tensor, unit: Tensor, far: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Solve for one unknown: u >= c where a = 1, u <= -c where a = -1."""
    slope = unit[..., 0]
    bottom = torch.where(slope <= 0, -torch.inf, far).amax(-1, keepdim=True)
    top = torch.where(slope >= 0, torch.inf, -far).amin(-1, keepdim=True)
    inside = torch.minimum(torch.maximum(wanted, bottom), top)
    met = torch.where(bottom > top, 0.5 * (bottom + top), inside)
    return torch.minimum(torch.maximum(met, low), high)


def _in_plane(wanted: Tensor, unit: Tensor, far: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Two unknowns: the nearest corner or foot that satisfies all, else least squares of what is missing."""
    sides = torch.eye(2, dtype=wanted.dtype, device=wanted.device)
    sides = torch.cat((sides, -sides))
    lines = torch.cat((unit, sides.expand(*unit.shape[:-2], -1, -1)), dim=-2)
    aims = torch.cat((far, torch.cat((low, -high)).to(far).expand(*far.shape[:-1], -1)), dim=-1)
    total = aims.shape[-1]  # -inf of a bound that is not there: what lies on its edge fits nowhere
    feet = wanted.unsqueeze(-2) + (aims - (lines * wanted.unsqueeze(-2)).sum(-1)).unsqueeze(-1) * lines
    pairs = list(itertools.combinations(range(total), 2))
    first, second = [i for i, _ in pairs], [j for _, j in pairs]
    (a, c), (b, d) = (lines[..., k, :].unbind(-1) for k in (first, second))
    one, other = aims[..., first], aims[..., second]
    corners = torch.stack((one * d - other * c, other * a - one * b), dim=-1) / (a * d - b * c).unsqueeze(-1)
    points = torch.cat((feet, corners), dim=-2)  # (..., P, 2)
    rounded = torch.full((len(pairs) + total, total), _ROUNDED, dtype=wanted.dtype, device=wanted.device)
    for row, edges in enumerate([[k] for k in range(total)] + [list(pair) for pair in pairs]):
        rounded[row, edges] = _OWN
    scale = 1 + wanted.abs().amax(-1, keepdim=True) + far.abs().amax(-1, keepdim=True) + points.abs().amax(-1)
    (a, b), (x, y) = lines.unsqueeze(-3).unbind(-1), points.unsqueeze(-2).unbind(-1)
    short = aims.unsqueeze(-2) - (a * x + b * y)
    fits = (short <= rounded * torch.finfo(wanted.dtype).eps * scale.unsqueeze(-1)).all(-1)
    apart = torch.where(fits, (points - wanted.unsqueeze(-2)).square().sum(-1), torch.inf)
    nearest, found = _first_least(points, apart)
    nearest = torch.minimum(torch.maximum(nearest, low), high)

    def compromise(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        _, none, wanted, unit, far = now
        return _least_squares(wanted, unit, far, low, high), none, wanted, unit, far

    # Few rows have no solution: all that their compromise reads is carried, so that nothing is found ahead.
    none = ~(found.squeeze(-1) < torch.inf)
    point: Tensor = repeat(1, compromise, (nearest, none, wanted, unit, far), where=lambda now: now[1])[0]
    return point


def _least_squares(wanted: Tensor, unit: Tensor, far: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Two unknowns in a box: the least sum of squares of what is missing, and of these the nearest."""
    count = far.shape[-1]
    start = torch.minimum(torch.maximum(wanted, low), high)

    def subset(chosen: Tensor) -> Tensor:
        """The minima for a set of inequalities, on the plane and its edges: (..., S, k) -> (..., S, 15)."""
        a, b = (chosen * unit[..., k].unsqueeze(-2) for k in (0, 1))
        aims, give = chosen * far.unsqueeze(-2), _small(far).give
        aa, ab, bb = ((p * q).sum(-1) for p, q in ((a, a), (a, b), (b, b)))
        ra, rb = ((p * aims).sum(-1) for p in (a, b))
        ra, rb = ra + give * start[..., :1], rb + give * start[..., 1:]
        aa, bb = aa + give, bb + give
        turn = aa * bb - ab * ab
        candidates = [((ra * bb - rb * ab) / turn, (rb * aa - ra * ab) / turn)]
        for end in (low, high):
            there = torch.where(torch.isfinite(end), end, start)
            x, y = (there[..., k : k + 1].expand_as(ra) for k in (0, 1))
            candidates += [(x, (rb - ab * x) / bb), ((ra - ab * y) / aa, y)]
        found = []
        for pair in candidates:
            u = torch.minimum(torch.maximum(torch.stack(pair, dim=-1), low), high)
            missing = far.unsqueeze(-2) - (unit.unsqueeze(-3) * u.unsqueeze(-2)).sum(-1)
            paid = torch.where(missing > 0, missing, 0.0).square().sum(-1)
            found += [u, (paid + give * (u - start.unsqueeze(-2)).square().sum(-1)).unsqueeze(-1)]
        return torch.cat(found, dim=-1)

    subsets = wanted.new_tensor(list(itertools.product((0.0, 1.0), repeat=count))[1:])
    shape = (*wanted.shape[:-1], *subsets.shape)
    found = each(subset, subsets.expand(shape), dim=wanted.dim() - 1, together=1).unflatten(-1, (5, 3))
    found = found.flatten(-3, -2)
    return _first_least(found[..., :2], found[..., 2])[0]


def _best_case(wanted: Tensor, unit: Tensor, far: Tensor, low: Tensor, high: Tensor, table: Tensor) -> Tensor:
    size, count, small = wanted.shape[-1], far.shape[-1], _small(far)

    def case(points: Tensor) -> Tensor:
        """A firm and a soft u, and how far each is from a solution: (..., P, k + m) -> (..., P, 2 m + 2)."""
        active, side = points.split((count, size), dim=-1)
        start, rows, aims = wanted.unsqueeze(-2), unit.unsqueeze(-3), far.unsqueeze(-2)
        base = torch.where(side < 0, low, torch.where(side > 0, high, start))
        free = (side == 0).to(wanted).unsqueeze(-2) * rows  # (..., P, k, m)
        gram = active.unsqueeze(-1) * active.unsqueeze(-2) * (free.unsqueeze(-2) * free.unsqueeze(-3)).sum(-1)
        right = active * (aims - (rows * base.unsqueeze(-2)).sum(-1))
        found = []
        for give in (small.firm, small.soft):
            matrix = gram + torch.diag_embed(1 - (1 - give) * active)
            push = _solve(matrix, right)
            if give == small.firm:  # once more for what is left: the give shall not show
                push = push + _solve(matrix, right - (gram * push.unsqueeze(-2)).sum(-1))
            moved = start + (rows * push.unsqueeze(-1)).sum(-2)
            u = torch.minimum(torch.maximum(moved, low), high)
            short = aims - (rows * u.unsqueeze(-2)).sum(-1)
            allowed = 0.0 if give == small.firm else give * push
            off = torch.maximum(torch.where(active > 0, (short - allowed).abs(), short), -push)
            error = off.amax(-1, keepdim=True)
            found += [u, torch.where(error < 0, 0.0, error)]
        return torch.cat(found, dim=-1)

    shape = (*wanted.shape[:-1], *table.shape)
    found = each(case, table.to(wanted).expand(shape), dim=wanted.dim() - 1, together=1)
    firm, error, soft, soft_error = found.split((size, 1, size, 1), dim=-1)
    scale = 1 + wanted.abs().amax(-1, keepdim=True) + far.abs().amax(-1, keepdim=True)
    met, left = _first_least(firm, error.squeeze(-1))
    given, _ = _first_least(soft, soft_error.squeeze(-1))
    return torch.where(left <= small.met * scale, met, given)


def _small(like: Tensor) -> _Small:
    return _DOUBLE if like.dtype == torch.float64 else _SINGLE


def _first_least(points: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
    """The first point of the least error, and that error: (..., P, m), (..., P) -> (..., m), (..., 1)."""
    count = error.shape[-1]
    place = torch.arange(count, dtype=error.dtype, device=error.device)
    least = error.amin(-1, keepdim=True)
    first = torch.where(error == least, place, float(count)).amin(-1, keepdim=True)
    chosen = torch.where((place == first).unsqueeze(-1), points, 0.0).sum(-2)
    return torch.where(first < count, chosen, torch.nan), least  # no least at all: something was NaN


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """M^-1 r by elimination without pivots, M symmetric positive definite: (..., k, k), (..., k)."""
    columns = list(right.unbind(-1))
    rows = [list(row.unbind(-1)) for row in matrix.unbind(-2)]
    size = len(columns)
    for i in range(size):
        for j in range(i + 1, size):
            share = rows[j][i] / rows[i][i]
            rows[j] = [
                one if k <= i else one - share * other
                for k, (one, other) in enumerate(zip(rows[j], rows[i], strict=True))
            ]
            columns[j] = columns[j] - share * columns[i]
    solved: list[Tensor] = []
    for i in reversed(range(size)):
        known = columns[i]
        for k, value in enumerate(reversed(solved), start=i + 1):
            known = known - rows[i][k] * value
        solved.append(known / rows[i][i])
    return torch.stack(solved[::-1], dim=-1)
