"""The interface of river: samples as dictionaries, one at a time."""

from __future__ import annotations

import copy
import math
import sys
import warnings
from collections.abc import Mapping
from statistics import NormalDist
from typing import Any

import torch

from ..lanes.threads import Mutex
from ..numerics.checks import fail
from .estimator import StreamEstimator
from .mixture import MixtureRegressor


class Gaussian(NormalDist):
    """Normal distribution of a prediction, with river's names beside those of `statistics.NormalDist`.

    ``mu``, ``sigma``, the density as a call and ``cdf`` are those of `river.proba.Gaussian`; ``inv_cdf``
    gives the ends of a band: ``inv_cdf(0.05)``, ``inv_cdf(0.95)``.
    """

    mu = NormalDist.mean
    sigma = NormalDist.stdev
    __call__ = NormalDist.pdf


class RiverRegressor:
    """`learn_one` and `predict_one` around a regressor of streams, for river's pipelines and metrics.

    Features are taken by the names of the first sample, in its order; one that is missing later, None or NaN
    was not measured, and a target that is None or NaN is not learned. A name that the first sample had not is
    left out, with a warning once. Nothing of river is imported: where it is, its `compose.Pipeline` and its
    metrics take this as a regressor. Threads may share one.

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
        self._lock = Mutex()  # of the names; the model has its own

    def __repr__(self) -> str:
        return f"RiverRegressor({self.model!r})"

    def clone(self, new_params: Mapping[str, Any] | None = None, **kwargs: Any) -> RiverRegressor:
        """An adapter of the same settings that has learned nothing."""
        settings = {"model": copy.copy(self.model).reset()} | dict(new_params or {})
        return RiverRegressor(**settings)

    def learn_one(self, x: Mapping[Any, float | None], y: float | None, **kwargs: Any) -> RiverRegressor:
        """Learn one sample.

        Raises:
            ValueError: if a feature or the target is no number; it is named.
        """
        call = "RiverRegressor.learn_one"
        with self._lock:
            names = self.features or tuple(x)
            self._known.update(names)
            row, target = _row(call, x, names), _number(call, "y", y)
            if new := [name for name in x if name not in self._known]:
                self._known.update(new)
                warnings.warn(
                    f"`RiverRegressor.learn_one(x=...)` has features that the first sample had not; got "
                    f"{new!r}, which are left out: give all of them from the first sample on",
                    stacklevel=2,
                )
            self.model.partial_fit(row, torch.tensor(target, dtype=torch.float64, device="cpu"))
            self.features = names
        return self

    def predict_one(self, x: Mapping[Any, float | None], with_dist: bool = False, **kwargs: Any) -> Any:
        """Predict the next y at x: 0 before the first sample.

        Args:
            x: numbers by the names of the features.
            with_dist: whether to return a `Gaussian`, as river's regressors with a band do; its deviation is
                the error to expect, noise included, and infinite before the first sample.

        Raises:
            ValueError: if a feature is no number; it is named.
        """
        names = self.features
        if not names:
            return Gaussian(0.0, math.inf) if with_dist else 0.0
        row = _row("RiverRegressor.predict_one", x, names)
        mean, deviation = map(float, self.model.predict(row, return_std=True))
        return Gaussian(mean, deviation) if with_dist else mean


def _row(call: str, x: Mapping[Any, float | None], names: tuple[Any, ...]) -> torch.Tensor:
    if not isinstance(x, Mapping):
        raise fail(call, "x", "must be a dictionary of numbers by the names of features", x)
    numbers = [_number(call, f"x[{name!r}]", x.get(name)) for name in names]
    return torch.tensor(numbers, dtype=torch.float64, device="cpu")


def _number(call: str, name: str, value: Any) -> float:
    """Return a number, NaN for None, which was not measured."""
    try:
        return math.nan if value is None else float(value)
    except (TypeError, ValueError):
        told = f"`{call}({name})` must be a number, or None where it was not measured; got {value!r}."
        raise ValueError(told) from None
