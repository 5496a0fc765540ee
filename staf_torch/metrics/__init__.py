"""Results to numbers, and what a metric of your own is."""

from __future__ import annotations

import abc
import math
from typing import Any

import torch
from torch import Tensor

from ..numerics.rows import check_metric
from ..results.run import MetricInfo

__all__ = ["Metric", "MetricInfo"]


class Metric(abc.ABC):
    """A number at every time of every trajectory; a run reports the worst of them.

    A gradient chase reports the worst over the times t >= settle_time, a closed loop over all recorded times;
    both over the trajectories that did not diverge.

    Example:
        >>> class Digits(Metric):
        ...     name, unit, larger_is_better = "digits", "digits", True
        ...     def __call__(self, result, problem):  # -> (B, T)
        ...         return -((result.value - result.estimate).abs() / (1 + result.value.abs())).log10()
        >>> Digits().info
        MetricInfo(name='digits', unit='digits', larger_is_better=True, headline=True)

        Shown by `staf metric=custom metric.path=mine.Digits`.

    Attributes:
        name: in `metrics.json` and in tables.
        unit: for readers; empty where it is that of V.
        larger_is_better: which number a table marks as the best; the worst is then the smallest.
        headline: whether a table shows the metric where none is named.
    """

    name: str
    unit: str = ""
    larger_is_better: bool = False
    headline: bool = True

    @abc.abstractmethod
    def __call__(self, result: Any, problem: Any) -> Tensor:
        """The numbers, (B, T), a row a trajectory. No row may depend on another.

        Args:
            result: a `ChaseResult`, a piece of time of it, or an `adp.LoopResult`.
            problem: has ``basis``, ``target`` and ``law``; of a closed loop ``system``, ``cost`` and
                ``controller``.
        """

    @property
    def info(self) -> MetricInfo:
        """The declaration, for the record of a run."""
        return MetricInfo(self.name, self.unit, self.larger_is_better, self.headline)

    def badness(self, result: Any, problem: Any) -> Tensor:
        """The numbers, turned around where larger is better, so that the worst is the largest: (B, T).

        Raises:
            ValueError: if the metric returned another shape.
        """
        check_metric(self, result, problem)
        values = self(result, problem)
        wanted = tuple(result.state.shape[:2])
        if not isinstance(values, Tensor) or tuple(values.shape) != wanted:
            got = tuple(values.shape) if isinstance(values, Tensor) else values
            raise ValueError(f"`{type(self).__name__}` must return one number a time, {wanted}; got {got}.")
        return -values if self.larger_is_better else values

    def from_badness(self, worst: float) -> float | None:
        """The number to report, None where it is not finite."""
        if not math.isfinite(worst):
            return None
        return -worst if self.larger_is_better else worst

    def worst(self, result: Any, problem: Any) -> float | None:
        """The worst over all times and the rows that did not diverge; None where there are none."""
        kept = self.badness(result, problem)[~result.diverged]
        return self.from_badness(float(torch.amax(kept))) if kept.numel() else None
