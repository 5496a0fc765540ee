"""Memory of a thread: arrays that live one after the other lie in the same.

As in register allocation by linear scan (Poletto and Sarkar, 1999), an array lives from its declaration to
the last line that names it, and takes a place that is free by then. Declared one by one, all of them would
take memory at once.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence

_ARRAY = re.compile(r" *(\w+) (\w+)\[(\d+)\];$")
_WORD = re.compile(r"\b[A-Za-z]\w*\b")


def in_rooms(lines: Sequence[str], least: int) -> list[str]:
    """Return a function's lines with arrays of more than ``least`` entries in rooms that they share.

    An array lives from its declaration to the last line that names it; to the end of a loop that does, if it
    is declared before it.
    """
    arrays = {
        found[2]: (k, found[1], int(found[3]))
        for k, line in enumerate(lines)
        if (found := _ARRAY.match(line)) and int(found[3]) > least
    }
    loops, last = _loops(lines), dict[str, int]()
    for k, line in enumerate(lines):
        for name in set(_WORD.findall(line)) & arrays.keys():
            begin = arrays[name][0]
            outside = (end for head, end in loops if begin < head <= k <= end)
            last[name] = max([last.get(name, k), k, *outside])
    rooms, place = defaultdict[str, list[tuple[int, int]]](list), dict[str, str]()
    for name, (begin, kind, size) in arrays.items():
        held = rooms[kind]
        free = [r for r, (until, _) in enumerate(held) if until < begin]
        room = min(free, key=lambda r: (held[r][1] < size, abs(held[r][1] - size)), default=len(held))
        held[room : room + 1] = [(last[name], max(size, held[room][1] if room < len(held) else 0))]
        place[name] = f"room_{kind}_{room}"
    heads = [
        f"    {kind} room_{kind}_{r}[{size}];"
        for kind, held in rooms.items()
        for r, (_, size) in enumerate(held)
    ]
    declared = {begin for begin, _, _ in arrays.values()}
    moved = [
        _WORD.sub(lambda word: place.get(word[0], word[0]), line)
        for k, line in enumerate(lines)
        if k not in declared
    ]
    return [moved[0], *heads, *moved[1:]]


def _loops(lines: Sequence[str]) -> list[tuple[int, int]]:
    """The first and the last line of every loop of several lines."""
    open_, found = list[int](), list[tuple[int, int]]()
    for k, line in enumerate(lines):
        if line.endswith("{"):
            open_.append(k)
        elif line.strip() == "}":
            head = open_.pop()
            found += [(head, k)] if lines[head].strip().startswith("for (") else []
    return found
