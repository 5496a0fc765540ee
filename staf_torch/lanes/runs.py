"""Entries that come one after the other out of the same memory, at even strides."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import NamedTuple

_SHORTEST = 4  # entries that are worth a loop


class Run(NamedTuple):
    """Some entries of a list: those from ``begin`` on."""

    begin: int
    length: int
    first: int = 0  # place of the first of them in what they come from
    step: int | None = None  # from place to place; None where each is an entry of its own


def runs(places: Sequence[tuple[Hashable, int]]) -> list[Run]:
    """Split a list of entries into runs.

    Args:
        places: of every entry what it is read from, and where in it.
    """
    found, k = list[Run](), 0
    while k < len(places):
        source, first = places[k]
        step, length = 0, 1
        if k + 1 < len(places) and places[k + 1][0] == source:
            step = places[k + 1][1] - first
        while k + length < len(places) and places[k + length] == (source, first + length * step):
            length += 1
        if length >= _SHORTEST:
            found.append(Run(k, length, first, step))
        else:
            length = 1
            alone = found.pop().length if found and found[-1].step is None else 0
            found.append(Run(k - alone, alone + 1))
        k += length
    return found
