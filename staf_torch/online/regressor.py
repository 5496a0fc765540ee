"""The State Following filter as a regressor for streams, with the conventions of scikit-learn."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from ..centers import ball, rings
from ..centers.layouts import RING_COUNTS
from ..kernels import NAMED, GaussianKernel, Kernel
from ..lanes.gradients import refuse_gradient
from ..lanes.row_numbers import RowNumbers
from ..numerics.angles import turned
from ..numerics.checks import choice, fail, flag, integer, positive_real, trailing
from ..numerics.default_device import device_of, on
from ..signs import Sign
from .compiled_filter import Forecast, forecasts, log_density
from .estimator import StreamEstimator
from .filter_streams import FilterStreams
from .kalman_filter import LocalFilter, smooth_record
from .local_functions import NAMES, LocalFunctions, OwnFunctions, has_rows, own_functions, own_law
from .samples import lapses, like_given, pair, single, tensor_of
from .stream_state import StreamState
from .tuning import CENTERS, Tuning, tuned_streams, tuning

_log = logging.getLogger(__name__)
_NAME = "StaFRegressor"
_EXPLAINED = 0.5  # of the variance: a ball of 2.3 widths of the Gaussian kernel


class StaFRegressor(StreamEstimator):
    """Online regression on streams whose inputs move: constant memory and constant time a sample.

    y_k = V_k(x_k) + e_k by a Kalman filter of V's values at M centers around the latest x, V being a Gaussian
    process with the kernel as covariance. When x moves on, the centers follow: the posterior at the old
    centers predicts the values at the new ones, and what it cannot say there is uncertain again. M (M + K)
    numbers a stream, about a microsecond a sample, for thousands of streams. The best prediction of some
    streams is that of `MixtureRegressor`, which has nothing to tune.

    No stream influences another. A coordinate of x that is NaN was not measured and is held; a target that is
    NaN is not learned. Any finite number is survived: a stream that jumps starts afresh there.

    Example:
        >>> model = StaFRegressor(GaussianKernel(0.8), radius=0.3, count=6)
        >>> for t in range(100):
        ...     x = torch.stack((torch.tensor(0.05 * t).cos(), torch.tensor(0.05 * t).sin())).double()
        ...     _ = model.partial_fit(x, x[0] * x[1])
        >>> model.predict(x).shape
        torch.Size([])

        Shown by `staf_torch/guides/stream_with_bands.md`.

    Args:
        kernel: a `Kernel`, or the name of one in `kernels.NAMED`.
        radius: of the centers around the latest x, positive, in the units of x; about the distance over
            which V looks quadratic, half a kernel's width or so. One so large that the centers explain less
            than half of the variance between them is logged.
        count: M, centers; None takes C(n + 2, 2), enough for quadratics.
        centers: directions (M, n) in the closed unit ball in place of ``count``, such as
            ``torch.cat((cross_polytope(n), torch.zeros(1, n)))``.
        noise: standard deviation of e, in the units of y. At least `sqrt(64 eps)` of the amplitude.
        amplitude: standard deviation of V before any sample, in the units of y. Predictions depend on
            noise / amplitude alone.
        forgetting: in (0, 1]: the share of what was learned that is still believed one unit of time later.
        follow: the centers stay until x has moved by follow * radius, not negative: by default until it
            leaves their ball.
        periodic: coordinates of x that are angles in rad: a sample is turned by whole turns to within pi of
            the latest of its stream. `MixtureRegressor` has none: give it sine and cosine.
        robust: standard deviations beyond which an error counts no more than there (Huber); None for any.
            Numbers of the kernel, ``radius``, ``noise``, ``amplitude``, ``forgetting``, ``follow`` and
            ``robust`` may be one a stream, by `staf_torch.rows`, of a Gaussian kernel.
        scaling: whether x and y are brought to mean 0 and variance 1, learned from the first 40 samples. Then
            radius, noise and amplitude are in these units.

    Attributes:
        n_features_in_: n, from the first sample on.
        n_streams_: S, or None for a single stream without batch dimension.
        n_outputs_: K, or None for y without a dimension of its own.
        centers_offsets_: d, (M, n).
        n_samples_seen_: samples that each stream has learned from, () or (S,).
        n_skipped_: samples that were not learned, () or (S,): without a target, with all of x NaN or a
            coordinate that was never measured, not finite, or out of proportion.

    Source: Rosenfeld et al., section 2, for the centers; Kalman (1960) and, for the exactness of a Gaussian
    process given its values at inducing points, Snelson and Ghahramani (2006).
    """

    centers_offsets_: Tensor
    _tuning: Tuning | None = None

    def __init__(
        self,
        kernel: Kernel | str = "gaussian",
        radius: float | Tensor = 0.5,
        count: int | None = None,
        *,
        centers: Any = None,
        noise: float | Tensor = 1e-2,
        amplitude: float | Tensor = 1.0,
        forgetting: float | Tensor = 0.999,
        follow: float | Tensor = 1.0,
        periodic: Sequence[int] = (),
        robust: float | Tensor | None = None,
        scaling: bool = False,
    ) -> None:
        super().__init__()
        self.kernel = kernel
        self.radius = radius
        self.count = count
        self.centers = centers
        self.noise = noise
        self.amplitude = amplitude
        self.forgetting = forgetting
        self.follow = follow
        self.periodic = periodic
        self.robust = robust
        self.scaling = scaling

    @property
    def tuning(self) -> Tuning | None:
        """Return the hyperparameters that `tune` found, a table when printed; None before."""
        return self._tuning

    @Sign("StaFRegressor.tune")
    def tune(self, x: Any, y: Any, method: str = "search") -> Self:
        """Learn the hyperparameters from a stretch, stream by stream, and hold them from now on.

        Width (a coordinate each), noise, forgetting and radius, Gaussian kernel, by the one-step predictive
        likelihood: all candidates are streams of one tensor batch. They take the place of ``kernel``,
        ``radius``, ``noise``, ``amplitude``, ``forgetting`` and ``scaling`` for as many streams, coordinates
        and outputs; others are refused. The radius is one for all streams, that of the first. The stretch is
        not learned: `fit` or `partial_fit` come after it. What was learned before is forgotten, and that is
        logged. `print(model.tuning)` shows what was tried and chosen. A coordinate that hardly moves in the
        stretch gets the width of the others; one that covers little of its width is logged.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams; some hundred samples.
            y: x's shape without n, or with K in place of n for K outputs.
            method: from the best of a grid, ``search`` draws candidates around it; ``gradient`` goes up the
                likelihood, by a program that takes seconds to compile for every n, count and K, once. It
                finds more likely hyperparameters and takes longer from three coordinates on.

        Raises:
            ValueError: if a shape is another one, or the method; `gradient` serves up to 15 centers.
        """
        choice(f"{_NAME}.tune", "method", method, ("search", "gradient"))
        states, values = pair(f"{_NAME}.tune", x, y, (2, 3))
        trailing(f"{_NAME}.tune", "x", states, 2, meta=False)
        states = self._turned(states)
        targets = values if values.dim() == states.dim() else values.unsqueeze(-1)
        rows = [part.unsqueeze(1) if states.dim() == 2 else part for part in (states, targets)]
        with on(states.device):
            directions = self._directions(states.shape[-1], states.device)
            if method == "gradient" and len(directions) > CENTERS:
                rule = f"must be 'search' for more than {CENTERS} centers, of which {states.shape[-1]} "
                rule += (
                    f"coordinates take {len(directions)}: a compiler takes minutes for the stretch's program"
                )
                raise fail(f"{_NAME}.tune", "method", rule, method)
            found = tuning(rows[0], rows[1], directions, method)
        self._change(self._hold, found)
        return self

    def _hold(self, found: Tuning) -> None:
        if self.__sklearn_is_fitted__():
            _log.warning(
                "`StaFRegressor.tune` forgets what was learned before, up to %d samples a stream: call `fit` "
                "or `partial_fit` from the first sample on",
                int(self._streams_.learned.max()),
            )
        self._reset()
        self._tuning = found

    @Sign("StaFRegressor.smooth")
    def smooth(self, x: Any, y: Any, time: Any = None) -> tuple[Any, Any]:
        """Estimate V at recorded states from the samples before and after each: the filter and back again.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams.
            y: x's shape without n, or with K in place of n for K outputs.
            time: as in `fit`.

        Returns:
            Mean and standard deviation (without noise) of V in the shape of y. What this regressor has
            learned stays as it is.
        """
        states, values = pair(f"{_NAME}.smooth", x, y, (2, 3))
        states = self._turned(states)
        steps, streams = lapses(f"{_NAME}.smooth", time, states), self._fresh_streams(states[0], values[0])
        rows = (len(states), streams.count, -1)
        whole = states.new_ones(rows[:2], dtype=torch.float64) if steps is None else steps.expand(rows[:2])
        both = torch.cat((states.double().reshape(rows), values.double().reshape(rows)), -1)
        n, (center, spread) = states.shape[-1], streams.units_for(both)
        units = (both - center) / spread
        with on(states.device):
            mean, deviation = smooth_record(
                streams.definition, streams.state, units[..., :n], units[..., n:], whole
            )
        found = mean * spread[:, n:] + center[:, n:], deviation * spread[:, n:]
        return like_given(y, found[0].reshape(values.shape)), like_given(y, found[1].reshape(values.shape))

    @Sign("StaFRegressor.forecast")
    def forecast(self, x: Any, y: Any, time: Any = None) -> Forecast:
        """Predict every sample of a stretch from those before it, with gradients by all that it depends on.

        p(y_k | y_0, ..., y_k-1) = N(mean_k, deviation_k^2), as `predict` before each `partial_fit`, by a
        filter that begins anew. x, y, a kernel's parameters, ``radius``, ``noise``, ``amplitude``,
        ``forgetting`` and ``robust`` that require a gradient get it, as tensors or as `staf_torch.rows`, a
        number a stream: the sum of ``log_density`` is the likelihood of the stretch. Of a Gaussian kernel it
        is compiled, forwards and backwards; other kernels run in plain torch.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams.
            y: x's shape without n, or with K in place of n for K outputs.
            time: as in `fit`: a sample is expected as late as it comes.

        Returns:
            Mean and standard deviation in the shape of y, noise included, and log p, (T,) or (T, S), 0 where
            y was not measured. With ``scaling`` the units are those of the whole stretch. What this regressor
            has learned stays as it is.

        Raises:
            ValueError: if a shape is another one, or an argument of the constructor breaks its rule.

        Source: Kalman (1960); Rasmussen and Williams, Gaussian Processes for Machine Learning, section 2.3,
        for hyperparameters by the likelihood.
        """
        call = f"{_NAME}.forecast"
        states, values = pair(call, x, y, (2, 3), recorded=True)
        states = self._turned(states)
        steps, n = lapses(call, time, states), states.shape[-1]
        at = states.double().reshape(len(states), -1, n)
        of = values.double().reshape(*at.shape[:2], -1)
        count, outputs = of.shape[1:]
        with torch.no_grad():
            streams = self._fresh_streams(states[0], values[0])
            center, spread = streams.units_for(torch.cat((at, of), -1))
        late = at.new_ones(at.shape[:2]) if steps is None else steps.expand(at.shape[:2])
        sides = [part.transpose(0, 1) for part in ((at - center[:, :n]) / spread[:, :n], late)]
        goal = ((of - center[:, n:]) / spread[:, n:]).transpose(0, 1)
        with on(states.device):
            filter_ = self._recorded_filter(count, outputs, at[0, 0])
            found = forecasts(filter_, sides[0], goal, sides[1])
        mean = found[0].transpose(0, 1) * spread[:, n:] + center[:, n:]
        deviation = found[1].transpose(0, 1) * spread[:, n:]
        likely = log_density(of, mean, deviation).sum(-1).reshape(states.shape[:-1])
        parts = mean.reshape(values.shape), deviation.reshape(values.shape), likely
        typed = [part.to(values.dtype) for part in parts]
        return Forecast(*(part if part.requires_grad else like_given(y, part) for part in typed))

    def _fresh_streams(self, x: Tensor, y: Tensor) -> FilterStreams:
        """Return streams that have learned nothing, for samples like these, which are not turned."""
        twin = self._twin()
        twin._prepare(x, y)
        assert isinstance(twin._streams_, FilterStreams)
        return twin._streams_

    def _recorded_filter(self, streams: int, outputs: int, like: Tensor) -> LocalFilter:
        """Return the filter of tensors that autograd sees, for states like (n,)."""
        toward, found = self._directions(len(like), like.device), self._tuned(streams, outputs, like)
        robust = math.inf if self.robust is None else self.robust
        if found is not None:
            radius = found.radius[:1].expand(streams)
            tuned = own_functions(_NAME, GaussianKernel(1.0), radius, toward)
            slack = float(single(self.follow)) * radius
            return LocalFilter(tuned, found.ratio, found.forgetting, slack, robust)
        law = own_law(_NAME, {name: getattr(self, name) for name in NAMES}, torch.float64, streams, like)
        kernel = self.kernel if isinstance(self.kernel, Kernel) else _kernel(self.kernel)
        rate = kernel.exponent_rate()
        plain = kernel.state_free and rate is not None and kernel.log_gain(toward[:1]) is None
        functions: OwnFunctions | LocalFunctions
        if plain or isinstance(self.radius, RowNumbers):
            functions = own_functions(_NAME, kernel, law["radius"], toward)
        else:
            if like.device != device_of(kernel) and not any(p.requires_grad for p in kernel.parameters()):
                kernel = copy.deepcopy(kernel).to(like.device)
            functions = LocalFunctions.of(kernel, law["radius"][0] * toward)
        return _own_filter(law, functions)

    def _tuned(self, streams: int, outputs: int, like: Tensor) -> Tuning | None:
        """Return what `tune` found, for states like (n,) and where they are; None before. Refused for
        other streams."""
        if self._tuning is None:
            return None
        if self._tuning.sizes != (streams, len(like), outputs):
            was, now = (
                f"{s} stream(s) of {n} coordinate(s) and {k} output(s)"
                for s, n, k in (self._tuning.sizes, (streams, len(like), outputs))
            )
            rule = "call `tune` for these, or take a new regressor"
            raise ValueError(f"`{_NAME}` was tuned for {was}; got {now}: {rule}.")
        return Tuning(*(part.to(like.device) for part in self._tuning))

    def _angles(self, dim: int) -> tuple[int, ...]:
        """Return the checked periodic coordinates."""
        if not set(self.periodic) <= set(range(-dim, dim)):
            raise fail(_NAME, "periodic", f"must be coordinates of {dim}", list(self.periodic))
        return tuple(sorted({index % dim for index in self.periodic}))

    def _turned(self, x: Tensor) -> Tensor:
        """A record (T, ...) whose angles are turned sample by sample to the one measured before."""
        periodic = self._angles(x.shape[-1])
        if not periodic:
            return x
        rows, latest = [], x[0]
        for now in x:
            rows.append(torch.where(latest.isnan() | now.isnan(), now, turned(now, latest, periodic)))
            latest = torch.where(torch.isfinite(rows[-1]), rows[-1], latest)
        return torch.stack(rows)

    def _begin(self, streams: int, outputs: int, like: Tensor) -> FilterStreams:
        angles = self._angles(len(like))
        dim, dtype, toward = len(like), like.dtype, self._directions(len(like), like.device)
        scaling, found = flag(_NAME, "scaling", self.scaling), self._tuned(streams, outputs, like)
        kernel, numbers = _kernel(self.kernel), {name: getattr(self, name) for name in NAMES}
        refuse_gradient(_NAME, **numbers)
        if found is not None:
            robust = math.inf if self.robust is None else positive_real(_NAME, "robust", single(self.robust))
            self.centers_offsets_ = found.radius[0] * toward
            return tuned_streams(found, toward, dtype, robust, float(single(self.follow)), angles)
        rows, kernel = has_rows(numbers, kernel), kernel.to(like.device)
        count, where = (streams, like) if rows else (1, torch.empty(0, dtype=torch.float64, device="cpu"))
        law = own_law(_NAME, numbers, dtype, count, where)
        self.centers_offsets_ = offsets = law["radius"][:, None, None].to(toward) * toward
        if rows:
            filter_ = _own_filter(law, own_functions(_NAME, kernel, law["radius"], toward))
        else:
            self.centers_offsets_ = offsets = offsets[0]
            if kernel.core(torch.zeros_like(offsets[0]), offsets, offsets).dim() != 2:
                rule = "must have one value a hyperparameter for all streams"
                raise fail(_NAME, "kernel", rule, self.kernel)
            one = {name: float(value) for name, value in law.items()}
            functions, base = LocalFunctions.of(kernel, offsets), one["amplitude"] ** 2
            _check_reach(functions, one["radius"])
            ratio, forgetting = (
                like.new_full((streams,), value, dtype=torch.float64)
                for value in ((one["noise"] / one["amplitude"]) ** 2, one["forgetting"])
            )
            slack = one["follow"] * one["radius"]
            filter_ = LocalFilter(functions, ratio, forgetting, slack, one["robust"], base)
        state = StreamState.empty(like, streams, dim, len(toward), outputs)
        return FilterStreams(filter_, state, scaling, periodic=angles)

    def _directions(self, dim: int, where: torch.device) -> Tensor:
        """Return the centers' directions, (M, n), on a device."""
        if self.centers is None:
            count = math.comb(dim + 2, 2) if self.count is None else self.count
            count = integer(_NAME, "count", count, least=1)
            return (rings(count) if dim == 2 and count in RING_COUNTS else ball(count, dim)).to(where)
        found = tensor_of(_NAME, "centers", self.centers).double()
        fits = found.dim() == 2 and found.shape[1] == dim
        if not (fits and float(found.square().sum(1).amax()) <= 1 + 1e-9):
            rule = f"must be directions (M, {dim}) in the closed unit ball"
            raise fail(_NAME, "centers", rule, self.centers)
        return found.to(where)

    def _decisive(self) -> tuple[str, ...]:
        held = ("forgetting", "follow", "robust", "scaling")
        return ("kernel", "radius", "count", "noise", "amplitude", *held)

    def _resized(self, kept: Tensor | None = None) -> None:
        before = self.n_streams_ or 1
        super()._resized()
        if self._tuning is not None:
            new = self._streams_.count - before
            self._tuning = self._tuning.add(new) if kept is None else self._tuning.keep(kept)

    def _extra_state(self) -> dict[str, Any]:
        extra: dict[str, Any] = {} if self._tuning is None else {"tuning": self._tuning._asdict()}
        return extra | ({"periodic": [*self.periodic]} if len(self.periodic) else {})

    def _take_extra(self, state: dict[str, Any]) -> None:
        if [*state.get("periodic", ())] != [*self.periodic]:
            told = f"it has periodic={[*state.get('periodic', ())]}, this one {[*self.periodic]}"
            rule = "must be of a regressor with the same arguments"
            raise ValueError(f"`{_NAME}.load_state_dict(state=...)` {rule}: {told}.")
        found = state.get("tuning")
        if found is not None and set(found) != set(Tuning._fields):
            told = f"its 'tuning' has {[*found]}, not {[*Tuning._fields]}"
            raise ValueError(
                f"`{_NAME}.load_state_dict(state=...)` must be what `state_dict` returned; {told}."
            )
        self._tuning = None if found is None else Tuning(**found)


