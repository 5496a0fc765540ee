"""Algebraic Riccati equations of linear plants, of one or of all rows of a `torch.func.vmap` at once.

The structure-preserving doubling algorithm squares the closed loop: its error falls as rho^(2^k). What it
loses to a badly scaled plant, Newton's method on the equation gains back, with Lyapunov equations solved by
doubling, too. Its residual has the gain as a factor, K'RK, which keeps the digits that PBR^-1B'P loses: P has
some 1e-16 of relative error where the Schur method has 1e-15 to 1e-9.

Source: Chu, Fan and Lin, "A structure-preserving doubling algorithm for continuous-time algebraic Riccati
equations", Linear Algebra and its Applications 396 (2005); Benner and Byers, "An exact line search method for
solving generalized continuous-time algebraic Riccati equations", IEEE TAC 43 (1998), for the refinement.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, bmm

from ..lanes.row_decisions import in_any_row, is_of_rows

_DOUBLINGS, _NEWTON = 60, 8  # at most
_SETTLED = 1e-17  # relative, of what a doubling adds
_LYAPUNOV = 1e-9  # likewise, of a correction
_BESIDE = 1.25  # a shift of the spectrum's geometric middle would meet an eigenvalue more often
_SOLVED = 1e-9  # residual over the largest of its terms: P is no solution above
_Terms = tuple[Tensor, Tensor, tuple[Tensor, ...]]  # closed loop, residual, what it is the sum of


def continuous_solution(a: Tensor, b: Tensor, q: Tensor, r: Tensor) -> Tensor:
    """P of A'P + PA - P B R^-1 B'P + Q = 0, stabilising: (n, n), (n, m), (n, n), (m, m) -> (n, n).

    NaN where none was found, as without one.
    """
    a, b, q, r = (each.unsqueeze(0) for each in (a, b, q, r))  # one product for one and many: the same bits
    eye = torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
    g = b @ _solve(r, b.mT)
    scale = (_norm(q) / _norm(g)).sqrt()
    scale = torch.where((scale > 0) & (scale < torch.inf), scale, torch.ones_like(scale))
    g, h = scale * g, q / scale
    modes = torch.linalg.eigvals(torch.cat((torch.cat((a, -g), -1), torch.cat((-h, -a.mT), -1)), -2))
    modes = (modes.real.square() + modes.imag.square()).sqrt()  # of the same bits in every batch
    shift = _BESIDE * (modes.amax(-1) * modes.amin(-1)).sqrt()[..., None, None]
    shifted = _inverse(a - shift * eye)
    whole = _inverse(a - shift * eye + g @ shifted.mT @ h)
    start = 2 * shift * (shifted @ g @ whole.mT), 2 * shift * (whole.mT @ h @ shifted)
    p = scale * _doubled(eye + 2 * shift * whole, *(0.5 * (each + each.mT) for each in start))

    def terms(p: Tensor) -> _Terms:
        seen = p @ b
        paid, left = seen @ _solve(r, seen.mT), a.mT @ p
        return a - b @ _solve(r, seen.mT), left + left.mT - paid + q, (left, paid, q)

    def correction(closed: Tensor, residual: Tensor) -> Tensor:
        inverse = _inverse(closed - shift * eye)
        return _summed((closed + shift * eye) @ inverse, 2 * shift * (inverse.mT @ residual @ inverse))

    return _refined(p, terms, correction, lambda modes: modes.real < 0)[0]


def discrete_solution(a: Tensor, b: Tensor, q: Tensor, s: Tensor, r: Tensor) -> Tensor:
    """P of P = A'PA + Q - (A'PB + S)(R + B'PB)^-1 (B'PA + S'), stabilising: (n, n).

    NaN where none was found, as without one.
    """
    a, b, q, s, r = (each.unsqueeze(0) for each in (a, b, q, s, r))
    cross = _solve(r, s.mT)
    free, g, h = a - bmm(b, cross), bmm(b, _solve(r, b.mT)), q - bmm(s, cross)
    p = _doubled(free, *(0.5 * (each + each.mT) for each in (g, h)))

    def terms(p: Tensor) -> _Terms:
        seen = bmm(b.mT, p)
        gain = _solve(r + bmm(seen, b), bmm(seen, a) + s.mT)
        closed, cross = a - bmm(b, gain), bmm(s, gain)
        # Of what the gain pays (Joseph's form): A'PA would be much larger than what is left of it.
        paid = q - cross - cross.mT + bmm(bmm(gain.mT, r), gain)
        left = bmm(bmm(closed.mT, p), closed)
        return closed, 0.5 * (left + left.mT) + (paid - p), (left, p)

    return _refined(p, terms, _summed, lambda modes: modes.abs() < 1)[0]


def discrete_gain(p: Tensor, a: Tensor, b: Tensor, s: Tensor, r: Tensor) -> Tensor:
    """K = (R + B'PB)^-1 (B'PA + S'), (m, n)."""
    p, a, b, s, r = (each.unsqueeze(0) for each in (p, a, b, s, r))
    return _solve(r + b.mT @ p @ b, b.mT @ p @ a + s.mT)[0]


def _doubled(e: Tensor, g: Tensor, h: Tensor) -> Tensor:
    """The limit of H under doubling, each row until it has settled."""
    n, eye = e.shape[-1], torch.eye(e.shape[-1], dtype=e.dtype, device=e.device)
    going = _Going()
    for _ in range(_DOUBLINGS):
        moved, reached = _solve(eye + bmm(g, h), torch.cat((e, g), dim=-1)).split((n, n), dim=-1)
        back = e.mT
        more, further = bmm(bmm(back, h), moved), bmm(bmm(e, reached), back)
        more, further = 0.5 * (more + more.mT), 0.5 * (further + further.mT)
        e, g, h = going.of(bmm(e, moved), e), going.of(g + further, g), going.of(h + more, h)
        if not going.on(_norm(more) > _SETTLED * _norm(h)):
            break
    return h


def _summed(closed: Tensor, added: Tensor) -> Tensor:
    """Sum of closed'^k added closed^k, the solution X of X = closed'X closed + added."""
    going = _Going()
    for _ in range(_DOUBLINGS):
        more = bmm(bmm(closed.mT, added), closed)
        added = going.of(added + more, added)
        if not going.on(_norm(more) > _LYAPUNOV * _norm(added)):
            break
        closed = bmm(closed, closed)
    return 0.5 * (added + added.mT)


def _refined(
    p: Tensor,
    terms: Callable[[Tensor], _Terms],
    correction: Callable[[Tensor, Tensor], Tensor],
    decays: Callable[[Tensor], Tensor],
) -> Tensor:
    """P after Newton's steps, each row's own as long as they shrink; NaN where it is no stabilising solution.

    Args:
        p: (1, n, n).
        terms: closed loop, residual and its terms, at P.
        correction: of P, for a closed loop and a residual.
        decays: which eigenvalues of the closed loop do.
    """
    going, before = _Going(), torch.full_like(p[..., :1, :1], torch.inf)
    for _ in range(_NEWTON):
        closed, residual, parts = terms(p)
        step = correction(closed, residual)
        change = _norm(step)
        if not going.on(change < 0.5 * before):
            break
        p, before = going.of(p + step, p), change
        if not going.on(change > torch.finfo(p.dtype).eps * _norm(p)):
            closed, residual, parts = terms(p)
            break
    else:
        closed, residual, parts = terms(p)
    size = sum(map(_norm, parts), torch.zeros_like(before))
    fine = torch.isfinite(p).all(-1).all(-1) & torch.isfinite(closed).all(-1).all(-1)
    modes = torch.linalg.eigvals(torch.where(fine[..., None, None], closed, torch.zeros_like(closed)))
    solved = fine & decays(modes).all(-1) & (_norm(residual) <= _SOLVED * size)[..., 0, 0]
    return torch.where(solved[..., None, None], p, torch.nan)


class _Going:
    """Rows of a `torch.func.vmap`, or the one, that have not settled: of these alone numbers change."""

    def __init__(self) -> None:
        self._rows: Tensor | None = None  # all
        self._several = False

    def on(self, further: Tensor) -> bool:
        """Return whether any row goes on: (..., 1, 1), which of those that did before do."""
        self._several = is_of_rows(further)
        if not self._several:
            return bool(further)
        self._rows = further if self._rows is None else self._rows & further
        return in_any_row(self._rows)

    def of(self, new: Tensor, old: Tensor) -> Tensor:
        """Return new numbers of rows that go on, old ones of others."""
        return torch.where(self._rows, new, old) if self._several and self._rows is not None else new


def _norm(matrix: Tensor) -> Tensor:
    """The largest sum of a row's sizes, (..., 1, 1)."""
    largest: Tensor = torch.linalg.matrix_norm(matrix, torch.inf, keepdim=True)
    return largest


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """`torch.linalg.solve`, which does not raise for the other rows."""
    found: Tensor = torch.linalg.solve_ex(matrix, right)[0]
    return found


def _inverse(matrix: Tensor) -> Tensor:
    found: Tensor = torch.linalg.inv_ex(matrix)[0]
    return found
