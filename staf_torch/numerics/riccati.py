"""The Riccati recursion backward in time: from the local model of a value to that of the time before."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

Minimum = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""k (B, m) and K (B, m, n), the minimum of u'Hu/2 + (s + C x)'u, from s (B, m), C (B, m, n), H (B, m, m)."""


class RiccatiStep(NamedTuple):
    """The control u = k + K x that a step chose, and the model g'x + x'Hx/2 of the value before it."""

    gradient: Tensor  # g, (B, n)
    curvature: Tensor  # H, (B, n, n)
    promised: Tensor  # value at x = 0 without that after the step: at most 0 where k is the minimum, (B,)
    change: Tensor  # k, (B, m)
    feedback: Tensor  # K, (B, m, n)


def riccati_step(
    gradient: Tensor,
    curvature: Tensor,
    slope: Tensor,
    cost_gradient: Tensor,
    cost_curvature: Tensor,
    minimum: Minimum,
) -> RiccatiStep:
    """Riccati step backward through x+ = F z, z = (x, u), with the stage cost c'z + z'Wz/2.

    k need not be the minimum: the model is that of the control that is chosen, with all of its terms. All
    products are sums entry by entry, of which a compiled program leaves out what is 0.

    Args:
        gradient: g of the model after the step, (B, n).
        curvature: H of it, (B, n, n).
        slope: F, (B, n, n + m).
        cost_gradient: c, (B, n + m).
        cost_curvature: W, (B, n + m, n + m).
        minimum: chooses k and K.
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
    """(I - k h') P (I - k h')' + r k k', the covariance after the measurement h'x with the gain k: positive
    where P - k h'P, which is the same without rounding, may become 0 for ever or negative (Joseph's form).

    Args:
        covariance: P, (..., n, n).
        gain: k, (..., n).
        row: h, (..., n).
        variance: r, (...).
    """
    seen = (covariance * row.unsqueeze(-2)).sum(-1)
    left = covariance - gain.unsqueeze(-1) * seen.unsqueeze(-2)
    back = (left * row.unsqueeze(-2)).sum(-1)
    return left + (variance.unsqueeze(-1) * gain - back).unsqueeze(-1) * gain.unsqueeze(-2)


def product(a: Tensor, b: Tensor) -> Tensor:
    """(..., i, j), (..., j, k) -> (..., i, k), entry by entry."""
    return (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)
