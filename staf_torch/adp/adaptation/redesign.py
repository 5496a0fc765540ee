"""The Riccati equation of every row's own model, by structured doubling, in operations of a row program."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ...numerics.checks import fail, integer
from ...numerics.riccati import product
from ..problem.cost import Cost

_SOLVED = 1e-2  # residual of the Riccati equation, for the model of the moment, of a design that is used


class Doubling(NamedTuple):
    """The symplectic pair after 2^k steps; h tends to P."""

    a: Tensor  # (..., n, n)
    g: Tensor  # (..., n, n)
    h: Tensor  # (..., n, n)


def riccati_rows(a: Tensor, b: Tensor, q: Tensor, r_inverse: Tensor, *, doublings: int = 14) -> Tensor:
    """Return P >= 0 with A'P + PA - P B R^-1 B'P + Q = 0, every row its own A and B, in so many steps.

    Structured doubling on a Cayley transform of the Hamiltonian: k steps leave an error of rho^(2^k), with
    rho < 1 the largest |(l + c) / (l - c)| of the closed loop's eigenvalues l and c twice the norm of A and
    of the rate at which control acts. Where a row cannot be stabilised P is not a solution.

    Args:
        a: A, (..., n, n), 1/s.
        b: B, (..., n, m).
        q: Q, (n, n), positive semidefinite.
        r_inverse: R^-1, (m, m).
        doublings: at least 1.

    Raises:
        ValueError: if ``doublings`` is not an integer of at least 1.

    Source: Chu, Fan and Lin, "A structure-preserving doubling algorithm for continuous-time algebraic Riccati
    equations", Linear Algebra Appl. 396 (2005).
    """
    integer("riccati_rows", "doublings", doublings, least=1)
    now = doubling_start(a, control_rate(b, r_inverse), q)
    for _ in range(doublings):
        now = doubling_step(now)
    return now.h


class Design(NamedTuple):
    """The design that is used, and the one that is under way."""

    p: Tensor  # P of the last one that was finished, (..., n, n)
    doubling: Doubling  # of the one under way
    stage: Tensor  # doublings done of it, (...); where it is 0 one begins with the model of now

    @classmethod
    def init(cls, x: Tensor) -> Design:
        """None yet, a row each of (..., n)."""
        square = x.new_zeros(*x.shape, x.shape[-1])
        empty = Doubling(square, square.clone(), square.clone())
        return cls(square.clone(), empty, x.new_zeros(x.shape[:-1]))


class Redesign:
    """Riccati equations of rows solved while a loop runs: some doublings a control, one design after another.

    Args:
        curvature: Q, (n, n).
        r_inverse: R^-1, (m, m).
        doublings: of a design.
        a_step: of them a control, dividing them.
    """

    def __init__(self, curvature: Tensor, r_inverse: Tensor, doublings: int, a_step: int) -> None:
        self.curvature, self.r_inverse = curvature, r_inverse
        self.doublings, self.a_step = doublings, a_step

    @classmethod
    def of(cls, call: str, cost: Cost, doublings: int, a_step: int | None) -> Redesign:
        """The designs of a cost without discount, in ``call``'s name; all doublings at once for None.

        Raises:
            ValueError: if an argument breaks its rule.
        """
        if cost.discount:
            raise fail(call, "cost", "must have no discount", cost.discount)
        integer(call, "doublings", doublings, least=1)
        each = doublings if a_step is None else integer(call, "a_step", a_step, least=1)
        if doublings % each:
            raise fail(call, "a_step", f"must divide the {doublings} doublings", a_step)
        return cls(cost.state_curvature(), cost.r_inverse, doublings, each)

    def step(self, design: Design, a: Tensor, b: Tensor) -> Design:
        """The designs after ``a_step`` doublings more.

        Args:
            design: before them.
            a: A of now, (..., n, n).
            b: B of now, (..., n, m).
        """
        p, pair, stage = design
        begins = (stage == 0)[..., None, None]
        first = doubling_start(a, control_rate(b, self.r_inverse), self.curvature)
        pair = Doubling(*(torch.where(begins, new, old) for new, old in zip(first, pair, strict=True)))
        for _ in range(self.a_step):
            pair = doubling_step(pair)
        stage = stage + self.a_step
        done = stage >= self.doublings
        sound = done & torch.isfinite(pair.h).flatten(-2).all(-1)
        p = torch.where(sound[..., None, None], pair.h, p)
        # A design that went wrong must not end the row: its pair starts from zero.
        pair = Doubling(
            *(torch.where(torch.isfinite(part) & ~done[..., None, None], part, 0.0) for part in pair)
        )
        return Design(p, pair, torch.where(done, 0.0, stage))

    def solved(self, p: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Whether P is of the model of now, (...) bool: a design may be older, or without a solution."""
        return riccati_residual(p, a, control_rate(b, self.r_inverse), self.curvature) < _SOLVED


def control_rate(b: Tensor, r_inverse: Tensor) -> Tensor:
    """G = B R^-1 B': (..., n, m), (m, m) -> (..., n, n)."""
    return product(product(b, r_inverse.to(b)), b.mT)


def doubling_start(a: Tensor, g: Tensor, q: Tensor) -> Doubling:
    """The pair of the Cayley transform.

    Args:
        a: A, (..., n, n).
        g: B R^-1 B', (..., n, n).
        q: Q, (n, n).
    """
    size = a.shape[-1]
    q = q.to(a)
    identity = torch.eye(size, dtype=a.dtype, device=a.device)
    # Twice a bound of the eigenvalues of A, so that A - c I has an inverse, and of those of the closed loop.
    speed = a.square().sum((-2, -1)) + (g.square().sum((-2, -1)) * q.square().sum()).sqrt()
    c = 2 * speed.sqrt()[..., None, None]
    shifted = torch.linalg.inv_ex(a - c * identity)[0]
    whole = torch.linalg.inv_ex(a - c * identity + product(product(g, shifted.mT), q))[0]
    return Doubling(
        identity + 2 * c * whole,
        2 * c * product(product(shifted, g), whole.mT),
        2 * c * product(product(whole.mT, q), shifted),
    )


def doubling_step(now: Doubling) -> Doubling:
    """The pair of twice as many steps."""
    identity = torch.eye(now.a.shape[-1], dtype=now.a.dtype, device=now.a.device)
    whole = torch.linalg.inv_ex(identity + product(now.g, now.h))[0]
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
