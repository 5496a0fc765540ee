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
)
"""The library's own metrics, headlines in the order in which a table shows them."""
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
