"""The phi functions of exponential integrators."""

from __future__ import annotations

import torch
from torch import Tensor

_TERMS = 18  # 1 / 18! = 1.6e-16: enough for |t| <= 1


def phi(t: Tensor, top: int) -> list[Tensor]:
    """f_k(t) = k! phi_k(t) for k = 0..top, with phi_k(t) = sum_j t^j / (k + j)!, so that f_0 = exp.

    For |t| <= 1 by the Taylor series of f_top and, downwards, f_{k-1} = 1 + t f_k / k; beyond that upwards
    from the exponential, which loses a factor k! of accuracy at |t| = 1 and nothing far out.

    Returns:
        top + 1 tensors of the shape of t.
    """
    near = t.abs() <= 1
    small = torch.where(near, t, 0.0)
    one = torch.ones_like(t)
    current = one
    for j in range(_TERMS - 1, 0, -1):
        current = torch.addcmul(one, current, small, value=1 / (top + j))
    below = [current]
    for k in range(top, 0, -1):
        below.append(torch.addcmul(one, below[-1], small, value=1 / k))
    large = torch.where(near, 1.0, t)
    above = [large.exp()]
    for k in range(top):
        above.append((k + 1) * (above[-1] - 1) / large)
    return [torch.where(near, b, a) for b, a in zip(reversed(below), above, strict=True)]
