"""Algebraic Riccati equations of linear plants, of one or of all rows at once, and the recursion in time.

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
from typing import NamedTuple

import torch
from torch import Tensor, bmm
from torch.linalg import inv_ex

from ..lanes import repeat
from ..lanes.per_row.decisions import in_any_row, is_of_rows
from .checks import integer

_DOUBLINGS, _NEWTON = 60, 8  # at most
_SETTLED = 1e-17  # relative, of what a doubling adds
_LYAPUNOV = 1e-9  # likewise, of a correction
_BESIDE = 1.25  # a shift of the spectrum's geometric middle would meet an eigenvalue more often
_SOLVED = 1e-9  # residual over the largest of its terms: P is no solution above
_Terms = tuple[Tensor, Tensor, tuple[Tensor, ...]]  # closed loop, residual, what it is the sum of
Minimum = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""k (B, m) and K (B, m, n), the minimum of u'Hu/2 + (s + C x)'u, from s (B, m), C (B, m, n), H (B, m, m)."""


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
    shifted = inv_ex(a - shift * eye)[0]
    whole = inv_ex(a - shift * eye + g @ shifted.mT @ h)[0]
    start = 2 * shift * (shifted @ g @ whole.mT), 2 * shift * (whole.mT @ h @ shifted)
    p = scale * _doubled(eye + 2 * shift * whole, *(0.5 * (each + each.mT) for each in start))

    def terms(p: Tensor) -> _Terms:
        seen = p @ b
        paid, left = seen @ _solve(r, seen.mT), a.mT @ p
        return a - b @ _solve(r, seen.mT), left + left.mT - paid + q, (left, paid, q)

    def correction(closed: Tensor, residual: Tensor) -> Tensor:
        inverse = inv_ex(closed - shift * eye)[0]
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
    p: Tensor,  # (1, n, n)
    terms: Callable[[Tensor], _Terms],  # closed loop, residual and its terms, at P
    correction: Callable[[Tensor, Tensor], Tensor],  # of P, for a closed loop and a residual
    decays: Callable[[Tensor], Tensor],  # which eigenvalues of the closed loop do
) -> Tensor:
    """P after Newton's steps, each row's own as long as they shrink; NaN where it is no stabilising
    solution."""
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


class RiccatiStep(NamedTuple):
    """The control u = k + K x that a step chose, and the model g'x + x'Hx/2 of the value before it."""

    gradient: Tensor  # g, (B, n)
    curvature: Tensor  # H, (B, n, n)
    promised: Tensor  # value at x = 0 without that after the step: at most 0 where k is the minimum, (B,)
    change: Tensor  # k, (B, m)
    feedback: Tensor  # K, (B, m, n)


def riccati_step(
    gradient: Tensor,  # g of the model after the step, (B, n)
    curvature: Tensor,  # H of it, (B, n, n)
    slope: Tensor,  # F, (B, n, n + m)
    cost_gradient: Tensor,  # c, (B, n + m)
    cost_curvature: Tensor,  # W, (B, n + m, n + m)
    minimum: Minimum,  # chooses k and K
) -> RiccatiStep:
    """Riccati step backward through x+ = F z, z = (x, u), with the stage cost c'z + z'Wz/2.

    k need not be the minimum: the model is that of the control that is chosen, with all of its terms. All
    products are sums entry by entry, of which a compiled program leaves out what is 0.
    """
    n = gradient.shape[-1]
    q1 = cost_gradient + (gradient.unsqueeze(-1) * slope).sum(-2)
    q2 = cost_curvature + product(slope.mT, product(curvature, slope))
    qx, qu, qxx, qux, quu = q1[:, :n], q1[:, n:], q2[:, :n, :n], q2[:, n:, :n], q2[:, n:, n:]
    change, feedback = minimum(qu, qux, quu)
    moved = (quu * change.unsqueeze(-2)).sum(-1)
    along = (feedback * (moved + qu).unsqueeze(-1)).sum(-2) + (qux * change.unsqueeze(-1)).sum(-2)
    cross = product(feedback.mT, qux)
    bent = qxx + product(feedback.mT, product(quu, feedback)) + cross + cross.mT
    promised = (qu * change).sum(-1) + 0.5 * (moved * change).sum(-1)
    return RiccatiStep(qx + along, 0.5 * (bent + bent.mT), promised, change, feedback)


