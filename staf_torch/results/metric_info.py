"""Units of metrics, and which way they are better. Nothing here needs torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class MetricInfo(NamedTuple):
    """A metric, as tables know it.

    Example:
        >>> MetricInfo("digits", unit="digits", larger_is_better=True).unit
        'digits'

        Shown by `staf-table runs --sort ball_error`.
    """

    name: str
    unit: str = ""  # empty: that of V, or of what it is made of
    larger_is_better: bool = False
    headline: bool = False  # whether a table shows it where no metric is named

    def record(self) -> dict[str, Any]:
        """For `run.json`: everything but the name."""
        return {key: value for key, value in self._asdict().items() if key != "name"}


OWN = (
    *map(MetricInfo, ("ultimate_error", "ultimate_error_before", "floor_error")),
    *map(MetricInfo, ("ultimate_excess", "ultimate_excess_before")),
    MetricInfo("ball_error", headline=True),
    MetricInfo("ball_floor_error", headline=True),
    MetricInfo("rounding_floor"),
    MetricInfo("gradient_error", headline=True),
    MetricInfo("condition_number", unit="1"),
    MetricInfo("settling_time", unit="s"),
    MetricInfo("contraction_violations", unit="times"),
    MetricInfo("certificate_violations", unit="times"),
    MetricInfo("products_per_second", unit="1/s"),
    MetricInfo("cost", headline=True),
    MetricInfo("optimal_cost"),
    MetricInfo("cost_ratio", unit="1", headline=True),
    MetricInfo("cost_ratio_mean", unit="1"),
    MetricInfo("cost_ratio_max", unit="1"),
    *map(MetricInfo, ("final_state_norm", "final_error", "parameter_error", "control_error", "value_error")),
    MetricInfo("regulated_fraction", unit="1", larger_is_better=True, headline=True),
    MetricInfo("diverged_fraction", unit="1"),
    MetricInfo("history_bytes", unit="B"),
)
"""The library's own metrics, headlines in the order in which a table shows them."""
MEANINGS = {
    "ultimate_error": "largest |V - V^| at the state, after settling",
    "ultimate_error_before": "largest |V - V^| at the state before the correction, after settling",
    "floor_error": "largest |V - V^| at the state with the ideal weights, after settling",
    "ultimate_excess": "largest (a - w)'K(a - w) of the weights a, after settling",
    "ultimate_excess_before": "largest (a - w)'K(a - w) before the correction, after settling",
    "ball_error": "largest |V - V^| over the closed ball of the centers' radius, after settling",
    "ball_floor_error": "ball_error of the ideal weights: the best that kernel, radius and layout allow",
    "rounding_floor": "machine epsilon times the largest |V|: no error below it means anything",
    "gradient_error": "largest |grad V - grad V^| at the state, centers frozen",
    "condition_number": "largest condition number of the Gram matrix, at least 1",
    "settling_time": "time from which on the excess stays at most ultimate_excess",
    "contraction_violations": "steps whose excess shrank by less than the law's rate promises",
    "certificate_violations": "steps that break the one-step bound",
    "products_per_second": "products of an M x M matrix with a vector, a second of the trajectory",
    "cost": "median cost of the closed loop",
    "optimal_cost": "median least cost from the same states",
    "cost_ratio": "cost over the least cost, median; 1 is optimal",
    "cost_ratio_mean": "cost over the least cost, mean; 1 is optimal",
    "cost_ratio_max": "cost over the least cost, largest; 1 is optimal",
    "final_state_norm": "largest |x| at the end",
    "final_error": "largest |x - path| at the end",
    "parameter_error": "largest error of an identified parameter at the end",
    "control_error": "largest |u - u*| over the second half of the time",
    "value_error": "largest |V* - V^| over the second half of the time",
    "regulated_fraction": "share of trajectories with |x| < 1e-3 at the end, 0 to 1; larger is better",
    "diverged_fraction": "share of trajectories that became non-finite, 0 to 1",
    "history_bytes": "bytes of a run's histories, as a dry run (device=meta) counts them",
}
"""What a reader of a table needs to know of each of the library's own metrics."""
HEADLINES = tuple(info.name for info in OWN if info.headline)


def read_infos(recorded: object) -> dict[str, MetricInfo]:
    """Return the metrics that a record of a run declares, by name; anything malformed is passed over."""
    if not isinstance(recorded, Mapping):
        return {}
    found = {str(name): about for name, about in recorded.items() if isinstance(about, Mapping)}
    flags = "larger_is_better", "headline"
    return {
        name: MetricInfo(name, str(about.get("unit", "")), *(about.get(flag) is True for flag in flags))
        for name, about in found.items()
    }
