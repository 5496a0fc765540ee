"""Statements of a scalar program, in C or C++: what all back ends have in common."""

from __future__ import annotations

import abc
import contextlib
import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ..trace.graph import EXACT, IN_PLACE, NARROW, Graph, Sizes
from ..trace.tracer import NotLoweredError
from .schedule import Schedule, constants, evenly, leaves

_SHORTEST = 4  # entries that are worth a loop


class EvenRun(NamedTuple):
    """Some entries of a list: those from ``begin`` on."""

    begin: int
    length: int
    first: int = 0  # place of the first of them in what they come from
    step: int | None = None  # from place to place; None where each is an entry of its own


def runs(places: Sequence[tuple[Hashable, int]]) -> list[EvenRun]:
    """Split a list of entries into runs."""
    found, k = list[EvenRun](), 0
    while k < len(places):
        source, first = places[k]
        step, length = 0, 1
        if k + 1 < len(places) and places[k + 1][0] == source:
            step = places[k + 1][1] - first
        while k + length < len(places) and places[k + length] == (source, first + length * step):
            length += 1
        if length >= _SHORTEST:
            found.append(EvenRun(k, length, first, step))
        else:
            length = 1
            alone = found.pop().length if found and found[-1].step is None else 0
            found.append(EvenRun(k - alone, alone + 1))
        k += length
    return found


_INPUTS = ("const", "param", "elem", "result", "results", "collect", "carry", "carrys", "state", "row", "now")
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "==", "ne": "!="}
_ARRAYS = ("pack", "map", "dot", *IN_PLACE, "collect", "carrys", "results")


