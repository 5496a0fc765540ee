"""The adjoint of a step, number by number in reverse.

A number of the table, which follows from captured tensors alone (a Gram matrix, its factor), is an input
here: its slope is summed over times, and what led to the table is differentiated once, after all times
(`captured_tensors.TableSlopes`). The derivative of the step as a whole would take it along at every time.
What the step and its adjoint have in common is computed once, as a graph makes no node twice, and what
nothing depends on is not made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..emit.schedule import evenly
from ..trace.graph import FLAG, REAL, STEP, WHOLE, Loop
from ..trace.step_copy import NoReverseError, StepCopy, collected, entry
from ..trace.tracer import LARGE
from .slopes import signs_last, slopes_of

_TERMS = 16  # products that are added in one pass over an array
_NONE = "lt le eq ne and or xor not floor ceil trunc round const philox_first philox_second"
_FLAT = frozenset(_NONE.split())
"""Operations through which no slope goes."""
Operand = tuple[int, Any]
"""An array and the places that are read of it, one an entry, or a number and None."""


class Reverse:
    """Slopes by the inputs of a step.

    ``slots`` are kinds and numbers of inputs of which slopes are wanted, ("now", 0), and of how many
    entries; ("param", k) are numbers of the table, ``numbers`` the slot and the entry of each of them.
    """

    def __init__(
        self, step: StepCopy, slots: dict[tuple[str, int], int], numbers: dict[int, tuple[int, int]]
    ) -> None:
        self._step, self._graph, self._slots, self._numbers = step, step.graph, slots, numbers
        self._slope: dict[int, int] = {}
        self._whole: dict[int, list[int]] = {}  # of arrays
        self._single: dict[int, dict[int, int]] = {}
        self._ends: dict[int, dict[int, int]] = {}  # by the results of a loop
        self._outs: dict[int, dict[int, int]] = {}  # by what it collects
        self._around: dict[int, int] | None = None  # in a loop: by numbers outside of it, added up by passes
        self._sums = 0, 0  # in a loop: its number, and where those sums begin in its carry
        self._arrays_around: dict[int, list[int]] = {}
        self._zero, self._one = self._graph.constant(0.0, REAL), self._graph.constant(1.0, REAL)
        self._found: dict[tuple[str, int], dict[int, int]] = {slot: {} for slot in slots}
        self._arrays: dict[tuple[str, int], list[list[Operand]]] = {}  # products that are added
        self._active: list[bool] = []
        self._values: dict[
            int, int
        ] = {}  # in a loop: what stands for a number that is kept or follows from one
        self._depend()

    def run(self, ends: Sequence[tuple[int, int]]) -> None:
        """Find the slopes, from those of some numbers: pairs of a number and its slope."""
        for node, slope in ends:
            self._give(node, slope)
        self._sweep(0, len(self._active))

    def _sweep(self, first: int, last: int) -> None:
        graph = self._graph
        for node in range(last - 1, first - 1, -1):
            op = graph.op[node]
            if not self._active[node]:
                continue
            if op == "loop":
                if node in self._ends or node in self._outs:
                    self._loop(node)
            elif op in ("pack", "map", "dot", "collect"):
                array = self._taken(node)
                if array is not None:
                    getattr(self, f"_{op}")(node, array)
            elif node in self._slope:
                self._back(node, self._slope[node])

    def entries(self, slot: tuple[str, int]) -> list[int]:
        """Return the slopes by the entries of an input."""
        found, size = self._found[slot], self._slots[slot]
        nodes = [found.get(k, self._zero) for k in range(size)]
        if slot not in self._arrays:
            return nodes
        array = self._added(self._arrays[slot], size)
        more = [entry(self._graph, array, k) for k in range(size)]
        return [self._graph.apply("add", *both) for both in zip(nodes, more, strict=True)] if found else more

    def added(self, slot: tuple[str, int], before: Sequence[int]) -> list[int]:
        """Return the entries of a sum to which the slopes by an input are added."""
        graph, size = self._graph, len(before)
        if slot not in self._arrays or self._found[slot]:
            pairs = zip(before, self.entries(slot), strict=True)
            return [one if other == self._zero else graph.apply("add", one, other) for one, other in pairs]
        total = self._added(self._arrays[slot], size, graph.add("pack", before, REAL, size))
        return [entry(graph, total, k) for k in range(size)]

    def _input(self, node: int) -> tuple[tuple[str, int], int] | None:
        """The slot and the entry of an input with slopes, None of other nodes."""
        op, aux = self._graph.op[node], self._graph.aux[node]
        if op == "param" and aux in self._numbers:
            slot, k = self._numbers[aux]
            return ("param", slot), k
        if op in ("row", "now") and (op, aux[0]) in self._slots:
            return (op, aux[0]), aux[1]
        return None

    def _depend(self) -> None:
        """Find out of the latest nodes which have slopes."""
        graph, active = self._graph, self._active
        for node in range(len(active), len(graph.op)):
            op, type = graph.op[node], graph.type[node]
            if op in _FLAT or type in (FLAG, WHOLE):
                active.append(False)
            else:
                active.append(self._input(node) is not None or any(active[a] for a in graph.args[node]))
                if active[-1] and type != REAL and op != "loop":
                    raise NoReverseError("numbers of two precisions")

    def _is_active(self, node: int) -> bool:
        return node < len(self._active) and self._active[node]

    # What a slope is added to.

    def _give(self, node: int, slope: int) -> None:
        if not self._is_active(node):
            return
        outside = self._around is not None and self._graph.depth[node] <= STEP
        slopes = self._around if outside and self._around is not None else self._slope
        before = slopes.get(node)
        if before is None and outside:  # the sum of the passes so far, so that products are added to it
            number, first = self._sums
            before = self._graph.add("carry", (), REAL, (number, first + len(slopes)), STEP + 1)
        slopes[node] = slope if before is None else self._graph.apply("add", before, slope)

    def _give_whole(self, array: int, slopes: int) -> None:
        if self._is_active(array):
            outside = self._around is not None and self._graph.depth[array] <= STEP
            (self._arrays_around if outside else self._whole).setdefault(array, []).append(slopes)

    def _give_entry(self, array: int, place: int, slope: int) -> None:
        if not self._is_active(array):
            return
        if self._graph.op[array] == "pack":
            return self._give(self._graph.args[array][place], slope)
        if self._around is not None and self._graph.depth[array] <= STEP:
            return self._give(entry(self._graph, array, place), slope)
        entries = self._single.setdefault(array, {})
        before = entries.get(place)
        entries[place] = slope if before is None else self._graph.apply("add", before, slope)

    def _taken(self, array: int) -> int | None:
        """The slopes by an array."""
        graph, parts, some = self._graph, self._whole.get(array, []), self._single.get(array)
        size = graph.size(array)
        if some is not None:
            nodes = [some.get(k, self._zero) for k in range(size)]
            parts = [*parts, graph.add("pack", nodes, REAL, size)]
        return self._combined(parts) if parts else None

    def _combined(self, parts: Sequence[int]) -> int:
        """The sum of arrays."""
        if len(parts) == 1:
            return parts[0]
        return self._added([term for part in parts for term in self._terms(part)], self._graph.size(parts[0]))

    def _added(self, terms: Sequence[Sequence[Operand]], size: int, start: int | None = None) -> int:
        """An array and products, one a term and an entry, in one loop where that is possible."""
        everything = [p for term in terms for _, p in term if p is not None]
        shapes = ((n, size // n) for n in range(1, size + 1) if size % n == 0)
        even = (s for s in shapes if all(evenly(p, [n for n in s if n > 1]) is not None for p in everything))
        shape = next(even, (size,))
        total = None if start is None else (start, _all((size,)))
        for term in terms:
            if total is None:
                total = self._mapped("mul" if len(term) == 2 else "copy", shape, *term)
            else:
                total = self._mapped("fma" if len(term) == 2 else "add", shape, *term, total)
        assert total is not None
        return total[0]

    def _terms(self, part: int) -> list[list[Operand]]:
        """An array as a sum of products, of few, or itself."""
        graph, op, aux = self._graph, self._graph.op[part], self._graph.aux[part]
        if op == "map" and aux[0] == "mul":
            return [[*zip(graph.args[part], aux[2:], strict=True)]]
        if op == "dot" and aux[1] <= _TERMS:
            pairs = [*zip(graph.args[part], aux[2:], strict=True)]
            return [[(x, p if p is None else p[q :: aux[1]]) for x, p in pairs] for q in range(aux[1])]
        return [[(part, _all((graph.size(part),)))]]

    def _mapped(self, op: str, shape: Sequence[int], *operands: Operand) -> Operand:
        nodes, places = zip(*operands, strict=True)
        type = FLAG if op in ("lt", "le", "eq", "ne") else REAL
        return self._graph.add("map", nodes, type, (op, tuple(shape), *places)), _all(shape)

    # One operation back.

    def _back(self, node: int, slope: int) -> None:
        graph = self._graph
        op, args = graph.op[node], graph.args[node]
        if op == "elem":
            return self._give_entry(args[0], graph.aux[node], slope)
        if op == "result":
            self._ends.setdefault(args[0], {})[graph.aux[node][1]] = slope
            return None
        known = self._input(node)
        if known is not None:
            self._found[known[0]][known[1]] = slope
            return None
        if op in ("load", "carry"):
            return None
        wanted = [self._active[a] for a in args]

        apply, read, out = signs_last(graph), [*map(self._value, args)], self._value(node)
        if op == "mul" and args[0] == args[1]:  # what slopes of many squares have in common is doubled once
            return self._give(args[0], apply("mul", apply("mul", slope, graph.constant(2.0, REAL)), read[0]))
        slopes = slopes_of(op, slope, read, out, wanted, apply, lambda x: graph.constant(x, REAL))
        for argument, one in zip(args, slopes, strict=True):
            if one is not None:
                self._give(argument, one)
        return None

    def _pack(self, node: int, slopes: int) -> None:
        graph, args = self._graph, self._graph.args[node]
        known = self._input(args[0])
        orders = [] if known is None else self._orders(known[0], args)
        if known is not None and orders:  # the numbers of a large input, each as often
            parts = [slopes] if node in self._single else self._whole[node]
            terms = [term for part in parts for term in self._terms(part)]
            self._arrays.setdefault(known[0], []).extend(
                [(x, p if p is None else tuple(p[k] for k in order)) for x, p in term]
                for order in orders
                for term in terms
            )
            return
        for k, argument in enumerate(args):
            if self._active[argument]:
                self._give(argument, entry(graph, slopes, k))

    def _orders(self, slot: tuple[str, int], args: Sequence[int]) -> list[list[int]]:
        """Return where the entries of a large input are in an array that has all of them, and no others."""
        size, inputs = self._slots[slot], [self._input(a) for a in args]
        if size <= LARGE or any(known is None or known[0] != slot for known in inputs):
            return []
        places: list[list[int]] = [[] for _ in range(size)]
        for k, known in enumerate(inputs):
            places[known[1] if known is not None else 0].append(k)
        each = len(places[0])
        return [*map(list, zip(*places, strict=True))] if all(len(p) == each for p in places) else []

    def _collect(self, node: int, slopes: int) -> None:
        self._outs.setdefault(self._graph.args[node][0], {})[self._graph.aux[node][1]] = slopes

    def _loop(self, node: int) -> None:
        """A loop over the passes from the last to the first."""
        graph, depth = self._graph, STEP + 1
        here, ends, outs = graph.aux[node], self._ends.get(node, {}), self._outs.get(node, {})
        loop, number = graph.loops[here], len(graph.loops)
        back, last = Loop(loop.count, depth), loop.count - 1
        graph.loops.append(back)
        held = len(loop.collected) - len(loop.carry)
        arrays_before = [collected(graph, here, held + k) for k in range(len(loop.carry))]
        first = len(graph.op)
        earlier = [
            graph.add("load", (array,), graph.type[array], (number, last, -1), depth)
            for array in arrays_before
        ]
        after, made = self._step.body(self._step.kept[node], number, earlier, back=True)
        moving = [self._is_active(x) or k in ends for k, x in enumerate(loop.initial)]
        while True:  # which numbers of the carry have slopes
            del self._active[first:]
            self._active += [False] * (first - len(self._active))
            for x, one in zip(earlier, moving, strict=True):
                self._active.append(one and graph.type[x] == REAL)
            self._depend()
            more = [one or self._is_active(x) for one, x in zip(moving, after, strict=True)]
            if more == moving:
                break
            moving = more
        moving = [one and graph.type[x] == REAL for one, x in zip(moving, earlier, strict=True)]
        end = len(self._active)
        places = [k for k, one in enumerate(moving) if one]
        slopes = [graph.add("carry", (), REAL, (number, j), depth) for j in range(len(places))]
        self._values = self._step.held(self._step.kept[node], number, range(first, end))
        self._around, self._arrays_around, self._sums = {}, {}, (number, len(slopes))
        for k, slope in zip(places, slopes, strict=True):
            self._give(after[k], slope)
        for part, array in outs.items():
            for e, made_here in enumerate(made[part]):
                at = last * len(made[part]) + e, -len(made[part])
                self._give(made_here, graph.add("load", (array,), REAL, (number, *at), depth))
        self._sweep(first, end)
        around, arrays, self._around = self._around, self._arrays_around, None
        back.carry = slopes + [
            graph.add("carry", (), REAL, (number, len(slopes) + j), depth) for j in range(len(around))
        ]
        back.initial = [ends.get(k, self._zero) for k in places] + [self._zero] * len(around)
        back.following = [self._slope.get(earlier[k], self._zero) for k in places]
        back.following += around.values()
        fed = [
            k for k in range(first, end) if graph.op[k] == "load" and k in self._slope and k not in earlier
        ]
        back.collected = [[self._slope[k]] for k in fed]
        factors = self._factors(back, arrays)
        graph.close(number)
        results = [graph.add("result", (back.node,), REAL, (number, k)) for k in range(len(back.carry))]
        for k, slope in zip(places, results, strict=False):
            self._give(loop.initial[k], slope)
        for outside, slope in zip(around, results[len(places) :], strict=True):
            self._give(outside, slope)
        for part, k in enumerate(fed):
            (array,), (_, at, stride) = graph.args[k], graph.aux[k]
            for p in range(loop.count):
                self._give_entry(array, at + p * stride, entry(graph, collected(graph, number, part), p))
        for array, pairs in factors:
            self._give_whole(array, self._over_passes(number, graph.size(array), pairs))

    def _value(self, node: int) -> int:
        return self._values.get(node, node)

    def _factors(self, back: Loop, arrays: dict[int, list[int]]) -> list[tuple[int, list[list[Any]]]]:
        """Let a loop collect the factors of slopes by arrays outside of it: for each its place in that."""
        graph, parts = self._graph, dict[int, int]()
        found = list[tuple[int, list[list[Any]]]]()
        for array, slopes in arrays.items():
            terms = [
                term if len(term) == 2 else [*term, (self._one, None)]
                for s in slopes
                for term in self._terms(s)
            ]
            pairs = []
            for term in terms:
                pair = []
                for factor, places in term:
                    if graph.depth[factor] > STEP and factor not in parts:
                        parts[factor] = len(back.collected)
                        size = graph.size(factor)
                        nodes = (
                            [entry(graph, factor, k) for k in range(size)]
                            if self._is_array(factor)
                            else [factor]
                        )
                        back.collected.append(nodes)
                    pair.append((factor, places, parts.get(factor)))
                pairs.append(pair)
            found.append((array, pairs))
        return found

    def _is_array(self, node: int) -> bool:
        return self._graph.op[node] in ("pack", "map", "dot", "collect")

    def _over_passes(self, number: int, size: int, pairs: Sequence[Sequence[Any]]) -> int:
        """The sum over the passes of products whose factors a loop has collected."""
        graph, count = self._graph, self._graph.loops[number].count
        if len({tuple(part if part is not None else (x,) for x, _, part in pair) for pair in pairs}) > 1:
            return self._combined([self._over_passes(number, size, [pair]) for pair in pairs])
        operands = list[Operand]()
        for k, (factor, alone, part) in enumerate(pairs[0]):
            node = factor if part is None else collected(graph, number, part)
            if part is None and alone is None:
                operands.append((node, None))
                continue
            length = graph.size(factor) if part is not None and self._is_array(factor) else part is not None
            at = [(0,) * size if pair[k][1] is None else pair[k][1] for pair in pairs]
            places = tuple(p[e] + length * c for e in range(size) for c in range(count) for p in at)
            operands.append((node, places))
        if operands[1][1] is None:
            operands.reverse()
        (one, at), (other, by) = operands
        return graph.add("dot", (one, other), REAL, (size, count * len(pairs), at, by))

    def _map(self, node: int, slopes: int) -> None:
        graph, args = self._graph, self._graph.args[node]
        op, shape, *places = graph.aux[node]
        operands, here, one = [*zip(args, places, strict=True)], (slopes, _all(shape)), (self._one, None)
        read = [(self._value(a), p) for a, p in operands]
        wanted = [self._active[a] for a in args]
        if op == "mul":
            for k in (0, 1):
                if wanted[k]:
                    self._send(*operands[k], shape, here, read[1 - k])
            return

        def apply(op: str, *given: Operand) -> Operand:
            return self._mapped(op, shape, *given)

        out = (self._value(node), _all(shape))
        found = slopes_of(op, here, read, out, wanted, apply, lambda x: (graph.constant(x, REAL), None))
        for operand, slope in zip(operands, found, strict=True):
            if slope is not None:
                self._send(*operand, shape, slope, one)

    def _dot(self, node: int, slopes: int) -> None:
        args, (outs, count, *places) = self._graph.args[node], self._graph.aux[node]
        here = slopes, tuple(k // count for k in range(outs * count))
        operands = [*zip(args, places, strict=True)]
        for k in (0, 1):
            if self._active[args[k]]:
                other, at = operands[1 - k]
                self._send(*operands[k], (outs, count), here, (self._value(other), at))

    def _send(self, target: int, places: Any, shape: Sequence[int], a: Operand, b: Operand) -> None:
        """Add products, one an entry of ``shape``, to the slopes at places of a target."""
        size = math.prod(shape)
        if places is None:
            total = self._products(a, b, range(size), 1, size, shape)
            return self._give(target, entry(self._graph, total, 0))
        order = np.argsort(np.array(places), kind="stable")
        hits = np.bincount(np.array(places), minlength=self._graph.size(target))
        for times in sorted({*hits.tolist()} - {0}):
            met = np.flatnonzero(hits == times)
            chosen = [k for k in order.tolist() if hits[places[k]] == times]
            found = self._products(a, b, chosen, len(met), times, shape)
            if len(met) == len(hits):
                return self._give_whole(target, found)
            for k, place in enumerate(met.tolist()):
                self._give_entry(target, place, entry(self._graph, found, k))
        return None

    def _products(
        self, a: Operand, b: Operand, chosen: Sequence[int], outs: int, count: int, shape: Sequence[int]
    ) -> int:
        """Sums of ``count`` products each, of the chosen entries in their order."""
        graph = self._graph
        (one, at), (other, by) = ((x, None if p is None else tuple(p[k] for k in chosen)) for x, p in (a, b))
        if count > 1 or outs == 1:
            if at is None and by is None:  # a dot reads one array at least
                other, by = graph.add("pack", (other,), REAL, 1), (0,) * len(chosen)
            if by is None:
                (one, at), (other, by) = (other, by), (one, at)
            return graph.add("dot", (one, other), REAL, (outs, count, at, by))
        even = [*chosen] == [*range(math.prod(shape))]
        kept = shape if even else (outs,)
        if by is None and other == self._one:
            return one if at == _all((graph.size(one),)) else self._mapped("copy", kept, (one, at))[0]
        return self._mapped("mul", kept, (one, at), (other, by))[0]


def _all(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(range(math.prod(shape)))
