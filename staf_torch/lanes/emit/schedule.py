"""Which nodes of a scalar program are needed, where each is computed, which products become one rounding.

A node is computed once a row, ahead for all times of a tile, in a step, or in the innermost loop whose carry
it depends on: code motion by depth, which a tracer knows and a compiler would have to prove across buffers.
A sum takes a product that nobody else reads into one fused multiplication; contraction is switched off in the
compiler, so that the rounding is the same on all machines that have it. A loop over an array that one other
loop reads is computed where it is read.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np

from ..trace.graph import FIXED, IN_PLACE, NOW, REAL, ROW, STEP, Graph


class Schedule:
    """The computation of a program, block by block.

    Attributes:
        carries: the numbers of every loop's carry that something needs.
        live: the nodes that something needs.
        uses: how often a node is used.
        ahead: the nodes that times alone decide, whatever the row and its carry: found for all times and rows
            of a tile before the steps, their lanes being times and rows alike.
        fused: sums and differences with one product in them: the place (0 or 1) of the product.
    """

    def __init__(
        self, graph: Graph, following: Sequence[int], outputs: Sequence[int], *, ahead: bool = False
    ) -> None:
        self._graph = graph
        self.carries: dict[int, set[int]] = {}
        self.uses: Counter[int] = Counter()
        self._collected: dict[int, set[int]] = {}
        self.live: set[int] = set()
        self._owner: dict[int, int] = {}  # the innermost loop around a node
        self._roots = [*following, *outputs]
        self._mark(self._roots)
        self._count(following, outputs)
        self.ahead = self._find_ahead() if ahead else set()
        self.fused = self._fuse()
        absorbed = {graph.args[node][place] for node, place in self.fused.items()}
        self._where: dict[int, tuple[int, int]] = {}  # the block of a node
        self._blocks = self._divide(absorbed)

    def block(self, depth: int) -> list[int]:
        """The nodes outside of loops at a depth, in order."""
        return self._blocks.get((-1, depth), [])

    def body(self, loop: int) -> list[int]:
        """The nodes of a loop's body, in order."""
        return self._blocks.get((loop, self._graph.loops[loop].depth), [])

    def cut(self) -> list[int]:
        """Return the nodes that a row has once and the steps read."""
        found = self._cut(ROW, self.live, lambda node: not self.once(node))
        return [node for node in found if self._graph.op[node] not in ("const", "param", "row")]

    def cut_ahead(self) -> list[int]:
        """Return the nodes that times alone decide and the steps read."""
        depth = self._graph.depth
        found = self._cut(NOW, self.ahead, lambda node: node not in self.ahead and depth[node] != ROW)
        return [node for node in found if self._graph.op[node] != "now"]

    def _cut(self, depth: int, among: set[int], later: Callable[[int], bool]) -> list[int]:
        """The nodes of a depth that others read, which are found later."""
        graph, read = self._graph, set(self._roots)
        for node in filter(later, self.live):
            read.update(self._arguments(node))
        for number, loop in enumerate(graph.loops):
            if loop.node in self.live and later(loop.node):
                read.update(self._ends(number))
        arrays = {graph.args[n][0] for n in read if graph.op[n] == "elem"}
        kept = (node for node in sorted((read | arrays) & among) if graph.depth[node] == depth)
        return [node for node in kept if graph.op[node] not in ("elem", "loop")]

    def _find_ahead(self) -> set[int]:
        """Nodes without a row's own numbers in them: those of times, and the bodies of loops over these."""
        graph, own = self._graph, set[int]()  # nodes with numbers of a row
        for node in sorted(self.live):
            if graph.op[node] in ("row", "state") or any(a in own for a in graph.args[node]):
                own.add(node)
        found = {n for n in self.live - own if graph.depth[n] == NOW}
        for number, loop in enumerate(graph.loops):
            if loop.node in found:
                found |= self._body(number)
        return found

    def shares_a_matrix(self, node: int) -> bool:
        """Return whether a node multiplies by a matrix that all rows share: numbers are read for all."""
        graph = self._graph
        packs = [a for a in graph.args[node] if graph.op[a] == "pack"] if graph.op[node] == "dot" else []
        return any(graph.op[graph.args[pack][0]] in FIXED for pack in packs)

    def reads_back(self, node: int) -> bool:
        """Return whether a node is an entry that a loop takes from the last to the first."""
        return self._graph.op[node] == "load" and self._graph.aux[node][2] < 0

    def together(self, one: int, other: int) -> bool:
        """Return whether two nodes stand in the same block: of one loop, or of one depth outside of all."""
        return self._where[one] == self._where[other]

    def repeats(self, node: int, *, skipped: int = 1) -> int:
        """Return how often a step computes a node: the product of the counts of the loops around it."""
        count, owner = 1, self._owner.get(node)
        while owner is not None:
            loop = self._graph.loops[owner]
            count *= loop.count if loop.going < 0 else -(-loop.count // skipped)
            owner = self._owner.get(loop.node)
        return count

    def once(self, node: int) -> bool:
        """Return whether a node is computed before the steps, be it inside a loop."""
        depth = self._graph.depth[node]
        if depth <= STEP:
            return depth == ROW
        return node in self._owner and self.once(self._graph.loops[self._owner[node]].node)

    def collected(self, loop: int) -> set[int]:
        """Which outputs of a loop something needs."""
        return self._collected.get(loop, set())

    def _arguments(self, node: int) -> Sequence[int]:
        return () if self._graph.op[node] == "loop" else self._graph.args[node]

    def _ends(self, loop: int) -> list[int]:
        """Return the nodes that a loop starts and goes on with, as far as they are needed."""
        here = self._graph.loops[loop]
        ends = [part[k] for k in self.carries.get(loop, ()) for part in (here.initial, here.following)]
        ends += [node for k in self.collected(loop) for node in here.collected[k]]
        return ends + here.condition if ends else []

    def _mark(self, stack: Sequence[int]) -> None:
        graph, waiting = self._graph, list(stack)
        while waiting:
            node = waiting.pop()
            if node in self.live:
                continue
            self.live.add(node)
            waiting += self._arguments(node)
            if graph.op[node] in ("carry", "result", "carrys", "results"):
                number, k = graph.aux[node][:2]
                if k not in self.carries.setdefault(number, set()):
                    self.carries[number].add(k)
                    loop = graph.loops[number]
                    waiting += [loop.initial[k], loop.following[k], loop.carry[k], *loop.condition]
            elif graph.op[node] == "collect":
                number, k, _ = graph.aux[node]
                self._collected.setdefault(number, set()).add(k)
                waiting += graph.loops[number].collected[k]

    def _count(self, following: Sequence[int], outputs: Sequence[int]) -> None:
        for node in self.live:
            self.uses.update(self._arguments(node))
        for loop in range(len(self._graph.loops)):
            self.uses.update(self._ends(loop))
        self.uses.update([*following, *outputs])

    def _fuse(self) -> dict[int, int]:
        """Sums that take a product with them, unrounded: a product that nobody else needs."""
        graph, fused = self._graph, {}
        for node in sorted(self.live):
            if graph.op[node] not in ("add", "sub") or graph.type[node] != REAL:
                continue
            for place in (1, 0):
                arg = graph.args[node][place]
                alone = self.uses[arg] == 1 and graph.depth[arg] == graph.depth[node]
                alone = alone and (arg in self.ahead) == (node in self.ahead)
                if graph.op[arg] == "mul" and alone:
                    fused[node] = place
                    break
        return fused

    def _body(self, number: int) -> set[int]:
        """The nodes of a loop's passes, those of loops inside included."""
        graph, loop = self._graph, self._graph.loops[number]
        # A number that a pass leaves unread, and replaces, belongs to the loop all the same.
        waiting = [*self._ends(number), *(loop.carry[k] for k in self.carries.get(number, ()))]
        seen: set[int] = set()
        while waiting:
            node = waiting.pop()
            if node in seen or graph.depth[node] < loop.depth:
                continue
            seen.add(node)
            waiting += self._ends(graph.aux[node]) if graph.op[node] == "loop" else graph.args[node]
        return seen

    def _divide(self, absorbed: set[int]) -> dict[tuple[int, int], list[int]]:
        graph = self._graph
        owner = self._owner
        for number, loop in enumerate(graph.loops):
            owner.update({node: number for node in self._body(number) if graph.depth[node] == loop.depth})
        blocks: dict[tuple[int, int], list[int]] = {}
        for node in sorted(self.live - absorbed):
            depth = graph.depth[node]
            outside = STEP if depth == NOW and node not in self.ahead else depth
            place = (owner[node], depth) if depth > STEP else (-1, outside)
            self._where[node] = place
            blocks.setdefault(place, []).append(node)
        return blocks


_LONGEST = 24  # operations in one expression
Places = Any
"""The entries of an operand that a loop reads, one a pass, in a tuple; None for a number of all passes."""


def taken_over(graph: Graph, schedule: Schedule) -> set[int]:
    """Find the maps that one other map reads, hardly an entry twice: it computes them where it reads."""
    readers, counts = defaultdict[int, set[int]](set), Counter[int]()
    for node in schedule.live:
        for argument in graph.args[node] if graph.op[node] != "loop" else ():
            readers[argument].add(node)
            counts[argument] += 1
    found, length = set[int](), dict[int, int]()
    for node in sorted(schedule.live):
        if graph.op[node] not in ("map", *IN_PLACE):
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
            anyhow = graph.op[node] in IN_PLACE  # looks up places where they are irregular
            if anyhow or all(evenly(places, sizes) is not None for places in inside):
                found.add(argument)
                length[node] += more
        if graph.op[node] in IN_PLACE:  # reads as a map does, and is computed where it stands
            del length[node]
    return found


_SIMPLE = "add sub mul neg abs min max where copy lt le eq ne and or xor not"
_CHEAP = frozenset(_SIMPLE.split())
_SHORT = 6  # operations of an entry that is made again


def made_again(graph: Graph, schedule: Schedule, least: int) -> set[int]:
    """Find the maps of more than ``least`` entries that are made where they are read, however often.

    Of few operations on numbers, on tables and on arrays that are shorter: memory for all entries costs more
    where each row has its own. Whoever reads one stands in the same block.
    """
    readers, counts = defaultdict[int, list[int]](list), Counter[int]()
    for node in schedule.live:
        for argument in graph.args[node] if graph.op[node] != "loop" else ():
            readers[argument].append(node)
            counts[argument] += 1

    def here(node: int) -> bool:
        of = (readers[reader] if graph.op[reader] == "elem" else [reader] for reader in readers[node])
        known = counts[node] == schedule.uses[node]
        return known and all(schedule.together(reader, node) for some in of for reader in some)

    length = dict[int, int]()
    for node in sorted(schedule.live):
        if graph.op[node] != "map" or graph.aux[node][0] not in _CHEAP or graph.size(node) <= least:
            continue
        arrays = [operand for operand in graph.args[node] if graph.size(operand) > least]
        more = sum(length.get(operand, 0 if constants(graph, operand) else _SHORT) for operand in arrays)
        if more < _SHORT and here(node):
            length[node] = 1 + more
    return set(length)


def constants(graph: Graph, array: int) -> bool:
    """Return whether an array has numbers alone that are the same for all rows and times."""
    return graph.op[array] == "pack" and all(graph.op[node] in FIXED for node in graph.args[array])


def leaves(
    graph: Graph, taken: Collection[int], node: int, at: Places = None
) -> Iterator[tuple[int, Places]]:
    """Return what a map reads, including the maps it takes over: each operand, and the places in it.

    ``at`` are the entries of the map that are wanted; None for all.
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