class StatementWriter(abc.ABC):
    """Writes statements of blocks and loops; a back end says how numbers are read and operations spelt."""

    _infix: ClassVar[dict[str, str]] = _INFIX
    _prefix: ClassVar[dict[str, str]] = {"copy": "", "neg": "-"}

    def __init__(
        self, graph: Graph, schedule: Schedule, layout: Sizes, types: dict[str, str], copies: int = 1
    ) -> None:
        self.types = types
        self.graph, self.schedule, self.layout, self.copies = graph, schedule, layout, copies
        self._index: dict[Any, int] = {}
        self._lines: list[str] = []
        self._arrays: set[str] = set()  # of constants, written already
        self._level = 1
        self._stored: dict[int, tuple[str, int]] = {}  # what is read from a buffer instead, and its place
        self._in_memory: set[int] = set()  # slots of the carry that are arrays
        self._taken_over: set[int] = set()  # maps that are computed where they are read, once
        self._remade: set[int] = set()  # maps that are, however often
        self._there: set[str] = set()  # what loops collect without a copy
        self._collected_in: dict[int, str] = {}  # arrays that are written where a loop collects them
        self._starts = {
            "row": np.cumsum([0, *layout.rows]).tolist(),
            "now": np.cumsum([0, *layout.nows]).tolist(),
            "state": np.cumsum([0, *layout.carries]).tolist(),
        }

    # What a back end says.

    def _operation(self, op: str, values: Sequence[str], type: str) -> str:
        """The expression of an operation."""
        if op in self._infix:
            text = f"{values[0]} {self._infix[op]} {values[1]}"
        else:
            text = f"{self._prefix[op]}{values[0]}" if op in self._prefix else self._call(op, values, type)
        return self._narrowed(text) if type == NARROW and op not in EXACT else text

    def _call(self, op: str, values: Sequence[str], type: str) -> str:
        return f"{op}({', '.join(values)})"

    @abc.abstractmethod
    def _narrowed(self, text: str) -> str:
        """The expression of a number rounded to float32, in a program of float64."""

    @abc.abstractmethod
    def _fma(self, a: str, b: str, c: str) -> str:
        """The expression of a b + c."""

    @abc.abstractmethod
    def _literal(self, node: int) -> str:
        """The expression of a constant."""

    @abc.abstractmethod
    def _stated(self, value: float, type: str) -> str:
        """The expression of a number that a writer knows."""

    @abc.abstractmethod
    def _buffer(self, op: str, place: int, j: int, at: str = "0") -> str:
        """The expression of an input, ``at`` further on in its buffer."""

    @abc.abstractmethod
    def _table(self, pack: int, at: str) -> str:
        """The expression of an entry of an array of constants."""

    @abc.abstractmethod
    def _nobody(self, mask: int) -> str:
        """The condition that a mask holds for no row."""

    def _typed(self, node: int, text: str) -> str:
        """A number from memory as the node's type."""
        return text

    def _function(self, body: Callable[[], None]) -> list[str]:
        self._lines, self._arrays = [], set()
        body()
        return self._lines

    def _constant_array(self, name: str, kind: str, values: Iterable[str]) -> None:
        """Write an array at the head of the function, once."""
        if name not in self._arrays:
            self._arrays.add(name)
            self._lines.insert(1, f"    static const {kind} {name}[] = {{{', '.join(values)}}};")

    def _line(self, text: str) -> None:
        self._lines.append("    " * self._level + text)

    @contextlib.contextmanager
    def _braces(self, head: str) -> Iterator[None]:
        """Write a loop or a branch around what is written inside of the context."""
        self._line(f"{head} {{")
        self._level += 1
        yield
        self._level -= 1
        self._line("}")

    def _assign(self, pairs: Sequence[tuple[str, int]]) -> None:
        """Variables of a loop become other nodes, all at once."""
        for j in range(self.copies):
            named = {name + self._copy(j): self._ref(node, j) for name, node in pairs}
            kinds = {name + self._copy(j): self._type(node) for name, node in pairs}
            moving = [(name, value) for name, value in named.items() if name != value]
            late = {name for name, _ in moving}
            for value in dict.fromkeys(value for _, value in moving if value in late):
                self._line(f"const {kinds[value]} old_{value} = {value};")
            for name, value in moving:
                self._line(f"{name} = {f'old_{value}' if value in late else value};")

    # Statements.

    def _block(self, nodes: Sequence[int]) -> None:
        for node in nodes:
            op = self.graph.op[node]
            if op in _INPUTS or node in self._taken_over or node in self._remade:
                continue
            if op == "loop":
                self._loop(self.graph.aux[node])
            elif op in ("pack", "map", "dot", *IN_PLACE):
                getattr(self, f"_{op}")(node)
            else:
                for j in range(self.copies):
                    self._line(
                        f"const {self._type(node)} t{node}{self._copy(j)} = {self._expression(node, j)};"
                    )

    def _loop(self, number: int) -> None:
        loop, live = self.graph.loops[number], sorted(self.schedule.carries.get(number, ()))
        arrays = [k for k in live if self._is_array(loop.carry[k])]
        live = [k for k in live if k not in arrays]
        for k in arrays:
            size = self.graph.size(loop.carry[k]) * self.copies
            self._line(f"{self._type(loop.carry[k])} l{number}_{k}[{size}];")
            self._copy_array(f"l{number}_{k}", loop.initial[k])
        for k in live:
            kind = self._type(loop.carry[k])
            for j in range(self.copies):
                self._line(f"{kind} l{number}_{k}{self._copy(j)} = {self._ref(loop.initial[k], j)};")
        for k in sorted(self.schedule.collected(number)):
            kind, size = self._type(loop.collected[k][0]), loop.count * len(loop.collected[k])
            self._line(f"{kind} y{number}_{k}[{size * self.copies}];")
        with self._braces(f"for (int i{number} = 0; i{number} < {loop.count}; ++i{number})"):
            body = self.schedule.body(number)
            self._collected_in |= self._collected_places(number)
            if loop.going >= 0:
                self._block([node for node in body if node <= loop.going])
                self._line(f"if ({self._nobody(loop.going)}) break;")
            self._block([node for node in body if node > loop.going])
            copied = {k for k in self.schedule.collected(number) if f"y{number}_{k}" not in self._there}
            for k in sorted(copied):
                size = len(loop.collected[k])
                for e, node in enumerate(loop.collected[k]):
                    for j in range(self.copies):
                        place = f"(i{number} * {size} + {e}) * {self.copies} + {j}"
                        self._line(f"y{number}_{k}[{place}] = {self._ref(node, j)};")
            self._assign([(f"l{number}_{k}", loop.following[k]) for k in live])
            for k in arrays:
                if loop.following[k] != loop.carry[k]:
                    self._copy_array(f"l{number}_{k}", loop.following[k])

    def _collected_places(self, number: int) -> dict[int, str]:
        """The arrays of a pass that a loop collects, and where, if a back end has no copies of them."""
        return {}

    def _copy_array(self, name: str, array: int) -> None:
        size = self.graph.size(array)
        for j in range(self.copies):
            target = self._sum(["p"], [self.copies], j)
            self._line(f"for (int p = 0; p < {size}; ++p) {name}[{target}] = {self._read(array, 'p', j)};")

    def _pack(self, node: int) -> None:
        if self._in_place(node) is not None:
            return
        self._declare(node)
        self._fill(f"a{node}", self.graph.args[node])

    def _fill(self, name: str, entries: Sequence[int]) -> None:
        """Write numbers one after the other into an array, runs of another array's entries by loops."""
        for run in runs([self._place_in_array(entry) for entry in entries]):
            for j in range(self.copies):
                if run.step is None:
                    for k in range(run.begin, run.begin + run.length):
                        self._line(f"{name}[{k * self.copies + j}] = {self._ref(entries[k], j)};")
                    continue
                target = self._sum(["p"], [self.copies], run.begin * self.copies + j)
                value = self._read_like(entries[run.begin], self._sum(["p"], [run.step], run.first), j)
                self._line(f"for (int p = 0; p < {run.length}; ++p) {name}[{target}] = {value};")

    def _place_in_array(self, entry: int) -> tuple[Any, int]:
        """Return the source of an entry, equal for entries of one array or buffer, and the place in it."""
        graph, op = self.graph, self.graph.op[entry]
        if op == "elem":
            return graph.args[entry][0], graph.aux[entry]
        if op in ("row", "now") or (op == "state" and graph.aux[entry][0] in self._in_memory):
            slot, k = graph.aux[entry]
            return (op, slot), k
        return ("same", entry), 0

    def _read_like(self, entry: int, at: str, j: int) -> str:
        """Return the text that reads another place of an entry's source."""
        graph, op = self.graph, self.graph.op[entry]
        if op == "elem":
            return self._read(graph.args[entry][0], at, j)
        if op == "state" and graph.aux[entry][0] in self._in_memory:
            return self._state(graph.aux[entry][0], at, j)
        if op in ("row", "now"):
            return self._typed(entry, self._buffer(op, self._starts[op][graph.aux[entry][0]], j, at))
        return self._ref(entry, j)

    def _state(self, slot: int, at: str, j: int) -> str:
        """Entry ``at`` of a slot of the carry that is an array."""
        return f"S{slot}[{at}]" if self.copies == 1 else f"S{slot}[({at}) * {self.copies} + {j}]"

    def _map(self, node: int) -> None:
        self._declare(node)
        self._entries(node, f"a{node}")

    def _entries(self, node: int, name: str) -> None:
        """Write the entries of a map into an array."""
        sizes = [s for s in self.graph.aux[node][1] if s > 1]
        places = [each for _, each in leaves(self.graph, self._taken_over, node)]
        names = [f"p{d}" for d in range(len(sizes))]
        strides = [math.prod(sizes[d + 1 :]) for d in range(len(sizes))]
        target = self._sum(names, strides, 0)
        with contextlib.ExitStack() as loops:
            for variable, size in zip(names, sizes, strict=True):
                loops.enter_context(
                    self._braces(f"for (int {variable} = 0; {variable} < {size}; ++{variable})")
                )
            ats = []
            for each in places:
                index = evenly(each, sizes)
                ats.append(self._lookup(each, target) if index is None else self._sum(names, *index))
            for j in range(self.copies):
                value = self._mapped(node, iter(ats), j)
                self._line(f"{name}[({target}) * {self.copies} + {j}] = {value};")

    def _mapped(self, node: int, ats: Iterator[str], j: int) -> str:
        """The expression of one entry of a map, its `leaves` read at ``ats``."""
        op, _, *places = self.graph.aux[node]
        values = []
        for operand, place in zip(self.graph.args[node], places, strict=True):
            if operand in self._taken_over:
                values.append(f"({self._mapped(operand, ats, j)})")
                continue
            at = next(ats)
            values.append(self._ref(operand, j) if place is None else self._read(operand, at, j))
        return self._operation(op, values, self.graph.type[node])

    def _declare(self, node: int) -> None:
        kind, size = self._type(node), self.graph.size(node) * self.copies
        if node not in self._collected_in:
            return self._line(f"{kind} a{node}[{size}];")
        whole = self._collected_in[node]
        self._there.add(whole)
        number = whole[1:].partition("_")[0]
        return self._line(f"{kind} *const a{node} = {whole} + i{number} * {size};")

    def _sum(self, names: Sequence[str], strides: Sequence[int], start: int) -> str:
        terms = [n if s == 1 else f"{n} * {s}" for n, s in zip(names, strides, strict=True) if s]
        return " + ".join([*terms, str(start)] if start or not terms else terms)

    def _lookup(self, place: Any, at: str = "p") -> str:
        if place is None:
            return "0"
        name = f"m{self._index.setdefault(('places', place), len(self._index))}"
        self._constant_array(name, "short", map(str, place))
        return f"{name}[{at}]"

    # Expressions.

    def _expression(self, node: int, j: int) -> str:
        graph, args = self.graph, self.graph.args[node]
        op = graph.op[node]
        if node in self.schedule.fused:
            place = self.schedule.fused[node]
            product = graph.args[args[place]]
            a, b = (self._ref(factor, j) for factor in product)
            other = self._ref(args[1 - place], j)
            if op == "add":
                return self._fma(a, b, other)
            return self._fma(f"-{a}", b, other) if place == 1 else self._fma(a, b, f"-{other}")
        if op == "load":
            _, at, stride = graph.aux[node]
            return self._read(args[0], f"{at} + i{graph.aux[node][0]} * {stride}", j)
        return self._operation(op, [self._ref(a, j) for a in args], graph.type[node])

    def _ref(self, node: int, j: int) -> str:
        graph, op, copy = self.graph, self.graph.op[node], self._copy(j)
        if op in ("const", "param"):
            return self._literal(node)
        if op == "elem":
            return self._read(graph.args[node][0], str(graph.aux[node]), j)
        if op in ("row", "now"):
            slot, k = graph.aux[node]
            return self._typed(node, self._buffer(op, self._starts[op][slot] + k, j))
        if op == "state":
            slot, k = graph.aux[node]
            return (
                self._state(slot, str(k), j)
                if slot in self._in_memory
                else f"s{self._starts[op][slot] + k}{copy}"
            )
        if op in ("carry", "result"):
            if op == "result" and node in self._stored:
                return self._typed(node, self._buffer(*self._stored[node], j))
            number, k = graph.aux[node]
            return f"l{number}_{k}{copy}"
        if node in self._stored:
            return self._typed(node, self._buffer(*self._stored[node], j))
        return f"t{node}{copy}"

    def _read(self, array: int, at: str, j: int) -> str:
        """Entry ``at`` of an array."""
        graph = self.graph
        if array in self._remade:
            return f"({self._made_again(array, at, j)})"
        if constants(graph, array):
            return self._table(array, at)
        if array in self._stored:
            return self._typed(array, self._buffer(*self._stored[array], j, at))
        place = self._in_place(array)
        if place is not None and place[0] == "state":
            slot = graph.aux[graph.args[array][0]][0]
            return self._state(slot, self._sum([f"({at})"], [1], place[1]), j)
        if place is not None:
            return self._typed(array, self._buffer(*place, j, at))
        name = self._name(array)
        return f"{name}[{at}]" if self.copies == 1 else f"{name}[({at}) * {self.copies} + {j}]"

    def _name(self, array: int) -> str:
        graph = self.graph
        if graph.op[array] in ("collect", "carrys", "results"):
            number, k, _ = graph.aux[array]
            return f"{'y' if graph.op[array] == 'collect' else 'l'}{number}_{k}"
        return f"a{array}"

    def _made_again(self, node: int, at: str, j: int) -> str:
        """The expression of an entry of a map that is not kept."""
        sizes = [s for s in self.graph.aux[node][1] if s > 1]
        below = [math.prod(sizes[d + 1 :]) for d in range(len(sizes))]
        names = [f"((unsigned)({at}) / {b} % {size})" for b, size in zip(below, sizes, strict=True)]
        ats = []
        for _, places in leaves(self.graph, self._taken_over, node):
            flat, index = evenly(places, [math.prod(sizes)]), evenly(places, sizes)
            if places is not None and at.isdigit():
                ats.append(str(places[int(at)]))
            elif flat is not None:
                ats.append(self._sum([f"({at})"], *flat))
            else:
                ats.append(self._lookup(places, at) if index is None else self._sum(names, *index))
        return self._mapped(node, iter(ats), j)

    def _in_place(self, pack: int) -> tuple[str, int] | None:
        """Return the place in a buffer of inputs where the entries of a pack lie in order already."""
        graph = self.graph
        if graph.op[pack] != "pack":
            return None
        args = graph.args[pack]
        op = graph.op[args[0]]
        if constants(graph, pack):
            return "table", 0
        if op == "state":  # nothing is written there before the end of a step
            slot, start = graph.aux[args[0]]
            whole = [("state", (slot, start + k)) for k in range(len(args))]
            fits = slot in self._in_memory and [(graph.op[a], graph.aux[a]) for a in args] == whole
            return (op, start) if fits else None
        if op not in ("row", "now") or any(graph.op[a] != op for a in args):
            return None
        places = [self._starts[op][graph.aux[a][0]] + graph.aux[a][1] for a in args]
        first = places[0]
        return (op, first) if places == list(range(first, first + len(places))) else None

    def _is_array(self, node: int) -> bool:
        return self.graph.op[node] in _ARRAYS

    def _type(self, node: int) -> str:
        kind = self.graph.type[node]
        if kind not in self.types:
            raise NotLoweredError("float64 inside a program of float32 cannot be compiled")
        return self.types[kind]

    def _copy(self, j: int) -> str:
        return f"_{j}" if self.copies > 1 else ""
