"""The jobs of a sweep from its overrides: how many they are, and each when it is asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hydra.core.override_parser.types import Override, RangeSweep
from hydra.errors import HydraException

from ..lazy import Lazy


def sweep_size(overrides: Sequence[Override]) -> float:
    """Return how many jobs these overrides make; a range of a billion numbers is not written out for it."""
    return math.prod(_length(one) for one in overrides if one.is_sweep_override())


def _length(override: Override) -> float:
    value = override._value
    if not isinstance(value, RangeSweep):
        return sum(1 for _ in override.sweep_string_iterator()) if override.is_discrete_sweep() else 1
    start, stop, step = (float(number or 0) for number in (value.start, value.stop, value.step))
    steps = (stop - start) / step if step else math.inf
    return max(0, math.ceil(steps)) if math.isfinite(steps) else math.inf


def product(overrides: Sequence[Override]) -> Lazy[list[str]]:
    """Return the overrides of every job of a sweep, in the order of Hydra's own sweeper.

    Args:
        overrides: with sweeps among them.

    Raises:
        hydra.errors.HydraException: for a sweep over an interval, which is no list.
    """
    lists: dict[str, list[str]] = {}  # a key that comes twice has its first place and last values
    for one in overrides:
        key, sweeps = one.get_key_element(), one.is_sweep_override()
        if sweeps and not one.is_discrete_sweep():
            assert one.value_type is not None
            raise HydraException(f"BasicSweeper does not support sweep type : {one.value_type.name}")
        values = one.sweep_string_iterator() if sweeps else [one.get_value_element_as_str()]
        lists[key] = [f"{key}={value}" for value in values]

    def job(number: int) -> list[str]:
        lines = []
        for values in reversed(lists.values()):
            number, place = divmod(number, len(values))
            lines.append(values[place])
        return lines[::-1]

    return Lazy(math.prod(map(len, lists.values())), job)
