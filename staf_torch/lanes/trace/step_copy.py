"""A copy of a step for its adjoint: the carry is an input like any other, innermost loops alone are left."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from .graph import NOW, REAL, ROW, STEP, Graph, Loop, Sizes
from .tracer import NotLoweredError

_MOST = 40_000  # nodes of a program whose loops are written out
_COSTLY, _WORTH = 20, 3  # operations that a function takes, and that a number written and read is worth
_COMPUTED = "exp expm1 log log1p sin cos tan tanh atan2 pow sqrt div"
_FUNCTIONS = frozenset(_COMPUTED.split())
_ARRAYS = ("map", "dot")
_KEPT = _FUNCTIONS.union(_ARRAYS, ("add", "sub", "mul", "neg", "abs", "where", "min", "max"))


class NoReverseError(NotLoweredError):
    """A program has no adjoint of this form."""


class StepCopy:
    """The numbers of a step in a graph of its own, from the carry and the inputs of a time alike.

    Innermost loops stay loops, which also collect their carry before every pass; the others are written out.

    Args:
        graph, layout: of the step.
        roots: what is wanted of it.

    Attributes:
        graph: the copy: the leaves of the carry are the first inputs of a time.
        roots: these numbers there.
        kept: the loops of the step, by the nodes of those that stay.
    """

    def __init__(self, graph: Graph, layout: Sizes, roots: Sequence[int]) -> None:
        self._of, self.graph = graph, Graph(graph.single)
        self._carries = len(layout.carries)
        deepest = max((loop.depth for loop in graph.loops), default=STEP)
        self._known: list[dict[int, int]] = [{} for _ in range(deepest + 1)]  # of nodes, by their depth
        self._pass: dict[int, tuple[int, bool]] = {}  # of a loop: which one, or the loop that stays, reversed
        self._ends: dict[int, list[int]] = {}  # of loops: their results, and what they collected
        self._collected: dict[int, list[int]] = {}
        self.kept: dict[int, int] = {}
        self._last: dict[int, int] = {}  # of loops: the one that stays
        self._held: dict[int, list[int]] = {}  # of loops: the numbers of a pass that are not computed again
        self._copy(roots)
        self.roots = [self._at(root) for root in roots]

    def _at(self, node: int) -> int:
        return self._known[self._of.depth[node]][node]

    def _copy(self, roots: Sequence[int]) -> None:
        waiting = [*reversed(roots)]
        while waiting:
            node = waiting[-1]
            place = self._known[self._of.depth[node]]
            if node not in place:
                missing = [a for a in self._of.args[node] if a not in self._known[self._of.depth[a]]]
                if missing:
                    waiting += missing
                    continue
                place[node] = self._made(node)
                if len(self.graph.op) > _MOST:
                    raise NoReverseError("its loops are too long to be written out")
            waiting.pop()

    def _made(self, node: int) -> int:
        old, new = self._of, self.graph
        op, aux, type = old.op[node], old.aux[node], old.type[node]
        if op == "loop":
            return self._keep(aux) if self._stays(aux) else self._write_out(aux)
        args = [self._at(a) for a in old.args[node]]
        if op == "row":
            return new.add(op, (), type, aux, ROW)
        if op in ("now", "state"):
            return new.add("now", (), type, (aux[0] + (self._carries if op == "now" else 0), aux[1]), NOW)
        if op == "elem":
            return entry(new, args[0], aux)
        if op == "load":
            return self._load(args[0], type, *aux)
        if op in ("result", "results", "collect"):
            found: int = (self._collected if op == "collect" else self._ends)[aux[0]][aux[1]]
            return found
        if op == "where":
            return new.where(*args)
        if op in ("const", "param", "map", "dot", "pack", "cast"):
            return new.add(op, args, type, aux)
        return new.apply(op, *args)

    def _load(self, array: int, type: str, number: int, at: int, stride: int) -> int:
        """An entry of an array that a pass takes."""
        if not self._stays(number):
            return entry(self.graph, array, at + self._pass[number][0] * stride)
        here, back = self._pass[number]
        if back:
            at, stride = at + (self._of.loops[number].count - 1) * stride, -stride
        return self.graph.add("load", (array,), type, (here, at, stride), STEP + 1)

    def _stays(self, number: int) -> bool:
        """Return whether a loop stays one: it has no loops in it, and its carry is single numbers."""
        old, loop = self._of, self._of.loops[number]
        inner = any(other.home >= loop.depth for other in old.loops)
        return not inner and all(old.op[node] == "carry" for node in loop.carry)

    def body(
        self, number: int, here: int, carry: Sequence[int], *, back: bool
    ) -> tuple[list[int], list[list[int]]]:
        """Copy a pass; return what follows, and what is collected."""
        loop = self._of.loops[number]
        self._pass[number] = here, back
        self._known[loop.depth] = dict(zip(loop.carry, carry, strict=True))
        self._copy([*loop.following, *(node for part in loop.collected for node in part)])
        return [*map(self._at, loop.following)], [[*map(self._at, part)] for part in loop.collected]

    def held(self, number: int, here: int, nodes: Iterable[int]) -> dict[int, int]:
        """Return what stands for numbers of a pass that a loop has kept, or that follow from such."""
        loop, before, known = self._of.loops[number], self._last[number], self._known
        found = dict[int, int]()
        for part, node in enumerate(self._held[number], len(loop.collected)):
            array, size = collected(self.graph, before, part), self._of.size(node)
            places = [((loop.count - 1) * size + k, -size) for k in range(size)]
            loads = [self.graph.add("load", (array,), REAL, (here, *p), STEP + 1) for p in places]
            whole = self._of.op[node] in _ARRAYS
            found[known[loop.depth][node]] = self.graph.add("pack", loads, REAL, size) if whole else loads[0]
        graph = self.graph
        for node in nodes:
            args = graph.args[node]
            if node not in found and not found.keys().isdisjoint(args):
                given = [found.get(a, a) for a in args]
                found[node] = graph.add(graph.op[node], given, graph.type[node], graph.aux[node])
        return found

    def _keep(self, number: int) -> int:
        old, new, here = self._of.loops[number], self.graph, len(self.graph.loops)
        loop = Loop(old.count, STEP + 1)
        new.loops.append(loop)
        loop.initial = [*map(self._at, old.initial)]
        kinds = [self._of.type[node] for node in old.carry]
        loop.carry = [new.add("carry", (), kind, (here, k), STEP + 1) for k, kind in enumerate(kinds)]
        loop.following, loop.collected = self.body(number, here, loop.carry, back=False)
        self._last[number], self._held[number] = here, self._long(number)
        loop.collected += [self._entries(node) for node in self._held[number]]
        loop.collected += [[node] for node in loop.carry]
        new.close(here)
        self.kept[loop.node] = number
        self._ends[number] = [
            new.add("result", (loop.node,), kind, (here, k)) for k, kind in enumerate(kinds)
        ]
        self._collected[number] = [collected(new, here, k) for k in range(len(old.collected))]
        return loop.node

    def _long(self, number: int) -> list[int]:
        """Return the numbers of a pass that cost more than to be written down and read: sums as a whole."""
        graph, depth = self._of, self._of.loops[number].depth
        own = sorted(node for node in self._known[depth] if graph.op[node] not in ("carry", "load"))
        readers: dict[int, list[int]] = {node: [] for node in own}
        for node in own:
            for argument in set(graph.args[node]):
                if argument in readers:
                    readers[argument].append(node)
        costs, found = dict[int, int](), list[int]()
        for node in own:
            op, aux, size = graph.op[node], graph.aux[node], graph.size(node)
            cost = aux[1] * size if op == "dot" else size if op in ("map", "pack") else op != "elem"
            cost *= _COSTLY if (aux[0] if op == "map" else op) in _FUNCTIONS else 1
            costs[node] = cost + sum(costs.get(argument, 0) for argument in set(graph.args[node]))
            inside = len(readers[node]) == 1 and graph.op[readers[node][0]] in ("add", "sub", "neg")
            if graph.type[node] == REAL and costs[node] > _WORTH * size and not inside and op in _KEPT:
                found.append(node)
                costs[node] = 0
        return found

    def _entries(self, node: int) -> list[int]:
        array = self._at(node)
        whole = self._of.op[node] in _ARRAYS
        return [entry(self.graph, array, k) for k in range(self._of.size(node))] if whole else [array]

    def _write_out(self, number: int) -> int:
        old, new = self._of.loops[number], self.graph
        now, parts = [*map(self._at, old.initial)], [list[int]() for _ in old.collected]
        for k in range(old.count):
            now, made = self.body(number, k, now, back=False)
            for part, nodes in zip(parts, made, strict=True):
                part += nodes
        self._ends[number] = now
        self._collected[number] = [new.add("pack", part, new.type[part[0]], len(part)) for part in parts]
        return -1


def collected(graph: Graph, number: int, part: int) -> int:
    """The array of a part of what a loop collects."""
    loop = graph.loops[number]
    nodes = loop.collected[part]
    return graph.add("collect", (loop.node,), graph.type[nodes[0]], (number, part, loop.count * len(nodes)))


def entry(graph: Graph, array: int, place: int) -> int:
    """The number at a place of an array."""
    if graph.op[array] == "pack":
        return graph.args[array][place]
    return graph.add("elem", (array,), graph.type[array], place)
