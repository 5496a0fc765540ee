"""An estimator that holds streams: how they come and go, are counted, saved and loaded."""

from __future__ import annotations

import abc
import numbers
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from ..numerics.checks import fail, integer
from .bank import Bank
from .filter_streams import FilterStreams
from .scikit import ScikitEstimator, not_fitted
from .tuning import Tuning

_ABOUT = ("n_features_in_", "n_streams_", "n_outputs_")
_DTYPES = {str(dtype): dtype for dtype in (torch.float32, torch.float64)}


class StreamEstimator(ScikitEstimator, abc.ABC):
    """Streams of a filter or a bank, whose sizes come with the first sample."""

    n_features_in_: int
    n_streams_: int | None
    n_outputs_: int | None
    _streams_: Bank | FilterStreams
    _shape_: tuple[int, ...]
    _targets_: tuple[int, ...]
    _dtype_: torch.dtype
    _tuning: Tuning | None = None  # hyperparameters that `tune` found

    @abc.abstractmethod
    def _prepare(self, x: Tensor, y: Tensor) -> None:
        """Infer the sizes from the first sample, check the arguments and begin the streams."""

    @abc.abstractmethod
    def _decisive(self) -> tuple[str, ...]:
        """Arguments that what was learned depends on."""

    def reset(self, streams: Any = None) -> Self:
        """Forget everything, dimension and streams included; or what these streams learned."""
        if streams is not None:
            self._fitted("reset")._streams_.clear(self._numbers("reset", streams))
            return self
        for name in [name for name in vars(self) if name.endswith("_")]:
            delattr(self, name)
        return self

    def add(self, streams: int = 1) -> Self:
        """Begin further streams, numbered behind the others."""
        if self._fitted("add").n_streams_ is None:
            raise ValueError(
                f"`{self._call('add')}` needs streams side by side, x (S, n); this is a single one."
            )
        count = integer(self._call("add"), "streams", streams, least=1)
        self._streams_.add(count)
        self._tuning = None if self._tuning is None else self._tuning.add(count)
        return self._resized()

    def drop(self, streams: Any) -> Self:
        """Give up the streams with these numbers; the others close ranks."""
        gone = self._numbers("drop", streams)
        every = torch.arange(self._streams_.count)
        rows = every[~torch.isin(every, gone)]
        if self.n_streams_ is None or not len(rows):
            raise fail(self._call("drop"), "streams", "must leave a stream", streams)
        self._streams_.keep(rows)
        self._tuning = None if self._tuning is None else self._tuning.keep(rows)
        return self._resized()

    def _resized(self) -> Self:
        self.n_streams_ = self._streams_.count
        self._shape_ = (self._streams_.count, *self._shape_[1:])
        self._targets_ = (self._streams_.count, *self._targets_[1:])
        return self

    @property
    def tuning(self) -> Tuning | None:
        """Hyperparameters that `tune` found, if it was asked."""
        return self._tuning

    @property
    def n_samples_seen_(self) -> Tensor:
        return self._counted(self._streams_.learned)

    @property
    def n_skipped_(self) -> Tensor:
        return self._counted(self._streams_.skipped)

    def _counted(self, count: Tensor) -> Tensor:
        return count.squeeze(0) if self.n_streams_ is None else count

    def _call(self, method: str) -> str:
        """A method's name in messages."""
        return f"{type(self).__name__}.{method}"

    def _is_fitted(self) -> bool:
        return "_streams_" in self.__dict__

    def _fitted(self, call: str) -> Self:
        if not self._is_fitted():
            raise not_fitted(f"`{self._call(call)}` needs a first sample: call `fit` or `partial_fit`.")
        return self

    def state_dict(self) -> dict[str, Any]:
        """All that was learned, as tensors, numbers and strings, which ``weights_only=True`` loads."""
        about = {name: getattr(self._fitted("state_dict"), name) for name in _ABOUT}
        about |= {"dtype": str(self._dtype_), "arguments": self._plain_arguments()}
        tuned = {} if self._tuning is None else {"tuning": self._tuning._asdict()}
        return about | tuned | self._streams_.state_dict()

    def _plain_arguments(self) -> dict[str, Any]:
        """Decisive arguments that are numbers, flags or None; floats, as a search's may be NumPy's."""
        found = {name: getattr(self, name) for name in self._decisive()}
        plain = {k: v for k, v in found.items() if v is None or isinstance(v, numbers.Real | np.bool_)}
        return {k: v if v is None else float(v) for k, v in plain.items()}

    def load_state_dict(self, state: dict[str, Any]) -> Self:
        """Go on from a `state_dict` of a regressor with the same arguments, bit for bit.

        Raises:
            ValueError: for a state with other arguments, or of another version, that cannot be gone on from.
                What this regressor has learned stays as it is then.
        """
        name = self._call("load_state_dict")
        missing = [key for key in (*_ABOUT, "dtype", "table") if key not in state]
        if missing or state["dtype"] not in _DTYPES:
            told = f"it has no {missing}" if missing else f"its dtype is {state['dtype']!r}"
            raise ValueError(f"`{name}(state=...)` must be what `state_dict` returned; {told}.")
        streams, outputs, dtype = state["n_streams_"], state["n_outputs_"], _DTYPES[state["dtype"]]
        twin = type(self)(**self.get_params(deep=False))
        if "tuning" in state:
            twin._tuning = Tuning(**state["tuning"])
        own, given = twin._plain_arguments(), state.get("arguments", {})
        for key, value in own.items():
            if key in given and given[key] != value:
                told = f"must be of a regressor with the same arguments: it has {key}={given[key]}"
                raise ValueError(f"`{name}(state=...)` {told}, this one {value}.")
        leading = () if streams is None else (streams,)
        x = torch.zeros(*leading, state["n_features_in_"], dtype=dtype)
        twin._prepare(x, x.new_zeros((*leading, *(() if outputs is None else (outputs,)))))
        twin._streams_.load_state_dict(state)
        self.reset()
        vars(self).update({k: v for k, v in vars(twin).items() if k.endswith("_") or k == "_tuning"})
        if "tuning" not in state:
            self._tuning = None
        return self

    def __getstate__(self) -> dict[str, Any]:
        kept = (*self._parameters(), "_tuning")
        return {k: v for k, v in vars(self).items() if k in kept} | (
            {"learned": self.state_dict()} if self._is_fitted() else {}
        )

    def __setstate__(self, state: dict[str, Any]) -> None:
        learned = state.pop("learned", None)
        vars(self).update(state)
        if learned is not None:
            self.load_state_dict(learned)

    def _numbers(self, call: str, streams: Any) -> Tensor:
        """Numbers of streams, (R,) int64."""
        found = torch.as_tensor(np.asarray(streams)).reshape(-1)
        most = self._fitted(call)._streams_.count
        found = found.long() if found.numel() == 0 else found  # an empty list is of floats
        if (
            found.is_floating_point()
            or found.dtype == torch.bool
            or not bool(((found >= 0) & (found < most)).all())
        ):
            raise fail(
                self._call(call), "streams", f"must be numbers of streams from 0 to {most - 1}", streams
            )
        rows: Tensor = found.long().unique()
        return rows
