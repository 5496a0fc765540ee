"""The interface of river: samples as dictionaries, one at a time."""

from __future__ import annotations

import copy
import math
import sys
import warnings
from collections.abc import Mapping
from typing import Any

import torch

from .estimator import StreamEstimator
from .mixture import MixtureRegressor


class RiverRegressor:
    """`learn_one` and `predict_one` around a regressor of streams, for river's pipelines and metrics.

    Features are taken by the names of the first sample, in its order; one that is missing later, None or NaN
    was not measured, and a target that is None or NaN is not learned. A name that the first sample had not is
    left out, with a warning once. Nothing of river is imported: where it is, its `compose.Pipeline` and its
    metrics take this as a regressor.

    Example:
        >>> model = RiverRegressor(MixtureRegressor(memory=500))
        >>> _ = model.learn_one({"a": 1.0, "b": 2.0}, 3.0)
        >>> model.predict_one({"a": 1.0, "b": 2.0})
        3.0

        Shown by `staf_torch/online/mixture/README.md`.

    Args:
        model: a `StaFRegressor` or `MixtureRegressor` of one stream; by default the latter, ``memory=500``.
    """

    _supervised = True

    def __init__(self, model: StreamEstimator | None = None) -> None:
        river = sys.modules.get("river.base")
        if river is not None:
            river.Regressor.register(type(self))  # for metrics, which ask what they are given
        self.model = MixtureRegressor(memory=500) if model is None else model
        self.features: tuple[Any, ...] = ()
        self._known: set[Any] = set()

    def clone(self, new_params: Mapping[str, Any] | None = None, **kwargs: Any) -> RiverRegressor:
        """An adapter of the same settings that has learned nothing."""
        settings = {"model": copy.copy(self.model).reset()} | dict(new_params or {})
        return RiverRegressor(**settings)

    def learn_one(self, x: Mapping[Any, float | None], y: float | None, **kwargs: Any) -> RiverRegressor:
        """Learn one sample."""
        if not self.features:
            self.features = tuple(x)
            self._known = {*x}
        if new := [name for name in x if name not in self._known]:
            self._known.update(new)
            warnings.warn(
                f"`RiverRegressor.learn_one(x=...)` has features that the first sample had not; got {new!r}, "
                f"which are left out: give all of them from the first sample on",
                stacklevel=2,
            )
        self.model.partial_fit(self._row(x), torch.tensor(_number(y), dtype=torch.float64, device="cpu"))
        return self

    def predict_one(self, x: Mapping[Any, float | None], **kwargs: Any) -> float:
        """The next y at x; 0 before the first sample."""
        return float(self.model.predict(self._row(x))) if self.features else 0.0

    def _row(self, x: Mapping[Any, float | None]) -> torch.Tensor:
        return torch.tensor(
            [_number(x.get(name)) for name in self.features], dtype=torch.float64, device="cpu"
        )


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
