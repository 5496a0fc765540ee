"""Loops over many entries that another loop takes over: their results need not go through memory."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np

from .graph import Graph
from .schedule import Schedule

_LONGEST = 24  # operations in one expression
Places = Any
"""The entries of an operand that a loop reads, one a pass, in a tuple; None for a number of all passes."""


def taken_over(graph: Graph, schedule: Schedule) -> set[int]:
    """Find the maps that one other map reads, hardly an entry twice: it computes them where it reads.

    Args:
        graph: the nodes.
        schedule: of the same program.
    """
    readers, counts = defaultdict[int, set[int]](set), Counter[int]()
    for node in schedule.live:
        for argument in graph.args[node] if graph.op[node] != "loop" else ():
            readers[argument].add(node)
            counts[argument] += 1
    found, length = set[int](), dict[int, int]()
    for node in sorted(schedule.live):
        if graph.op[node] != "map":
            continue
        length[node] = 1
        sizes = [s for s in graph.aux[node][1] if s > 1]
        for argument in dict.fromkeys(graph.args[node]):
            # Also no loop, carry or output reads it, which are uses that no node has.
            alone = readers[argument] == {node} and counts[argument] == schedule.uses[argument]
            if argument not in length or not alone or not schedule.together(argument, node):
                continue
            pairs = zip(graph.args[node], graph.aux[node][2:], strict=True)
            reads = [places for operand, places in pairs if operand == argument]
            entries = [entry for places in reads for entry in places]
            more = length[argument] * len(reads)
            if 8 * len(entries) > 10 * len(set(entries)) or length[node] + more > _LONGEST:
                continue
            inside = [places for read in reads for _, places in leaves(graph, found, argument, read)]
            if all(evenly(places, sizes) is not None for places in inside):
                found.add(argument)
                length[node] += more
    return found


def leaves(
    graph: Graph, taken: Collection[int], node: int, at: Places = None
) -> Iterator[tuple[int, Places]]:
    """What a map reads, that of the maps it takes over included: each operand, and the places in it.

    Args:
        graph: the nodes.
        taken: maps that are computed where they are read.
        node: the map.
        at: its entries that are wanted; None for all.
    """
    for operand, own in zip(graph.args[node], graph.aux[node][2:], strict=True):
        places = own if at is None or own is None else tuple(own[k] for k in at)
        if operand in taken:
            yield from leaves(graph, taken, operand, places)
        else:
            yield operand, places


def ends_with(
    graph: Graph, schedule: Schedule, taken: Collection[int], slot: int, nodes: Sequence[int]
) -> int | None:
    """The map that makes a slot of the carry, array for array, and may write over what the slot was.

    Nothing else reads it, and of the carry it reads at most the same entry of the same slot. None where no
    map is like that.

    Args:
        graph: the nodes.
        schedule: of the same program.
        taken: maps that are computed where they are read.
        slot: of the carry, in memory.
        nodes: what it becomes.
    """
    first = nodes[0]
    node = graph.args[first][0] if graph.op[first] == "elem" else first
    if graph.op[node] != "map" or graph.size(node) != len(nodes) or schedule.uses[node] != len(nodes):
        return None
    whole = range(len(nodes))
    if [(graph.args[n], graph.aux[n], schedule.uses[n]) for n in nodes] != [((node,), k, 1) for k in whole]:
        return None
    for operand, places in leaves(graph, taken, node):
        entries = graph.args[operand] if graph.op[operand] == "pack" else (operand,)
        if all(graph.op[n] == "state" for n in entries):  # not a copy with other numbers in it
            own = [graph.aux[n] for n in entries] == [(slot, k) for k in whole]
            if not own or places != tuple(whole):
                return None
    return node


def evenly(places: Places, sizes: Sequence[int]) -> tuple[list[int], int] | None:
    """Strides and start of places that nested loops of these sizes reach, None where they are irregular."""
    if places is None:
        return [0] * len(sizes), 0
    table = np.array(places).reshape(sizes)
    start, strides = int(table.flat[0]), []
    for d in range(len(sizes)):
        step = np.diff(table, axis=d)
        if step.size and not (step == step.flat[0]).all():
            return None
        strides.append(int(step.flat[0]) if step.size else 0)
    return strides, start
