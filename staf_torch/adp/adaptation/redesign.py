"""The Riccati equation of every row's own model, by structured doubling, in operations of a row program."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes import repeat
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
    start = doubling_start(a, control_rate(b, r_inverse), q)
    found: Doubling = repeat(doublings, doubling_step, start)
    return found.h


class Redesign:
    """Riccati equations of rows, solved anew at every control of a loop.

    Args:
        call: whose arguments these are, for messages.
        cost: the cost rate, without discount.
        doublings: of a design, at least 1.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(self, call: str, cost: Cost, doublings: int) -> None:
        if cost.discount:
            raise fail(call, "cost", "must have no discount", cost.discount)
        self.doublings = integer(call, "doublings", doublings, least=1)
        self.curvature, self.r_inverse = cost.state_curvature(), cost.r_inverse

    def step(self, p: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """P of the model of now, or the one before, (..., n, n), where that is not finite: A, B as in
        `riccati_rows`."""
        found = riccati_rows(a, b, self.curvature, self.r_inverse, doublings=self.doublings)
        return torch.where(torch.isfinite(found).flatten(-2).all(-1)[..., None, None], found, p)

    def solved(self, p: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Return where P solves the equation of the model of now, (...) bool."""
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
