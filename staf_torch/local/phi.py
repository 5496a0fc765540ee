"""The phi functions of exponential integrators."""

from __future__ import annotations

import torch
from torch import Tensor


def phi(t: Tensor, top: int) -> list[Tensor]:
    """f_k(t) = k! phi_k(t) for k = 0..top, with phi_k(t) = sum_j t^j / (k + j)!, so that f_0 = exp.

    For |t| <= 1 by the Taylor series of f_top and, downwards, f_{k-1} = 1 + t f_k / k; beyond that upwards
    from the exponential, which loses a factor k! of accuracy at |t| = 1 and nothing far out.

    Returns:
        top + 1 tensors of the shape of t.
    """
    exponential = t.exp()
    if top == 0:
        return [exponential]
    small = t.clamp(-1.0, 1.0)
    near = small == t
    one = torch.ones_like(t)
    below = [torch.add(one, small, alpha=1 / (top + _terms(top, t.dtype)))]
    for j in range(_terms(top, t.dtype) - 1, 0, -1):
        below[0] = torch.addcmul(one, below[0], small, value=1 / (top + j))
    for k in range(top, 1, -1):
        below.append(torch.addcmul(one, below[-1], small, value=1 / k))
    large = torch.where(near, one, t)
    above = [exponential]
    for k in range(top):
        rest = (above[-1] - 1) / large
        above.append(rest if k == 0 else (k + 1) * rest)
    tails = [torch.where(near, b, a) for b, a in zip(reversed(below), above[1:], strict=True)]
    return [exponential, *tails]


def _terms(top: int, dtype: torch.dtype) -> int:
    """N with the first neglected term of f_top, top! t^(N+1) / (top + N + 1)!, below rounding at |t| = 1."""
    term, count = 1.0, 0
    while term > 0.25 * torch.finfo(dtype).eps:
        count += 1
        term /= top + count
    return count
