"""Closed loops to numbers."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..adp import LoopResult

_REGULATED = 1e-3


def adp_metrics(
    result: LoopResult,
    *,
    optimal_cost: Tensor | None,
    control_error: Tensor | None,
    value_error: Tensor | None,
    final: Tensor | None = None,
) -> dict[str, float | None]:
    """The metrics of a closed loop; None where there is nothing to report.

    Args:
        result: the closed loop.
        optimal_cost: V*(x(0)), (B,); NaN where it was not found.
        control_error: |u - u*| at the recorded times, (B, T); NaN where it was not computed.
        value_error: |V - V^| at the recorded times, (B, T); NaN where it was not computed.
        final: e at the end, (B, n), the state measured from a set-point; the state itself by default.

    Returns:
        ``cost``, ``optimal_cost``: medians over the trajectories that did not diverge (of one: itself).
        ``cost_ratio``, ``cost_ratio_mean``, ``cost_ratio_max``: cost / V*(x(0)), median, mean and largest,
        over those whose V*(x(0)) is known and positive.
        ``final_state_norm``: the largest |e| at the end.
        ``control_error``, ``value_error``: the largest over the second half of the time.
        ``regulated_fraction``: |e| < 1e-3 at the end and not diverged, of all.
        ``diverged_fraction``: of all.
    """
    kept = ~result.diverged
    norm = (result.state[:, -1] if final is None else final).norm(dim=-1)
    metrics: dict[str, float | None] = {
        "cost": _median(result.cost[kept]),
        "optimal_cost": None if optimal_cost is None else _median(optimal_cost[kept & ~optimal_cost.isnan()]),
        "cost_ratio": None,
        "cost_ratio_mean": None,
        "cost_ratio_max": None,
        "final_state_norm": _worst(norm[kept]),
        "control_error": _worst_known(control_error, kept),
        "value_error": _worst_known(value_error, kept),
        "regulated_fraction": float(((norm < _REGULATED) & kept).double().mean()),
        "diverged_fraction": float(result.diverged.double().mean()),
    }
    if optimal_cost is not None:
        chosen = kept & (optimal_cost > 0)
        ratio = result.cost[chosen] / optimal_cost[chosen]
        if len(ratio):
            metrics["cost_ratio"] = _median(ratio)
            metrics["cost_ratio_mean"] = float(ratio.mean())
            metrics["cost_ratio_max"] = _worst(ratio)
    return {k: v if v is not None and math.isfinite(v) else None for k, v in metrics.items()}


def _worst_known(errors: Tensor | None, kept: Tensor) -> float | None:
    """The largest settled error of the rows ``kept``, of those that were computed (not NaN)."""
    if errors is None:
        return None
    settled = errors[:, errors.shape[1] // 2 : -1][kept]  # not the last time, at which no control starts
    return _worst(settled[~settled.isnan()])


def _median(values: Tensor) -> float | None:
    return float(values.quantile(0.5)) if values.numel() else None


def _worst(values: Tensor) -> float | None:
    return float(values.max()) if values.numel() else None


def regulated(result: LoopResult, final: Tensor | None = None) -> Tensor:
    """|e| < 1e-3 at the end and not diverged, ``final`` as in `adp_metrics`: (B,) bool."""
    near: Tensor = (result.state[:, -1] if final is None else final).norm(dim=-1) < _REGULATED
    return near & ~result.diverged


def comparison_row(result: LoopResult, ratio: Tensor, final: Tensor | None = None) -> dict[str, float | None]:
    """A method over many initial states, as a row of a table.

    ``ratio`` is cost / V*(x(0)), (B,), inf for rows that diverged, NaN where V* was not found; ``final`` as
    in `adp_metrics`. ``ratio_median``, ``ratio_mean`` and ``ratio_max`` are over the rows that were
    regulated, the fractions ``regulated`` and ``diverged`` of all; ``final_state_norm`` is the median |e| at
    the end.
    """
    good = regulated(result, final)
    kept = ratio[good & ~ratio.isnan()]
    left = (result.state[:, -1] if final is None else final).norm(dim=-1)
    return {
        "ratio_median": _median(kept),
        "ratio_mean": float(kept.mean()) if len(kept) else None,
        "ratio_max": _worst(kept),
        "regulated": float(good.double().mean()),
        "diverged": float(result.diverged.double().mean()),
        "final_state_norm": _median(left),
    }


def tracking_metrics(
    result: LoopResult, parameters: Tensor | None, truth: Tensor, optimal_cost: Tensor | None
) -> dict[str, float | None]:
    """The metrics of a tracking run in the state (e, xd), over the trajectories that did not diverge.

    theta^ is (B, T, p, n), None where nothing is identified, theta (p, n), V*(x(0)) of the known plant (B,),
    NaN where it was not found. ``cost`` is the median; ``cost_ratio`` the median of cost / V*(x(0));
    ``final_error`` the largest |e| of the last tenth of the time; ``parameter_error`` the largest |theta^ -
    theta| at the end.
    """
    kept = ~result.diverged
    tail = max(1, result.state.shape[1] // 10)
    error = result.state[kept, -tail:, :2].norm(dim=-1)
    off = None
    if parameters is not None:
        off = _worst((parameters[kept, -1] - truth.to(parameters)).flatten(-2).norm(dim=-1))
    ratio = None
    if optimal_cost is not None:
        ratios = (result.cost / optimal_cost.to(result.cost))[kept]
        ratio = _median(ratios[~ratios.isnan()])
    return {
        "cost": _median(result.cost[kept]),
        "cost_ratio": ratio,
        "final_error": _worst(error),
        "parameter_error": off,
        "diverged_fraction": float(result.diverged.double().mean()),
    }


def constraint_metrics(result: LoopResult, margin: Tensor) -> dict[str, float | None]:
    """The metrics of the smallest h of the constraints at the recorded times, (B, T).

    ``minimum_margin`` is the smallest h over rows and times; ``constraint_violations`` are the rows with h <
    0 or h unknown at a time, and those that diverged, as a row of `systems.Barrier` that leaves its box.
    """
    known = torch.where(margin.isnan(), torch.inf, margin)
    left = (known < 0).any(-1) | margin.isnan().any(-1) | result.diverged
    least = float(known.min())
    return {
        "minimum_margin": least if abs(least) < float("inf") else None,
        "constraint_violations": float(left.sum()),
    }
