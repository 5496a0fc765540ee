"""A regressor for streams, with the conventions of scikit-learn."""

from __future__ import annotations

import copy
import inspect
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._checks import choice, fail, integer, positive_real, real
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
from .filter import Ahead, LocalFilter, StreamState
from .frame import LocalFrame

KERNELS: dict[str, type[Kernel]] = {
    "exponential": ExponentialKernel,
    "gaussian": GaussianKernel,
    "inverse_multiquadric": InverseMultiquadricKernel,
    "matern": MaternKernel,
    "polynomial": PolynomialKernel,
    "rational_quadratic": RationalQuadraticKernel,
}
"""Kernels by name, with the defaults of their constructors."""

_RINGS = (3, 6, 10, 15, 21, 28)
_NAME = "StaFRegressor"
_PLAIN = 64  # rounding errors of the covariance: less noise than that would leave no digit of it


class StaFRegressor:
    """Online regression on streams whose inputs move: constant memory and constant time a sample.

    y_k = V_k(x_k) + e_k is filtered by a Kalman filter of V's values at M centers around the latest x, V
    being a Gaussian process with the kernel as covariance. When x moves on, the centers follow: the posterior
    at the old centers predicts the values at the new ones, and what it cannot say there is uncertain again.
    The memory is M (M + 1) numbers a stream, whatever its length. No stream influences another.

    Example:
        >>> model = StaFRegressor(GaussianKernel(0.8), radius=0.3, count=6)
        >>> for t in range(100):
        ...     x = torch.stack((torch.tensor(0.05 * t).cos(), torch.tensor(0.05 * t).sin())).double()
        ...     _ = model.partial_fit(x, x[0] * x[1])
        >>> model.predict(x).shape
        torch.Size([])

    Args:
        kernel: a `Kernel`, or the name of one in `KERNELS`.
        radius: of the centers around the latest x, positive, in the units of x; about the distance over
            which V looks quadratic, half a kernel's width or so.
        count: M, centers; None takes C(n + 2, 2), enough for quadratics.
        noise: standard deviation of e, in the units of y. At least `sqrt(64 eps)` of the amplitude.
        amplitude: standard deviation of V before any sample, in the units of y. Predictions depend on
            noise / amplitude alone.
        forgetting: in (0, 1]: the share of what was learned that is still believed one sample later.
        follow: the centers stay until x has moved by follow * radius, not negative: by default until it
            leaves their ball.

    Attributes:
        n_features_in_: n, from the first sample on.
        n_streams_: S, or None for a single stream without batch dimension.
        centers_offsets_: d, (M, n).
        n_samples_seen_: samples that each stream has learned from, () or (S,).
        n_skipped_: samples that were skipped because they were not finite, () or (S,).

    Source: Rosenfeld et al., section 2, for the centers; Kalman (1960) and, for the exactness of a Gaussian
    process given its values at inducing points, Snelson and Ghahramani (2006).
    """

    _ahead_: Ahead | None  # the last prediction, until a sample is learned

    def __init__(
        self,
        kernel: Kernel | str = "gaussian",
        radius: float = 0.5,
        count: int | None = None,
        *,
        noise: float = 1e-2,
        amplitude: float = 1.0,
        forgetting: float = 0.999,
        follow: float = 1.0,
    ) -> None:
        self.kernel = kernel
        self.radius = radius
        self.count = count
        self.noise = noise
        self.amplitude = amplitude
        self.forgetting = forgetting
        self.follow = follow

    @classmethod
    def _parameters(cls) -> list[str]:
        return [name for name in inspect.signature(cls.__init__).parameters if name != "self"]

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """The arguments of the constructor, by name."""
        return {name: getattr(self, name) for name in self._parameters()}

    def set_params(self, **params: Any) -> StaFRegressor:
        """Set arguments of the constructor; they hold from the next `reset` or `fit` on.

        Raises:
            ValueError: for a name that is none.
        """
        for name, value in params.items():
            choice(f"{_NAME}.set_params", "params", name, self._parameters())
            setattr(self, name, value)
        return self

    def __repr__(self) -> str:
        arguments = ", ".join(f"{name}={value!r}" for name, value in self.get_params().items())
        return f"{_NAME}({arguments})"

    def reset(self) -> StaFRegressor:
        """Forget everything, dimension and streams included."""
        for name in [name for name in vars(self) if name.endswith("_")]:
            delattr(self, name)
        return self

    def fit(self, x: Any, y: Any) -> StaFRegressor:
        """Start afresh and learn from samples in the order of time: (T, n), (T,), or (T, S, n), (T, S)."""
        states, values = _tensor("fit", "x", x), _tensor("fit", "y", y)
        if states.dim() not in (2, 3) or values.shape != states.shape[:-1]:
            raise _shape("fit", "x", "(T, n) or (T, S, n), and y the same without n", states, values)
        self.reset()
        for state, value in zip(states, values, strict=True):
            self.partial_fit(state, value)
        return self

    def partial_fit(self, x: Any, y: Any) -> StaFRegressor:
        """Learn from one sample a stream; a prediction just before, at the same x, is work that is shared.

        Args:
            x: (n,) for a single stream, (S, n) for S streams side by side; tensors or arrays.
            y: () or (S,). A stream whose x or y is not finite skips it, which `n_skipped_` counts.

        Raises:
            ValueError: if a shape is another one than at the first sample, or, at the first sample, an
                argument of the constructor breaks its rule.
        """
        states, values = _tensor("partial_fit", "x", x), _tensor("partial_fit", "y", y)
        if states.dim() not in (1, 2) or values.shape != states.shape[:-1]:
            raise _shape("partial_fit", "x", "(n,) or (S, n), and y the same without n", states, values)
        if not self._is_fitted():
            self._prepare(states)
        self._check_streams("partial_fit", states)
        rows, ahead = self._rows(states), self._ahead_
        if ahead is not None and not torch.equal(rows, ahead.x):  # values: a tensor can change in place
            ahead = None
        self._ahead_ = None
        self._filter_.learn(self._state_, rows, self._units(values), ahead)
        return self

    def predict(self, x: Any, return_std: bool = False) -> Any:
        """V at x, before the sample there is learned.

        Args:
            x: (n,) or (S, n), one point a stream, or (P, n) and (S, P, n) for P points of each.
            return_std: whether to return the standard deviation of V, without noise, as well.

        Returns:
            (...,), or a pair of them; an array where x is one, else a tensor.

        Raises:
            ValueError: before the first sample, or for another number of streams or dimensions.
        """
        if not self._is_fitted():
            raise ValueError(f"`{_NAME}.predict` needs a first sample: call `partial_fit`.")
        points = _tensor("predict", "x", x)
        own = 1 if self.n_streams_ is None else 2
        several = points.dim() == own + 1
        self._check_streams("predict", points.select(-2, 0) if several else points)
        at = points.unbind(-2) if several else (points,)
        ahead = [self._filter_.ahead(self._state_, self._rows(point)) for point in at]
        if not several:
            self._ahead_ = ahead[0]
        mean = self._joined(points, [self._filter_.mean(a) for a in ahead])
        if not return_std:
            return _like(x, mean)
        variances = [self._filter_.variance(self._state_, a).sqrt() for a in ahead]
        return _like(x, mean), _like(x, self._joined(points, variances))

    def _rows(self, x: Tensor) -> Tensor:
        """(n,) or (S, n) -> (n, S), a copy."""
        like = self._state_.table
        rows = like.new_empty(x.shape[-1], like.shape[1])
        return rows.copy_(x.mT if x.dim() == 2 else x.unsqueeze(-1))

    def _joined(self, points: Tensor, found: list[Tensor]) -> Tensor:
        """One (S,) a point, in units of the process, as the points (..., n) are and in units of y: (...)."""
        values = found[0] if len(found) == 1 else torch.stack(found, dim=-1)
        return (values * self.amplitude_).reshape(points.shape[:-1])

    @property
    def n_samples_seen_(self) -> Tensor:
        return self._counted(self._state_.samples)

    @property
    def n_skipped_(self) -> Tensor:
        return self._counted(self._state_.skipped)

    def _counted(self, count: Tensor) -> Tensor:
        return count.squeeze(0) if self.n_streams_ is None else count

    def _is_fitted(self) -> bool:
        return hasattr(self, "_state_")

    def _units(self, values: Tensor) -> Tensor:
        return values.reshape(-1).to(self._state_.table) / self.amplitude_

    def _prepare(self, x: Tensor) -> None:
        """Infer the dimension from the first sample, (n,) or (S, n), and check the arguments."""
        dim, precision = x.shape[-1], torch.finfo(x.dtype).eps
        radius = positive_real(_NAME, "radius", self.radius)
        count = math.comb(dim + 2, 2) if self.count is None else self.count
        directions = _directions(integer(_NAME, "count", count, least=1), dim)
        noise = positive_real(_NAME, "noise", self.noise)
        amplitude = positive_real(_NAME, "amplitude", self.amplitude)
        ratio = (noise / amplitude) ** 2
        if ratio < _PLAIN * precision:
            rule = f"must be at least {math.sqrt(_PLAIN * precision):.1e} amplitude in {x.dtype}"
            raise fail(_NAME, "noise", rule, self.noise)
        forgetting, follow = real(_NAME, "forgetting", self.forgetting), real(_NAME, "follow", self.follow)
        if not 0 < forgetting <= 1:
            raise fail(_NAME, "forgetting", "must be in (0, 1]", self.forgetting)
        if follow < 0:
            raise fail(_NAME, "follow", "must not be negative", self.follow)
        offsets = radius * directions.to(x.device)
        kernel = _kernel(self.kernel).to(x.device)
        if kernel.core(torch.zeros_like(offsets[0]), offsets, offsets).dim() != 2:
            raise fail(_NAME, "kernel", "must have one value a hyperparameter for all streams", self.kernel)
        frame = LocalFrame.of(kernel, offsets)
        rows = x.reshape(-1, dim).mT
        self.n_features_in_ = dim
        self.n_streams_ = None if x.dim() == 1 else x.shape[0]
        self.centers_offsets_ = offsets
        self.amplitude_ = amplitude
        self._filter_ = LocalFilter(frame, ratio, forgetting, follow * radius)
        self._state_ = StreamState.at(rows.contiguous(), len(offsets))
        self._ahead_ = None

    def _check_streams(self, call: str, x: Tensor) -> None:
        expected = (
            (self.n_features_in_,) if self.n_streams_ is None else (self.n_streams_, self.n_features_in_)
        )
        if tuple(x.shape) != expected:
            raise ValueError(
                f"`{_NAME}.{call}(x=...)` must have the shape {expected} of the first sample; "
                f"got the shape {tuple(x.shape)}."
            )


def _kernel(stated: Kernel | str) -> Kernel:
    if isinstance(stated, Kernel):
        return copy.deepcopy(stated).double().requires_grad_(False)
    chosen = choice(_NAME, "kernel", stated, tuple(KERNELS))
    return KERNELS[str(chosen)]()


def _directions(count: int, dim: int) -> Tensor:
    return rings(count) if dim == 2 and count in _RINGS else ball(count, dim)


def _tensor(call: str, name: str, value: Any) -> Tensor:
    """Tensors as they are, arrays and numbers as tensors; integers as float64."""
    try:
        found = value if isinstance(value, Tensor) else torch.as_tensor(np.asarray(value))
    except (TypeError, ValueError, RuntimeError) as error:
        raise fail(f"{_NAME}.{call}", name, "must be a tensor or an array of numbers", value) from error
    return found.detach() if found.is_floating_point() else found.double()


def _like(x: Any, found: Tensor) -> Any:
    return found if isinstance(x, Tensor) else found.numpy()


def _shape(call: str, name: str, rule: str, x: Tensor, y: Tensor) -> ValueError:
    return ValueError(
        f"`{_NAME}.{call}({name}=...)` must have the shape {rule}; got {tuple(x.shape)} and {tuple(y.shape)}."
    )
