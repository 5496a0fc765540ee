"""Which nodes of a scalar program are needed, where each is computed, which products become one rounding."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from .graph import FIXED, NOW, REAL, ROW, STEP, Graph


class Layout(NamedTuple):
    """How many entries a program reads and writes."""

    rows: Sequence[int]  # of every input that a row has once
    nows: Sequence[int]  # of every input of a time
    carries: Sequence[int]
    outputs: Sequence[int]


class Schedule:
    """What a program computes, block by block.

    Args:
        graph: the nodes.
        following: the carry after a step.
        outputs: what a step puts out.
        ahead: whether what times alone decide is found before the steps.

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
        """What a row has once and the steps read."""
        graph, read = self._graph, set(self._roots)
        for node in self.live:
            if not self._once(node):
                read.update(self._arguments(node))
        for number, loop in enumerate(graph.loops):
            if loop.node in self.live and not self._once(loop.node):
                read.update(self._ends(number))
        arrays = {graph.args[n][0] for n in read if graph.op[n] == "elem"}
        kept = (node for node in sorted((read | arrays) & self.live) if graph.depth[node] == ROW)
        return [node for node in kept if graph.op[node] not in ("const", "param", "row", "elem", "loop")]

    def cut_ahead(self) -> list[int]:
        """What times alone decide and the steps read."""
        graph, read = self._graph, set(self._roots)
        for node in self.live - self.ahead:
            if graph.depth[node] != ROW:
                read.update(self._arguments(node))
        for number, loop in enumerate(graph.loops):
            if loop.node in self.live and loop.node not in self.ahead and graph.depth[loop.node] != ROW:
                read.update(self._ends(number))
        arrays = {graph.args[n][0] for n in read if graph.op[n] == "elem"}
        kept = (node for node in sorted((read | arrays) & self.ahead) if graph.depth[node] == NOW)
        return [node for node in kept if graph.op[node] not in ("now", "elem", "loop")]

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
        """Whether a node is a product with a matrix that all rows share: each number is then read for all."""
        graph = self._graph
        packs = [a for a in graph.args[node] if graph.op[a] == "pack"] if graph.op[node] == "dot" else []
        return any(graph.op[graph.args[pack][0]] in FIXED for pack in packs)

    def together(self, one: int, other: int) -> bool:
        """Whether two nodes stand in the same block: of one loop, or of one depth outside of all."""
        return self._where[one] == self._where[other]

    def _once(self, node: int) -> bool:
        """Whether a node is found before the steps, be it inside a loop."""
        depth = self._graph.depth[node]
        if depth <= STEP:
            return depth == ROW
        return node in self._owner and self._once(self._graph.loops[self._owner[node]].node)

    def collected(self, loop: int) -> set[int]:
        """Which outputs of a loop something needs."""
        return self._collected.get(loop, set())

    def _arguments(self, node: int) -> Sequence[int]:
        return () if self._graph.op[node] == "loop" else self._graph.args[node]

    def _ends(self, loop: int) -> list[int]:
        """What a loop starts and goes on with, as far as it is needed."""
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