def measured(covariance: Tensor, gain: Tensor, row: Tensor, variance: Tensor) -> Tensor:
    """(I - k h') P (I - k h')' + r k k', the covariance after the measurement h'x with the gain k:
    positive where P - k h'P, which is the same without rounding, may become 0 for ever or negative
    (Joseph's form). P (..., n, n), k and h (..., n), r (...)."""
    seen = (covariance * row.unsqueeze(-2)).sum(-1)
    left = covariance - gain.unsqueeze(-1) * seen.unsqueeze(-2)
    back = (left * row.unsqueeze(-2)).sum(-1)
    return left + (variance.unsqueeze(-1) * gain - back).unsqueeze(-1) * gain.unsqueeze(-2)


def product(a: Tensor, b: Tensor) -> Tensor:
    """(..., i, j), (..., j, k) -> (..., i, k), entry by entry."""
    return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)


class Doubling(NamedTuple):
    """The symplectic pair after 2^k steps; h tends to P."""

    a: Tensor  # (..., n, n)
    g: Tensor  # (..., n, n)
    h: Tensor  # (..., n, n)


def riccati_rows(a: Tensor, b: Tensor, q: Tensor, r_inverse: Tensor, *, doublings: int = 14) -> Tensor:
    """Return P >= 0 with A'P + PA - P B R^-1 B'P + Q = 0, every row its own A (..., n, n), 1/s, and B (...,
    n, m), in so many steps.

    Structured doubling on a Cayley transform of the Hamiltonian: k steps leave an error of rho^(2^k), with
    rho < 1 the largest |(l + c) / (l - c)| of the closed loop's eigenvalues l and c twice the norm of A and
    of the rate at which control acts. Where a row cannot be stabilised P is not a solution.

    Raises:
        ValueError: if ``doublings`` is not an integer of at least 1.

    Source: Chu, Fan and Lin (above).
    """
    integer("riccati_rows", "doublings", doublings, least=1)
    start = doubling_start(a, control_rate(b, r_inverse), q)
    found: Doubling = repeat(doublings, doubling_step, start)
    return found.h


def control_rate(b: Tensor, r_inverse: Tensor) -> Tensor:
    """G = B R^-1 B': (..., n, m), (m, m) -> (..., n, n)."""
    return product(product(b, r_inverse.to(b)), b.mT)


def doubling_start(a: Tensor, g: Tensor, q: Tensor) -> Doubling:
    """Return the pair of the Cayley transform, of A and G = B R^-1 B', (..., n, n), and Q (n, n)."""
    size = a.shape[-1]
    q = q.to(a)
    identity = torch.eye(size, dtype=a.dtype, device=a.device)
    # Twice a bound of the eigenvalues of A, so that A - c I has an inverse, and of those of the closed loop.
    speed = a.square().sum((-2, -1)) + (g.square().sum((-2, -1)) * q.square().sum()).sqrt()
    c = 2 * speed.sqrt()[..., None, None]
    shifted = inv_ex(a - c * identity)[0]
    whole = inv_ex(a - c * identity + product(product(g, shifted.mT), q))[0]
    return Doubling(
        identity + 2 * c * whole,
        2 * c * product(product(shifted, g), whole.mT),
        2 * c * product(product(whole.mT, q), shifted),
    )


def doubling_step(now: Doubling) -> Doubling:
    """The pair of twice as many steps."""
    identity = torch.eye(now.a.shape[-1], dtype=now.a.dtype, device=now.a.device)
    whole = inv_ex(identity + product(now.g, now.h))[0]
    forward = product(now.a, whole)
    g = now.g + product(product(forward, now.g), now.a.mT)
    h = now.h + product(product(now.a.mT, now.h), product(whole, now.a))
    return Doubling(product(forward, now.a), 0.5 * (g + g.mT), 0.5 * (h + h.mT))


def riccati_residual(p: Tensor, a: Tensor, g: Tensor, q: Tensor) -> Tensor:
    """Largest entry of A'P + PA - PGP + Q as a share of the largest of its terms: (...)."""
    flow, turned = product(a.mT, p), product(product(p, g), p)
    q = q.to(p)
    left = flow + flow.mT - turned + q
    size = flow.abs().amax((-2, -1)) + turned.abs().amax((-2, -1)) + q.abs().max()
    return left.abs().amax((-2, -1)) / size
