"""Which nodes of a scalar program are needed, where each is computed, which products become one rounding."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from .graph import NOW, REAL, ROW, STEP, Graph


class Schedule:
    """What a program computes, block by block.

    Args:
        graph: the nodes.
        following: the carry after a step.
        outputs: what a step puts out.

    Attributes:
        carries: the numbers of every loop's carry that something needs.
        live: the nodes that something needs.
        uses: how often a node is used.
        fused: sums and differences with one product in them: the place (0 or 1) of the product.
    """

    def __init__(self, graph: Graph, following: Sequence[int], outputs: Sequence[int]) -> None:
        self._graph = graph
        self.carries: dict[int, set[int]] = {}
        self.uses: Counter[int] = Counter()
        self._collected: dict[int, set[int]] = {}
        self.live: set[int] = set()
        self._owner: dict[int, int] = {}  # the innermost loop around a node
        self._roots = [*following, *outputs]
        self._mark(self._roots)
        self._count(following, outputs)
        self.fused = self._fuse()
        absorbed = {graph.args[node][place] for node, place in self.fused.items()}
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
        return ends + [node for k in self.collected(loop) for node in here.collected[k]]

    def _mark(self, stack: Sequence[int]) -> None:
        graph, waiting = self._graph, list(stack)
        while waiting:
            node = waiting.pop()
            if node in self.live:
                continue
            self.live.add(node)
            waiting += self._arguments(node)
            if graph.op[node] in ("carry", "result"):
                number, k = graph.aux[node]
                if k not in self.carries.setdefault(number, set()):
                    self.carries[number].add(k)
                    loop = graph.loops[number]
                    waiting += [loop.initial[k], loop.following[k], loop.carry[k]]
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
                if graph.op[arg] == "mul" and alone:
                    fused[node] = place
                    break
        return fused

    def _divide(self, absorbed: set[int]) -> dict[tuple[int, int], list[int]]:
        graph = self._graph
        owner = self._owner
        for number, loop in enumerate(graph.loops):
            # A number that a pass leaves unread, and replaces, belongs to the loop all the same.
            waiting, seen = (
                [*self._ends(number), *(loop.carry[k] for k in self.carries.get(number, ()))],
                set(),
            )
            while waiting:
                node = waiting.pop()
                if node in seen or graph.depth[node] < loop.depth:
                    continue
                seen.add(node)
                waiting += self._ends(graph.aux[node]) if graph.op[node] == "loop" else graph.args[node]
                if graph.depth[node] == loop.depth:
                    owner[node] = number
        blocks: dict[tuple[int, int], list[int]] = {}
        for node in sorted(self.live - absorbed):
            depth = graph.depth[node]
            place = (owner[node], depth) if depth > STEP else (-1, STEP if depth == NOW else depth)
            blocks.setdefault(place, []).append(node)
        return blocks
