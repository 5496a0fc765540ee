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
    one, terms = torch.ones_like(t), _terms(top, t.dtype)
    small = t.clamp(-1.0, 1.0)
    near = small == t
    tail = torch.add(one, small, alpha=1 / (top + terms))
    for j in range(top + terms - 1, top, -1):
        tail = torch.addcmul(one, tail, small, value=1 / j)
    below = [tail]
    for k in range(top, 1, -1):
        below.append(torch.addcmul(one, below[-1], small, value=1 / k))
    large = torch.where(near, one, t)
    found, above = [exponential], exponential
    for k in range(top):
        above = torch.sub(above, one) / large
        above = torch.add(above, above, alpha=k) if k else above
        found.append(torch.where(near, below[top - 1 - k], above))
    return found


def _terms(top: int, dtype: torch.dtype) -> int:
    """N with the first neglected term of f_top, top! t^(N+1) / (top + N + 1)!, below rounding at |t| = 1."""
    small, term, count = (5e-17 if dtype == torch.float64 else 3e-8), 1.0, 0
    while term > small:
        count += 1
        term /= top + count
    return count
