"""The filter that a regressor's arguments describe."""

from __future__ import annotations

import copy
import logging
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..centers import ball, rings
from ..kernels import (
    ExponentialKernel,
    GaussianKernel,
    InverseMultiquadricKernel,
    Kernel,
    MaternKernel,
    PolynomialKernel,
    RationalQuadraticKernel,
)
from ..numerics.checks import choice, fail, integer, positive_real, real
from .filter_streams import FilterStreams
from .kalman_filter import LocalFilter, StreamState
from .local_functions import LocalFunctions
from .samples import tensor_of
from .tuning import Tuning, tuned_streams

KERNELS: dict[str, type[Kernel]] = {
    "exponential": ExponentialKernel,
    "gaussian": GaussianKernel,
    "inverse_multiquadric": InverseMultiquadricKernel,
    "matern": MaternKernel,
    "polynomial": PolynomialKernel,
    "rational_quadratic": RationalQuadraticKernel,
}
"""Kernels by name, with the defaults of their constructors."""


_log = logging.getLogger(__name__)
_NAME = "StaFRegressor"
_RINGS = (3, 6, 10, 15, 21, 28)
_EXPLAINED = 0.5  # of the variance: a ball of 2.3 widths of the Gaussian kernel
_PLAIN = 64  # rounding errors of the covariance: less noise than that would leave no digit of it


class Sizes(NamedTuple):
    """Of what is learned."""

    streams: int  # S
    dim: int  # n
    outputs: int  # K


def filter_streams(model: Any, sizes: Sizes, like: Tensor, scaling: bool) -> tuple[FilterStreams, Tensor]:
    """Streams of the filter that a regressor's arguments or its `tune` describe, and its offsets (M, n).

    Raises:
        ValueError: if an argument breaks its rule.
    """
    streams, dim, outputs = sizes
    dtype = like.dtype
    toward = directions(model, dim)
    found: Tuning | None = model._tuning
    if found is not None and found.center.shape == (streams, dim + outputs):
        robust = math.inf if model.robust is None else positive_real(_NAME, "robust", model.robust)
        return tuned_streams(found, toward, dtype, robust, float(model.follow)), found.radius[0] * toward
    precision = torch.finfo(dtype).eps
    radius = positive_real(_NAME, "radius", model.radius)
    noise = positive_real(_NAME, "noise", model.noise)
    amplitude = positive_real(_NAME, "amplitude", model.amplitude)
    ratio = (noise / amplitude) ** 2
    if ratio < _PLAIN * precision:
        rule = f"must be at least {math.sqrt(_PLAIN * precision):.1e} amplitude in {dtype}"
        raise fail(_NAME, "noise", rule, model.noise)
    forgetting, follow = real(_NAME, "forgetting", model.forgetting), real(_NAME, "follow", model.follow)
    if not 0 < forgetting <= 1:
        raise fail(_NAME, "forgetting", "must be in (0, 1]", model.forgetting)
    if follow < 0:
        raise fail(_NAME, "follow", "must not be negative", model.follow)
    robust = math.inf if model.robust is None else positive_real(_NAME, "robust", model.robust)
    offsets = radius * toward.to(like.device)
    kernel = _kernel(model.kernel).to(like.device)
    if kernel.core(torch.zeros_like(offsets[0]), offsets, offsets).dim() != 2:
        raise fail(_NAME, "kernel", "must have one value a hyperparameter for all streams", model.kernel)
    law = [
        torch.full((streams,), value, dtype=torch.float64, device=like.device)
        for value in (ratio, forgetting)
    ]
    functions = LocalFunctions.of(kernel, offsets)
    _check_reach(functions, radius)
    filter_ = LocalFilter(functions, law[0], law[1], follow * radius, robust, amplitude**2)
    state = StreamState.empty(like, streams, dim, len(offsets), outputs)
    return FilterStreams(filter_, state, scaling), offsets


def _check_reach(functions: LocalFunctions, radius: float) -> None:
    """Raise where the kernel overflows within the ball, and tell of one that is narrow for it."""
    explained = functions.explained()
    if math.isnan(explained) and functions.shared is not None:
        rule = f"must be so small that {type(functions.kernel).__name__} does not overflow within the ball"
        raise fail(_NAME, "radius", rule, radius)
    if explained < _EXPLAINED:
        _log.warning(
            "`StaFRegressor(radius=%g)`: half way to a center the centers explain %.2g of the variance of "
            "what is learned (%s): estimates fall back to zero between them. Take a smaller radius, or a "
            "wider kernel",
            *(radius, explained, type(functions.kernel).__name__),
        )


def directions(model: Any, dim: int) -> Tensor:
    if model.centers is None:
        count = math.comb(dim + 2, 2) if model.count is None else model.count
        count = integer(_NAME, "count", count, least=1)
        return rings(count) if dim == 2 and count in _RINGS else ball(count, dim)
    found = tensor_of(_NAME, "centers", model.centers).double()
    inside = found.dim() == 2 and found.shape[1] == dim and float(found.square().sum(1).amax()) <= 1 + 1e-9
    if not inside:
        raise fail(_NAME, "centers", f"must be directions (M, {dim}) in the closed unit ball", model.centers)
    return found


def _kernel(stated: Kernel | str) -> Kernel:
    if isinstance(stated, Kernel):
        return copy.deepcopy(stated).double().requires_grad_(False)
    chosen = choice(_NAME, "kernel", stated, tuple(KERNELS))
    return KERNELS[str(chosen)]()
