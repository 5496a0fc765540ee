"""Matern kernels of half-integer smoothness."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..numerics.checks import choice
from .radial import RadialKernel

# phi(t) = p(t) e^{-t} with t = sqrt(2 smoothness) |y - c| / length_scale; p by its coefficients.
_POLYNOMIALS = {0.5: (1.0,), 1.5: (1.0, 1.0), 2.5: (1.0, 1.0, 1.0 / 3.0)}
_TERMS = 16
_SERIES_BELOW = 0.5  # the first neglected term is 0.5^16 / 16! = 7e-19


class MaternKernel(RadialKernel):
    """Matern kernel: with t = sqrt(2 smoothness) |y - c| / length_scale,

        smoothness 1/2: e^{-t};   3/2: (1 + t) e^{-t};   5/2: (1 + t + t^2/3) e^{-t}.

    k(., c) is in C^{2 smoothness - 1}: at y = c the kernel of smoothness 1/2 has no gradient (zero is
    returned, the mean of its directional derivatives) and no Hessian.

    Example:
        >>> k = MaternKernel(smoothness=1.5)
        >>> k(torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double())
        tensor([[0.4834, 0.4834]], dtype=torch.float64)

        Shown by `staf kernel=matern`.

    Args:
        smoothness: 0.5, 1.5 or 2.5.
        length_scale: positive, in the units of the state.

    Raises:
        ValueError: for another smoothness, or a length scale that is not positive and finite.
    """

    told = ()  # the smoothness decides which polynomial

    def __init__(self, smoothness: float = 2.5, length_scale: float | Tensor = 1.0) -> None:
        super().__init__(length_scale)
        choice("MaternKernel", "smoothness", smoothness, tuple(_POLYNOMIALS))
        self.smoothness = float(smoothness)

    def profile(self, s: Tensor) -> Tensor:
        return _profile(self.smoothness, s * (2 * self.smoothness))

    def slope(self, s: Tensor) -> Tensor:
        t2 = s * (2 * self.smoothness)
        if self.smoothness == 0.5:  # -e^{-t} / 2t, and zero at t = 0
            positive = t2 > 0
            t = torch.where(positive, t2, 1.0).sqrt()
            return torch.where(positive, (-t).exp() / (-2 * t), 0.0)
        # The profile of the next lower smoothness, -(1 + t) e^{-t} 5/6 or -e^{-t} 3/2.
        factor = -5 / 6 if self.smoothness == 2.5 else -1.5
        return factor * _profile(self.smoothness - 1, t2)

    def extra_repr(self) -> str:
        return f"smoothness={self.smoothness}, {super().extra_repr()}"


def _profile(smoothness: float, t2: Tensor) -> Tensor:
    """p(t) e^{-t} of t^2."""
    series = _SERIES[smoothness]
    near = t2 < _SERIES_BELOW**2
    # Each branch sees only arguments at which it is differentiable, so that no 0 * inf reaches
    # a gradient: phi is smooth in t^2 but for odd powers of t, and those vanish at t = 0.
    positive = t2 > 0
    root = torch.where(positive, torch.where(positive, t2, 1.0).sqrt(), 0.0)
    small = torch.where(near, t2, 0.0)
    even = _horner(series[0::2], small)
    odd = _horner(series[1::2], small)
    t = torch.where(near, 1.0, root)
    far = _horner(_POLYNOMIALS[smoothness], t) * (-t).exp()
    return torch.where(near, even + root * odd, far)


def _taylor(smoothness: float) -> tuple[float, ...]:
    """Taylor coefficients of p(t) e^{-t}."""
    decay = [(-1.0) ** k / math.factorial(k) for k in range(_TERMS)]
    poly = _POLYNOMIALS[smoothness]
    coefficients = [math.fsum(p * decay[k - i] for i, p in enumerate(poly) if i <= k) for k in range(_TERMS)]
    # p is the [i/0] Pade numerator of e^t, so the first odd coefficients vanish exactly.
    return tuple(0.0 if k % 2 and k < 2 * smoothness else c for k, c in enumerate(coefficients))


def _horner(coefficients: tuple[float, ...], t: Tensor) -> Tensor:
    total = torch.full_like(t, coefficients[-1])
    for c in reversed(coefficients[:-1]):
        total = total * t + c
    return total


_SERIES = {smoothness: _taylor(smoothness) for smoothness in _POLYNOMIALS}
