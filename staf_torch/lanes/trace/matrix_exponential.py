"""Exponential of small matrices by scaling and squaring, in operations that have a scalar form."""

from __future__ import annotations

import torch
from torch import Tensor

from .loops import repeat, scan

_TERMS = 14  # of the Taylor series; the rest is 2e-17 for a matrix of norm 1/2
_HALVINGS = 64  # at most: beyond a norm of 1e19 nothing is left of it


def matrix_exponential(matrix: Tensor) -> Tensor:
    """e^A (..., N, N): A is halved until its norm is 1/2, the series of that is squared as often.

    A row squares as often as its largest matrix asks for. Source: Moler and Van Loan, "Nineteen dubious ways
    to compute the exponential of a matrix, twenty-five years later", SIAM Review 45 (2003), method 3.
    """
    size = matrix.shape[-1]
    rows = matrix if matrix.dim() > 2 else matrix.unsqueeze(0)
    largest = rows.abs().sum(-2).reshape(len(rows), -1).amax(-1)  # (B,): no matrix's 1-norm is larger
    halvings = torch.where(largest > 0.5, (2 * largest).log2().ceil(), 0.0).clamp(max=_HALVINGS).to(rows)
    small = rows * (-halvings).exp2().reshape(-1, *[1] * (rows.dim() - 1))
    one = torch.eye(size, dtype=rows.dtype, device=rows.device).expand(rows.shape).clone()

    def term(total: Tensor, share: Tensor) -> tuple[Tensor, tuple[()]]:
        return one + share * (small @ total), ()

    shares = 1 / torch.arange(_TERMS, 0, -1, dtype=rows.dtype, device=rows.device)
    series: Tensor = scan(term, one, shares, dim=0)[0]

    def squared(now: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        power, left = now
        return power @ power, left - 1

    found: Tensor = repeat(_HALVINGS, squared, (series, halvings), where=lambda now: now[1] > 0)[0]
    return found.reshape(matrix.shape)
