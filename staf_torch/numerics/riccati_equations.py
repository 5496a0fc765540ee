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
from torch import Tensor

from ..lanes.row_decisions import in_any_row

_DOUBLINGS, _NEWTON = 60, 8  # at most
_SETTLED = 1e-17  # relative, of what a doubling adds
_LYAPUNOV = 1e-9  # likewise, of a correction
_BESIDE = 1.25  # a shift of the spectrum's geometric middle would meet an eigenvalue more often
_SOLVED = 1e-9  # residual over the largest of its terms: P is no solution above


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

    def terms(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = p @ b
        paid, left = seen @ _solve(r, seen.mT), a.mT @ p
        return a - b @ _solve(r, seen.mT), left + left.mT - paid + q, _norm(left) + _norm(paid) + _norm(q)

    def correction(closed: Tensor, residual: Tensor) -> Tensor:
        inverse = _inverse(closed - shift * eye)
        return _summed((closed + shift * eye) @ inverse, 2 * shift * (inverse.mT @ residual @ inverse))

    return _refined(p, terms, correction, lambda modes: modes.real < 0)[0]


def discrete_solution(a: Tensor, b: Tensor, q: Tensor, s: Tensor, r: Tensor) -> Tensor:
    """P of P = A'PA + Q - (A'PB + S)(R + B'PB)^-1 (B'PA + S'), stabilising: (n, n).

    NaN where none was found, as without one.
    """
    a, b, q, s, r = (each.unsqueeze(0) for each in (a, b, q, s, r))
    free, g, h = a - b @ _solve(r, s.mT), b @ _solve(r, b.mT), q - s @ _solve(r, s.mT)
    p = _doubled(free, *(0.5 * (each + each.mT) for each in (g, h)))

    def terms(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gain = _solve(r + b.mT @ p @ b, b.mT @ p @ a + s.mT)
        closed, cross = a - b @ gain, s @ gain
        # Of what the gain pays (Joseph's form): A'PA would be much larger than what is left of it.
        paid = q - cross - cross.mT + gain.mT @ r @ gain
        left = closed.mT @ p @ closed
        return closed, 0.5 * (left + left.mT) + (paid - p), _norm(left) + _norm(p)

    return _refined(p, terms, _summed, lambda modes: modes.abs() < 1)[0]


def discrete_gain(p: Tensor, a: Tensor, b: Tensor, s: Tensor, r: Tensor) -> Tensor:
    """K = (R + B'PB)^-1 (B'PA + S'), (m, n)."""
    p, a, b, s, r = (each.unsqueeze(0) for each in (p, a, b, s, r))
    return _solve(r + b.mT @ p @ b, b.mT @ p @ a + s.mT)[0]


def _doubled(e: Tensor, g: Tensor, h: Tensor) -> Tensor:
    """The limit of H under doubling, each row until it has settled."""
    n, eye = e.shape[-1], torch.eye(e.shape[-1], dtype=e.dtype, device=e.device)
    going = torch.ones_like(e[..., :1, :1], dtype=torch.bool)
    for _ in range(_DOUBLINGS):
        moved, reached = _solve(eye + g @ h, torch.cat((e, g), dim=-1)).split((n, n), dim=-1)
        more, further = e.mT @ h @ moved, e @ reached @ e.mT
        more, further = 0.5 * (more + more.mT), 0.5 * (further + further.mT)
        after = e @ moved, g + further, h + more
        e, g, h = (torch.where(going, new, old) for new, old in zip(after, (e, g, h), strict=True))
        going = going & (_norm(more) > _SETTLED * _norm(h))
        if not in_any_row(going):
            break
    return h


def _summed(closed: Tensor, added: Tensor) -> Tensor:
    """Sum of closed'^k added closed^k, the solution X of X = closed'X closed + added."""
    going = torch.ones_like(closed[..., :1, :1], dtype=torch.bool)
    for _ in range(_DOUBLINGS):
        more = closed.mT @ added @ closed
        added, closed = torch.where(going, added + more, added), closed @ closed
        going = going & (_norm(more) > _LYAPUNOV * _norm(added))
        if not in_any_row(going):
            break
    return 0.5 * (added + added.mT)


def _refined(
    p: Tensor,
    terms: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]],
    correction: Callable[[Tensor, Tensor], Tensor],
    decays: Callable[[Tensor], Tensor],
) -> Tensor:
    """P after Newton's steps, each row's own as long as they shrink; NaN where it is no stabilising solution.

    Args:
        p: (1, n, n).
        terms: closed loop, residual and the size of its terms, at P.
        correction: of P, for a closed loop and a residual.
        decays: which eigenvalues of the closed loop do.
    """
    going, before = (
        torch.ones_like(p[..., :1, :1], dtype=torch.bool),
        torch.full_like(p[..., :1, :1], torch.inf),
    )
    for _ in range(_NEWTON):
        closed, residual, _ = terms(p)
        step = correction(closed, residual)
        size = _norm(step)
        going = going & (size < 0.5 * before)
        p, before = torch.where(going, p + step, p), size
        going = going & (size > torch.finfo(p.dtype).eps * _norm(p))
        if not in_any_row(going):
            break
    closed, residual, size = terms(p)
    fine = torch.isfinite(p).all(-1).all(-1) & torch.isfinite(closed).all(-1).all(-1)
    modes = torch.linalg.eigvals(torch.where(fine[..., None, None], closed, torch.zeros_like(closed)))
    solved = fine & decays(modes).all(-1) & (_norm(residual) <= _SOLVED * size)[..., 0, 0]
    return torch.where(solved[..., None, None], p, torch.nan)


def _norm(matrix: Tensor) -> Tensor:
    """The largest sum of a row's sizes, (..., 1, 1)."""
    return matrix.abs().sum(-1).amax(-1)[..., None, None]


def _solve(matrix: Tensor, right: Tensor) -> Tensor:
    """`torch.linalg.solve`, which does not raise for the other rows."""
    found: Tensor = torch.linalg.solve_ex(matrix, right)[0]
    return found


def _inverse(matrix: Tensor) -> Tensor:
    found: Tensor = torch.linalg.inv_ex(matrix)[0]
    return found
