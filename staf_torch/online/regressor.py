"""A regressor for streams, with the conventions of scikit-learn."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor

from ..kernels import Kernel
from ..numerics.checks import fail, flag, integer, positive_real
from .bank import Bank
from .bank_rules import RECENT, BankShape
from .filter_arguments import KERNELS as KERNELS
from .filter_arguments import Sizes, directions, filter_streams
from .filter_streams import FilterStreams
from .samples import lapse_of, lapses, like_given, pair, tensor_of
from .smoothing import smooth_record
from .stream_estimator import StreamEstimator
from .tuning import tuning

_NAME = "StaFRegressor"


class StaFRegressor(StreamEstimator):
    """Online regression on streams whose inputs move: constant memory and constant time a sample.

    Without ``memory``, the filter: y_k = V_k(x_k) + e_k by a Kalman filter of V's values at M centers around
    the latest x, V being a Gaussian process with the kernel as covariance. When x moves on, the centers
    follow: the posterior at the old centers predicts the values at the new ones, and what it cannot say
    there is uncertain again. M (M + K) numbers a stream, about a microsecond a sample, for thousands of
    streams.

    With ``memory``, the accurate mode (`Bank`): so many samples are kept, the centers are taken from them
    where the state comes back, and local Gaussian processes, filters, quadratic models are mixed by how
    well they predict. Nothing needs to be tuned; about a tenth of a millisecond a sample. The filter's
    arguments, from ``kernel`` to ``follow``, are not used then.

    No stream influences another. A coordinate of x that is NaN was not measured and is held; a target that is
    NaN is not learned. Any finite number is survived: a stream that jumps starts afresh there.

    Example:
        >>> model = StaFRegressor(GaussianKernel(0.8), radius=0.3, count=6)
        >>> for t in range(100):
        ...     x = torch.stack((torch.tensor(0.05 * t).cos(), torch.tensor(0.05 * t).sin())).double()
        ...     _ = model.partial_fit(x, x[0] * x[1])
        >>> model.predict(x).shape
        torch.Size([])

        Shown by `tests/examples/notebooks/stream.py`.

    Args:
        kernel: a `Kernel`, or the name of one in `KERNELS`.
        radius: of the centers around the latest x, positive, in the units of x; about the distance over
            which V looks quadratic, half a kernel's width or so. The log tells of one so large that the
            centers explain less than half of the variance between them.
        count: M, centers; None takes C(n + 2, 2), enough for quadratics.
        centers: directions (M, n) in the closed unit ball in place of ``count``, such as
            ``torch.cat((cross_polytope(n), torch.zeros(1, n)))``.
        noise: standard deviation of e, in the units of y. At least `sqrt(64 eps)` of the amplitude.
        amplitude: standard deviation of V before any sample, in the units of y. Predictions depend on
            noise / amplitude alone.
        forgetting: in (0, 1]: the share of what was learned that is still believed one unit of time later.
        follow: the centers stay until x has moved by follow * radius, not negative: by default until it
            leaves their ball.
        robust: standard deviations beyond which an error counts no more than there (Huber); None for any. In
            the accurate mode a sample beyond waits for the next: both are learned if that is as far off, else
            the first is skipped; None takes 30, and 8 for an error of more than 12 spreads of y.
        scaling: whether x and y are brought to mean 0 and variance 1, learned from the first 40 samples, in
            the accurate mode again from 80, 160 and 320; None does so in that mode alone. Then radius,
            noise and amplitude are in these units.
        memory: samples kept, at least 128, for the accurate mode; None for the filter alone.
        neighbours: of them that make a local process, at least 8.

    Attributes:
        n_features_in_: n, from the first sample on.
        n_streams_: S, or None for a single stream without batch dimension.
        n_outputs_: K, or None for y without a dimension of its own.
        centers_offsets_: d, (M, n), of the filter.
        n_samples_seen_: samples that each stream has learned from, () or (S,).
        n_skipped_: samples that were not learned, () or (S,).

    Source: Rosenfeld et al., section 2, for the centers; Kalman (1960) and, for the exactness of a Gaussian
    process given its values at inducing points, Snelson and Ghahramani (2006).
    """

    centers_offsets_: Tensor

    def __init__(
        self,
        kernel: Kernel | str = "gaussian",
        radius: float = 0.5,
        count: int | None = None,
        *,
        centers: Any = None,
        noise: float = 1e-2,
        amplitude: float = 1.0,
        forgetting: float = 0.999,
        follow: float = 1.0,
        robust: float | None = None,
        scaling: bool | None = None,
        memory: int | None = None,
        neighbours: int = 56,
    ) -> None:
        self.kernel = kernel
        self.radius = radius
        self.count = count
        self.centers = centers
        self.noise = noise
        self.amplitude = amplitude
        self.forgetting = forgetting
        self.follow = follow
        self.robust = robust
        self.scaling = scaling
        self.memory = memory
        self.neighbours = neighbours

    def fit(self, x: Any, y: Any, time: Any = None) -> StaFRegressor:
        """Start afresh and learn from samples in the order of time.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams.
            y: x's shape without n, or with K in place of n for K outputs.
            time: of the samples, (T,) or (T, S), increasing; 0, 1, 2 ... by default.

        Raises:
            ValueError: if a shape is another one.
        """
        states, values = pair("fit", x, y, (2, 3))
        lapse = lapses(time, states)
        self.reset()
        for k, (state, value) in enumerate(zip(states, values, strict=True)):
            self._learn(state, value, None if lapse is None else lapse[k])
        return self

    def tune(self, x: Any, y: Any) -> StaFRegressor:
        """Learn the filter's hyperparameters from a stretch, stream by stream, and hold them from now on.

        Width (a coordinate each), noise, forgetting and radius, Gaussian kernel, by the one-step predictive
        likelihood: all candidates are streams of one tensor batch. They take the place of ``kernel``,
        ``radius``, ``noise``, ``amplitude``, ``forgetting`` and ``scaling`` wherever as many streams with as
        many outputs are learned; the radius is one for all streams, that of the first. What was learned
        before is forgotten. A coordinate that hardly moves in the stretch gets the width of the others;
        one that covers little of its width is logged. The accurate mode has nothing to tune, and stays.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams; some hundred samples.
            y: x's shape without n, or with K in place of n for K outputs.
        """
        states, values = pair("tune", x, y, (2, 3))
        self.reset()
        if self.memory is None:
            single = states.dim() == 2
            targets = values if values.dim() == states.dim() else values.unsqueeze(-1)
            both = [part.unsqueeze(1) if single else part for part in (states, targets)]
            self._tuning = tuning(both[0], both[1], directions(self, states.shape[-1]))
        return self

    def smooth(self, x: Any, y: Any, time: Any = None) -> tuple[Any, Any]:
        """V at recorded states from the samples before and after each, by the filter and back again.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams.
            y: x's shape without n, or with K in place of n for K outputs.
            time: as in `fit`.

        Returns:
            Mean and standard deviation (without noise) of V in the shape of y. What this regressor has
            learned stays as it is.
        """
        states, values = pair("smooth", x, y, (2, 3))
        if self.memory is not None:
            raise fail(
                _NAME, "memory", "must be None to smooth: the filter alone runs backwards", self.memory
            )
        steps, twin = lapses(time, states), copy.copy(self).reset()
        twin._prepare(states[0], values[0])
        streams = twin._streams_
        assert isinstance(streams, FilterStreams)
        rows = (len(states), streams.count, -1)
        whole = torch.ones(rows[:2], dtype=torch.float64) if steps is None else steps.expand(rows[:2])
        mean, std = smooth_record(
            streams, states.double().reshape(rows), values.double().reshape(rows), whole
        )
        return like_given(y, mean.reshape(values.shape)), like_given(y, std.reshape(values.shape))

    def partial_fit(self, x: Any, y: Any, lapse: Any = None) -> StaFRegressor:
        """Learn from one sample a stream.

        Args:
            x: (n,) for a single stream, (S, n) for S streams side by side; tensors or arrays.
            y: x's shape without n, or with K in place of n for K outputs.
            lapse: time since the call before, () or (S,), finite, not negative; 1 by default.

        Raises:
            ValueError: if a shape is another one than at the first sample, or, at the first sample, an
                argument of the constructor breaks its rule.
        """
        if lapse is None and self._is_plain(x) and self._is_plain(y, target=True):
            self._streams_.learn(x, y)  # what compiled code reads as it is: nothing to convert or check
            return self
        states, values = pair("partial_fit", x, y, (1, 2))
        steps = None if lapse is None else lapse_of(lapse, len(states) if states.dim() == 2 else 1)
        return self._learn(states, values, steps)

    def _learn(self, states: Tensor, values: Tensor, lapse: Tensor | None) -> StaFRegressor:
        if not self._is_fitted():
            self._prepare(states, values)
        streams = self._streams_
        if states.shape != self._shape_ or (values.dim() == states.dim()) != (self.n_outputs_ is not None):
            raise self._refusal("partial_fit", states, values)
        rows = states.to(streams.dtype).reshape(streams.count, self.n_features_in_).contiguous()
        targets = values.to(streams.dtype).reshape(streams.count, -1).contiguous()
        if targets.shape[1] != (self.n_outputs_ or 1):
            raise self._refusal("partial_fit", states, values)
        if lapse is not None:
            lapse = lapse.expand(streams.count).contiguous()
        streams.learn(rows, targets, lapse)
        return self

    def predict(self, x: Any, return_std: bool = False) -> Any:
        """The next y at x, before it is learned.

        Args:
            x: (n,) or (S, n), one point a stream, or (P, n) and (S, P, n) for P points of each.
            return_std: whether to return the standard deviation of the error to expect as well: noise
            included,
                and scaled by the running size of the errors so far.

        Returns:
            (...,), or (..., K) for K outputs, or a pair of them; an array where x is one, else a tensor.

        Raises:
            ValueError: before the first sample, or for another number of streams or dimensions.
        """
        if self._is_plain(x):
            mean, deviation = self._streams_.predict(x)
            mean = mean.view(self._targets_)
            return (mean, deviation.view(self._targets_)) if return_std else mean
        points = tensor_of(f"{_NAME}.predict", "x", x)
        own = 1 if self._fitted("predict").n_streams_ is None else 2
        several = points.dim() == own + 1
        shape_of_one = (*points.shape[:-2], points.shape[-1]) if several else tuple(points.shape)
        if shape_of_one != self._shape_:
            raise self._refusal("predict", points)
        streams = self._streams_
        shape = (streams.count, self.n_features_in_)
        at = [
            p.to(streams.dtype).reshape(shape).contiguous()
            for p in (points.unbind(-2) if several else (points,))
        ]
        found = [streams.predict(rows) for rows in at]
        ending = () if self.n_outputs_ is None else (self.n_outputs_,)

        def joined(which: int) -> Tensor:
            if not found:
                return points.new_empty(*points.shape[:-1], *ending)
            one = found[0][which] if not several else torch.stack([pair[which] for pair in found], dim=1)
            return one.reshape((*points.shape[:-1], *ending))

        mean = like_given(x, joined(0))
        return (mean, like_given(x, joined(1))) if return_std else mean

    def _is_plain(self, value: Any, target: bool = False) -> bool:
        """Whether compiled code can read a sample in place."""
        return (
            type(value) is Tensor
            and "_streams_" in self.__dict__
            and self._streams_.compiled
            and value.dtype is self._streams_.dtype
            and value.shape == (self._targets_ if target else self._shape_)
            and not value.requires_grad
            and value.is_contiguous()
        )

    def _decisive(self) -> tuple[str, ...]:
        """Arguments that what was learned depends on."""
        if self.memory is not None:
            return ("memory", "neighbours", "robust", "scaling")
        if self._tuning is not None:
            return ("memory", "count", "follow", "robust")
        known = ("radius", "count", "noise", "amplitude", "forgetting", "follow", "robust", "scaling")
        return ("memory", *known)

    def _prepare(self, x: Tensor, y: Tensor) -> None:
        """Infer the sizes from the first sample and check the arguments."""
        dim, dtype = x.shape[-1], x.dtype if x.dtype in (torch.float32, torch.float64) else torch.float64
        count = 1 if x.dim() == 1 else x.shape[0]
        outputs = y.shape[-1] if y.dim() == x.dim() else 1
        scaling = self.scaling if self.scaling is None else flag(_NAME, "scaling", self.scaling)
        if self.memory is not None:
            memory = integer(_NAME, "memory", self.memory, least=2 * RECENT)
            neighbours = integer(_NAME, "neighbours", self.neighbours, least=8)
            shape = BankShape(dim, outputs, memory, min(neighbours, memory))
            robust = None if self.robust is None else positive_real(_NAME, "robust", self.robust)
            self._streams_ = Bank(shape, count, scaling is not False, robust)
        else:
            like = torch.zeros(0, dtype=dtype, device=x.device)
            self._streams_, self.centers_offsets_ = filter_streams(
                self, Sizes(count, dim, outputs), like, bool(scaling)
            )
        self._shape_, self._targets_, self._dtype_ = tuple(x.shape), tuple(y.shape), dtype
        self.n_features_in_ = dim
        self.n_streams_ = None if x.dim() == 1 else count
        self.n_outputs_ = outputs if y.dim() == x.dim() else None

    def _refusal(self, call: str, x: Tensor, y: Tensor | None = None) -> ValueError:
        """The error of a sample whose shapes are not those of the first one."""
        outputs = () if self.n_outputs_ is None else (self.n_outputs_,)
        given = f"{tuple(x.shape)}" + ("" if y is None else f" and y's {tuple(y.shape)}")
        return ValueError(
            f"`{_NAME}.{call}(x=...)` must have the shape {self._shape_} of the first sample, with "
            f"{self.n_features_in_} features, and y {(*self._shape_[:-1], *outputs)}; "
            f"got the shape {given}: "
            f"X has {x.shape[-1]} features, but {_NAME} is expecting {self.n_features_in_} features "
            "as input."
        )
