"""Seconds of programs that are measured in turn, so that what else the machine does falls on all of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

Spent = tuple[float, float]
"""Seconds of the processor (all threads) and of the clock."""


def spent(program: Callable[[], Any], calls: int = 1) -> Spent:
    """Return what a call takes."""
    cpu, wall = time.process_time(), time.perf_counter()
    for _ in range(calls):
        program()
    return (time.process_time() - cpu) / calls, (time.perf_counter() - wall) / calls


def in_turn(programs: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, list[Spent]]:
    """Return what a call of every program takes in every round, after one that is not counted."""
    for program in programs.values():
        program()
    times: dict[str, list[Spent]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            times[name].append(spent(program))
    return times