def _own_filter(law: dict[str, Tensor], functions: OwnFunctions | LocalFunctions) -> LocalFilter:
    """Return the filter of numbers as `own_law` returns them."""
    ratio, slack = (law["noise"] / law["amplitude"]).square(), (law["follow"] * law["radius"]).detach()
    base = law["amplitude"].square()
    return LocalFilter(functions, ratio, law["forgetting"], slack, law["robust"], base)


def _check_reach(functions: LocalFunctions, radius: float) -> None:
    """Raise where the kernel overflows within the ball, and log one that is narrow for it."""
    if functions.offsets.is_meta:
        return
    explained, kernel = functions.explained(), type(functions.kernel).__name__
    if math.isnan(explained) and functions.shared is not None:
        rule = f"must be so small that {kernel} does not overflow within the ball"
        raise fail(_NAME, "radius", rule, radius)
    if explained < _EXPLAINED:
        _log.warning(
            "`StaFRegressor(radius=%g)`: half way to a center the centers explain %.2g of the variance of "
            "what is learned (%s): estimates fall back to zero between them. Take a smaller radius, or a "
            "wider kernel",
            *(radius, explained, kernel),
        )


def _kernel(stated: Kernel | str) -> Kernel:
    if isinstance(stated, Kernel):
        refuse_gradient(_NAME, kernel=stated)
        return copy.deepcopy(stated).double().requires_grad_(False)
    return NAMED[str(choice(_NAME, "kernel", stated, tuple(NAMED)))]()
