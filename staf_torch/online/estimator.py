"""The base of regressors of streams: learning, predicting, saved states."""

from __future__ import annotations

import abc
import numbers
import sys
from collections.abc import Callable
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from ..kernels import Kernel
from ..lanes.calls.inputs import seen_by_others
from ..lanes.threads import ReadWriteLock
from ..lanes.torch_compile.operators import opaque
from ..numerics.checks import fail, integer, trailing
from ..numerics.default_device import beside, on
from ..signs import Sign
from .compiled_filter import DirectCalls
from .filter_streams import Streams
from .samples import in_place, lapse_of, lapses, like_given, pair, single, tensor_of
from .scikit_estimator import NotFittedError, ScikitEstimator, parameters, told_kernel

_ABOUT = ("n_features_in_", "n_streams_", "n_outputs_")
_DTYPES = {str(dtype): dtype for dtype in (torch.float32, torch.float64)}


class StreamEstimator(ScikitEstimator, abc.ABC):
    """Streams that learn and predict, whose sizes come with the first sample.

    Threads may share one: any number of them predict at once, a sample is learned while nobody does, and
    `fit` takes the place of what was learned when it has ended.
    """

    __slots__ = ("_lock",)  # no part of what a copy or scikit-learn sees of an estimator
    n_features_in_: int
    n_streams_: int | None
    n_outputs_: int | None
    _streams_: Streams
    _shape_: tuple[int, ...] = ()  # of a sample's x
    _targets_: tuple[int, ...] = ()  # of its y
    _dtype_: torch.dtype
    _device_: torch.device
    _in_place_: torch.dtype | None = None  # of samples that compiled code reads where they are
    _direct_: DirectCalls | None = None  # calls that need no lock

    def __init__(self) -> None:
        self._lock = ReadWriteLock()

    @abc.abstractmethod
    def _begin(self, streams: int, outputs: int, like: Tensor) -> Streams:
        """Check the arguments and return S new streams of K outputs, for states like (n,)."""

    @abc.abstractmethod
    def _decisive(self) -> tuple[str, ...]:
        """Return the names of the arguments that what was learned depends on, but for tensors."""

    @opaque
    def fit(self, x: Any, y: Any, time: Any = None) -> Self:
        """Start afresh and learn from samples in the order of time.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams.
            y: x's shape without n, or with K in place of n for K outputs.
            time: of the samples, (T,) or (T, S), increasing; 0, 1, 2 ... by default.

        Raises:
            ValueError: if a shape is another one.
        """
        states, values = pair(self._call("fit"), x, y, (2, 3))
        lapse, twin = lapses(self._call("fit"), time, states), self._twin()
        with Sign(self._call("fit"), len(states), "samples") as sign:
            count = 1 if states.is_meta else len(states)  # a sample has the shapes of all
            learned = twin._stretch(states, values, lapse)
            one_by_one = () if learned else zip(states[:count], values[:count], strict=True)
            for k, (state, value) in enumerate(one_by_one):
                if lapse is None:
                    twin.partial_fit(state, value)
                else:
                    twin._learn(state, value, lapse[k])
                sign.advance()
        self._change(self._take_over, twin)
        return self

    @beside
    def _stretch(self, states: Tensor, values: Tensor, lapse: Tensor | None) -> bool:
        """Begin with a stretch, and learn it in one call; False where samples are learned one by one."""
        self._prepare(states[0], values[0])
        streams, times = self._streams_, len(states)
        x, y = (
            self._placed("fit", name, part).reshape(times, streams.count, -1)
            for name, part in (("x", states), ("y", values))
        )
        steps = x.new_ones(times, 1, dtype=torch.float64) if lapse is None else lapse
        return streams.stretch(x, y, steps.expand(times, streams.count))

    def _twin(self) -> Self:
        """Return a regressor with the same arguments that has learned nothing."""
        twin = type(self)(**self.get_params(deep=False))
        twin._take_extra(self._extra_state())
        return twin

    def _take_over(self, twin: Self, state: dict[str, Any] | None = None) -> None:
        """Go on with what another regressor with these arguments has learned, or has from a saved state."""
        self._reset()
        if state is not None:
            self._take_extra(state)
        vars(self).update({name: value for name, value in vars(twin).items() if name.endswith("_")})
        self._direct_ = self._streams_.direct(self._shape_, self._targets_)  # after a state was loaded

    @opaque
    def partial_fit(self, x: Any, y: Any, lapse: Any = None) -> Self:
        """Learn from one sample a stream.

        Args:
            x: (n,) for a single stream, (S, n) for S streams side by side; tensors or arrays.
            y: x's shape without n, or with K in place of n for K outputs.
            lapse: time since the call before, () or (S,), finite, not negative; 1 by default.

        Raises:
            ValueError: if a shape is another one than at the first sample, or, at the first sample, an
                argument of the constructor breaks its rule.
        """
        direct = self._direct_
        if direct is None or lapse is not None or not direct.learn(x, y):
            self._change(self._partial_fit, x, y, lapse)
        return self

    def _partial_fit(self, x: Any, y: Any, lapse: Any) -> None:
        if (
            lapse is None
            and not seen_by_others()
            and in_place(x, self._in_place_, self._shape_)
            and in_place(y, self._in_place_, self._targets_)
        ):
            self._streams_.learn(x, y)  # what compiled code reads as it is: nothing to convert or check
            return
        call = self._call("partial_fit")
        states, values = pair(call, x, y, (1, 2))
        steps = None if lapse is None else lapse_of(call, lapse, len(states) if states.dim() == 2 else 1)
        self._learn(states, values, steps)

    def _learn(self, states: Tensor, values: Tensor, lapse: Tensor | None) -> None:
        if not self.__sklearn_is_fitted__():
            self._prepare(states, values)
        streams = self._streams_
        if states.shape != self._shape_ or (values.dim() == states.dim()) != (self.n_outputs_ is not None):
            raise self._refusal("partial_fit", states, values)
        rows = self._placed("partial_fit", "x", states).reshape(streams.count, -1).contiguous()
        targets = self._placed("partial_fit", "y", values).reshape(streams.count, -1).contiguous()
        if targets.shape[1] != (self.n_outputs_ or 1):
            raise self._refusal("partial_fit", states, values)
        times = None if lapse is None else lapse.to(rows.device).expand(streams.count).contiguous()
        with on(self._device_):
            streams.learn(rows, targets, times)

    @opaque
    def predict(self, x: Any, return_std: bool = False) -> Any:
        """Predict the next y at x, before it is learned.

        Args:
            x: (n,) or (S, n), one point a stream, or (P, n) and (S, P, n) for P points of each.
            return_std: whether to return the standard deviation of the error to expect as well: noise
                included, and scaled by the running size of the errors so far.

        Returns:
            (...,), or (..., K) for K outputs, or a pair of them; an array where x is one, else a tensor.

        Raises:
            ValueError: before the first sample, or for another number of streams or dimensions.
        """
        if (direct := self._direct_) is not None and (found := direct.predict(x)) is not None:
            return found if return_std else found[0]
        return self._lock.read(self._predict, x, return_std)

    def _change(self, function: Callable[..., object], *given: Any) -> None:
        """Call what changes the streams while nobody else has to do with them."""
        self._lock.write(self._changed, function, *given)

    def _changed(self, function: Callable[..., object], *given: Any) -> None:
        direct = self._direct_
        if direct is None:
            function(*given)
            return
        direct.filter.close(True)
        try:
            function(*given)
        finally:
            if self._direct_ is direct:  # else its streams are no longer these
                direct.filter.close(False)

    def _predict(self, x: Any, return_std: bool) -> Any:
        if not seen_by_others() and in_place(x, self._in_place_, self._shape_):
            mean, deviation = self._streams_.predict(x, self._targets_)
            return (mean, deviation) if return_std else mean
        points = trailing(self._call("predict"), "x", tensor_of(self._call("predict"), "x", x), 1)
        own = 1 if self._fitted("predict").n_streams_ is None else 2
        several = points.dim() == own + 1
        if ((*points.shape[:-2], points.shape[-1]) if several else tuple(points.shape)) != self._shape_:
            raise self._refusal("predict", points)
        streams, whole = self._streams_, points if several else points.unsqueeze(-2)
        real = points.dtype if points.dtype in _DTYPES.values() else streams.dtype  # the caller's
        rows = self._placed("predict", "x", whole).reshape(streams.count, whole.shape[-2], whole.shape[-1])
        with on(self._device_):
            found = [streams.predict(row.contiguous()) for row in rows.unbind(1)]
        shape = (*points.shape[:-1], *(() if self.n_outputs_ is None else (self.n_outputs_,)))

        def joined(which: int) -> Any:
            parts = [pair[which] for pair in found]
            whole = torch.stack(parts, 1).reshape(shape) if parts else points.new_empty(shape)
            return like_given(x, whole if whole.dtype == real else whole.to(real))

        return (joined(0), joined(1)) if return_std else joined(0)

    @beside
    def _prepare(self, x: Tensor, y: Tensor) -> None:
        """Infer the sizes from the first sample, check the arguments and begin the streams."""
        dtype = x.dtype if x.dtype in (torch.float32, torch.float64) else torch.float64
        count = 1 if x.dim() == 1 else x.shape[0]
        outputs = y.shape[-1] if y.dim() == x.dim() else 1
        self._streams_ = self._begin(count, outputs, torch.zeros(x.shape[-1], dtype=dtype, device=x.device))
        self._shape_, self._targets_ = tuple(x.shape), tuple(y.shape)
        self._dtype_, self._device_ = dtype, x.device
        self._in_place_ = self._streams_.dtype if self._streams_.compiled else None  # not the samples' dtype
        self._direct_ = self._streams_.direct(self._shape_, self._targets_)
        self.n_features_in_ = x.shape[-1]
        self.n_streams_ = None if x.dim() == 1 else count
        self.n_outputs_ = outputs if y.dim() == x.dim() else None

    def _placed(self, call: str, name: str, value: Tensor) -> Tensor:
        """Return a sample in the dtype of the streams, refused on another device than the first sample
        where the streams take none there."""
        if value.device != self._device_ and (value.is_meta or not self._streams_.moves):
            rule = f"must be on {self._device_}, where the first sample was"
            raise ValueError(f"`{self._call(call)}({name}=...)` {rule}; got one on {value.device}.")
        real = self._streams_.dtype
        return value if value.dtype == real else value.to(real)

    def _refusal(self, call: str, x: Tensor, y: Tensor | None = None) -> ValueError:
        """Return the error of a sample whose shapes are not those of the first one."""
        outputs = () if self.n_outputs_ is None else (self.n_outputs_,)
        given = f"{tuple(x.shape)}" + ("" if y is None else f" and y's {tuple(y.shape)}")
        name = type(self).__name__
        if x.shape[-1:] != self._shape_[-1:]:  # in scikit-learn's words
            given += f": X has {x.shape[-1]} features, but {name} is expecting {self.n_features_in_} "
            given += "features as input"
        return ValueError(
            f"`{name}.{call}(x=...)` must have the shape {self._shape_} of the first sample, with "
            f"{self.n_features_in_} features, and y {(*self._shape_[:-1], *outputs)}; got the shape {given}."
        )

    def reset(self, streams: Any = None) -> Self:
        """Forget everything, dimension and streams included; or what these streams learned."""
        self._change(self._reset, streams)
        return self

    def _reset(self, streams: Any = None) -> None:
        if streams is not None:
            rows = self._numbers("reset", streams)
            with self._device_:
                self._streams_.clear(rows)
            return
        for name in [name for name in vars(self) if name.endswith("_")]:
            delattr(self, name)

    def add(self, streams: int = 1) -> Self:
        """Begin further streams, numbered behind the others."""
        self._change(self._add, streams)
        return self

    def _add(self, streams: int) -> None:
        call = self._call("add")
        if self._fitted("add").n_streams_ is None:
            raise ValueError(f"`{call}` needs streams side by side, x (S, n); this is a single one.")
        count = integer(call, "streams", streams, least=1)
        with self._device_:
            self._streams_.add(count)
        self._resized()

    def drop(self, streams: Any) -> Self:
        """Give up the streams with these numbers; the others close ranks."""
        self._change(self._drop, streams)
        return self

    def _drop(self, streams: Any) -> None:
        gone = self._numbers("drop", streams)
        every = torch.arange(self._streams_.count, device="cpu")
        rows = every[~torch.isin(every, gone.cpu())].to(gone.device)
        if self.n_streams_ is None or not len(rows):
            raise fail(self._call("drop"), "streams", "must leave a stream", streams)
        with self._device_:
            self._streams_.keep(rows)
        self._resized(rows)

    def _resized(self, kept: Tensor | None = None) -> None:
        """Take over the count of streams after some were added, or after these alone were kept."""
        self.n_streams_ = self._streams_.count
        self._shape_ = (self._streams_.count, *self._shape_[1:])
        self._targets_ = (self._streams_.count, *self._targets_[1:])
        self._direct_ = self._streams_.direct(self._shape_, self._targets_)

    @property
    def n_samples_seen_(self) -> Tensor:
        return self._lock.read(self._counted, "learned")

    @property
    def n_skipped_(self) -> Tensor:
        return self._lock.read(self._counted, "skipped")

    def _counted(self, name: str) -> Tensor:
        count: Tensor = getattr(self._streams_, name).clone()
        return count.squeeze(0) if self.n_streams_ is None else count

    def _call(self, method: str) -> str:
        """Return a method's name in messages."""
        return f"{type(self).__name__}.{method}"

    def _fitted(self, call: str) -> Self:
        if self.__sklearn_is_fitted__():
            return self
        exceptions = sys.modules.get("sklearn.exceptions")  # scikit-learn's own error where it is in use
        kind = NotFittedError if exceptions is None else exceptions.NotFittedError
        raise kind(f"`{self._call(call)}` needs a first sample: call `fit` or `partial_fit`.")

    def state_dict(self) -> dict[str, Any]:
        """Return all that was learned, as tensors, numbers and strings, which ``weights_only=True`` loads."""
        return self._lock.read(self._state)

    def _state(self) -> dict[str, Any]:
        about = {name: getattr(self._fitted("state_dict"), name) for name in _ABOUT}
        about |= {"dtype": str(self._dtype_), "arguments": self._plain_arguments()}
        return about | self._extra_state() | self._streams_.state_dict()

    def _extra_state(self) -> dict[str, Any]:
        """Return what a saved state has beside the streams, which `_take_extra` takes over."""
        return {}

    def _take_extra(self, state: dict[str, Any]) -> None:
        """Take over what `_extra_state` gave."""

    def _plain_arguments(self) -> dict[str, Any]:
        """Return decisive arguments that are numbers, flags, kernels or None; floats, as a search's may be
        NumPy's, and a kernel's class and numbers."""
        found = {name: single(getattr(self, name)) for name in self._decisive()}
        real: dict[str, Any] = {
            k: float(v) for k, v in found.items() if isinstance(v, numbers.Real | np.bool_)
        }
        real |= {k: told_kernel(v) for k, v in found.items() if isinstance(v, Kernel | str)}
        return {k: real.get(k) for k, v in found.items() if v is None or k in real}

    def load_state_dict(self, state: dict[str, Any]) -> Self:
        """Go on from a `state_dict` of a regressor with the same arguments, bit for bit.

        Raises:
            ValueError: for a state with other arguments, or of another version, that cannot be gone on from.
                What this regressor has learned stays as it is then.
        """
        name = self._call("load_state_dict")
        missing = [key for key in (*_ABOUT, "dtype", "arguments", "table") if key not in state]
        if missing or state["dtype"] not in _DTYPES:
            told = f"it has no {missing}" if missing else f"its dtype is {state['dtype']!r}"
            raise ValueError(f"`{name}(state=...)` must be what `state_dict` returned; {told}.")
        for key in ("n_features_in_", "n_outputs_") if self.__sklearn_is_fitted__() else ():
            if (mine := getattr(self, key)) != (its := state[key]):
                told = f"it has {key}={its}, this one has learned with {mine}: call `reset` before"
                raise ValueError(f"`{name}(state=...)` must be of streams like those learned: {told}.")
        streams, outputs, dtype = state["n_streams_"], state["n_outputs_"], _DTYPES[state["dtype"]]
        twin = type(self)(**self.get_params(deep=False))
        twin._take_extra(state)
        own, given = twin._plain_arguments(), state["arguments"]
        for key in [*own, *given]:
            mine, its = own.get(key, "none"), given.get(key, "none")
            if mine != its:
                told = f"must be of a regressor with the same arguments: it has {key}={its}, this one {mine}"
                raise ValueError(f"`{name}(state=...)` {told}.")
        leading = () if streams is None else (streams,)
        where = getattr(state["table"], "device", torch.device("cpu"))
        x = torch.zeros(*leading, state["n_features_in_"], dtype=dtype, device=where)
        twin._prepare(x, x.new_zeros((*leading, *(() if outputs is None else (outputs,)))))
        with on(x.device):
            twin._streams_.load_state_dict(state)
        self._change(self._take_over, twin, state)
        return self

    def __getstate__(self) -> dict[str, Any]:
        return self._lock.read(self._whole)

    def _whole(self) -> dict[str, Any]:
        learned = {"learned": self._state()} if self.__sklearn_is_fitted__() else {}
        return self.get_params(deep=False) | self._extra_state() | learned

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._lock = ReadWriteLock()
        learned = state.pop("learned", None)
        vars(self).update({name: state[name] for name in parameters(type(self))})
        self._take_extra(state)
        if learned is not None:
            self.load_state_dict(learned)

    def _numbers(self, call: str, streams: Any) -> Tensor:
        """Return the numbers of streams, (R,) int64."""
        found = torch.as_tensor(np.asarray(streams), device="cpu").reshape(-1)
        most = self._fitted(call)._streams_.count
        found = found.long() if found.numel() == 0 else found  # an empty list is of floats
        wrong = found.is_floating_point() or found.dtype == torch.bool
        if wrong or not bool(((found >= 0) & (found < most)).all()):
            raise fail(
                self._call(call), "streams", f"must be numbers of streams from 0 to {most - 1}", streams
            )
        rows: Tensor = found.long().unique()
        return rows
