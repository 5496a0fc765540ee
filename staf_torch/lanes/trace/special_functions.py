"""Functions that neither a processor nor the C library has, in terms of simpler torch operations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .tracer import NotLoweredError

_WINITZKI = 0.147  # of a formula for erfinv with a relative error of 2e-3


def erfinv(y: Tensor) -> Tensor:
    """x with erf(x) = y, by a closed formula (S. Winitzki, 2008) and two steps of Halley's method."""
    tail = torch.log1p(-y * y)
    middle = 2 / (math.pi * _WINITZKI) + 0.5 * tail
    root = (middle * middle - tail / _WINITZKI).sqrt()
    apart = torch.where(middle > 0, -tail / _WINITZKI / (root + middle), root - middle)  # nothing cancels
    x = apart.sqrt().copysign(y)
    for _ in range(2):
        short = (torch.erf(x) - y) * (0.5 * math.sqrt(math.pi)) * (x * x).exp()
        x = x - short / (1 + x * short)
    return torch.where(y.abs() < 1, x, y / (1 - y * y).sqrt())


def digamma(x: Tensor) -> Tensor:
    """The slope of lgamma, as torch computes it: ten steps up, then a series in 1 / x^2 (Cephes)."""
    left = x < 0
    up = torch.where(left, 1 - x, x)
    total = torch.zeros_like(x)
    for _ in range(10):
        total = torch.where(up < 10, total - 1 / up, total)
        up = torch.where(up < 10, up + 1, up)
    square, series = 1 / (up * up), torch.zeros_like(x)
    for factor in _OF_DIGAMMA:
        series = series * square + factor
    found = up.log() - 0.5 / up - square * series + total
    turned = found - math.pi / (math.pi * torch.fmod(x, 1.0)).tan()
    found = torch.where(left, torch.where(x == x.trunc(), torch.nan, turned), found)
    return torch.where(x == 0, torch.copysign(torch.full_like(x, torch.inf), -x), found)


_OF_DIGAMMA = (1 / 12, -691 / 32760, 1 / 132, -1 / 240, 1 / 252, -1 / 120, 1 / 12)


def polygamma(n: int, x: Tensor) -> Tensor:
    """The slope of digamma, n = 1, as torch computes it: six steps up, then a series in 1 / x^2."""
    if n == 0:
        return digamma(x)
    if n != 1:
        raise NotLoweredError(f"`polygamma({n}, x)` cannot be compiled, only that of 0 and 1")
    left = x < 0.5
    up, total = torch.where(left, 1 - x, x), torch.zeros_like(x)
    for _ in range(6):
        total, up = total + 1 / (up * up), up + 1
    square = 1 / (up * up)
    total = total + (1 + 0.5 / up + square * (1 / 6 - square * (1 / 30 - square / 42))) / up
    turned = math.pi / (math.pi * x).sin()
    return torch.where(left, turned * turned - total, total)
