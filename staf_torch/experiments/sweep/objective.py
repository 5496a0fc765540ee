"""What a job returns to the sweeper."""

from __future__ import annotations

import math
from collections.abc import Mapping

from omegaconf import DictConfig, OmegaConf

from ..._checks import choice

Metrics = Mapping[str, float | None]


def objective(cfg: DictConfig, metrics: Metrics) -> Metrics | float | tuple[float, ...]:
    """All metrics, or those named in `sweep.objective` alone, as the sweepers that optimise want them.

    Raises:
        ValueError: if there is no metric of that name.
    """
    named = OmegaConf.select(cfg, "sweep.objective")
    if named is None:
        return metrics
    if isinstance(named, str):
        return _number(named, metrics)
    return tuple(_number(name, metrics) for name in named)


def _number(name: str, metrics: Metrics) -> float:
    choice("staf", "sweep.objective", name, tuple(metrics))
    value = metrics[name]
    return math.inf if value is None else float(value)  # null: there is no finite number
