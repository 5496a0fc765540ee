"""A scalar program as C++: a row in every lane of a vector register, tiles of rows, the times inside.

Vectors of GCC and Clang (`V`) are the variables, so that g++ sees straight-line arithmetic: vectorising loops
over rows is left to no optimiser. One or two vectors of rows advance side by side, as dependent steps of a
recursion would leave the units idle. The driver that cuts tiles and threads is `_driver.hpp`.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from typing import ClassVar

from ..trace.graph import FLAG, IN_PLACE, NARROW, NOW, REAL, ROW, STEP, WHOLE, Graph, Sizes
from .schedule import Schedule, constants, evenly
from .tables import TableWriter, Text

_FEW = 400  # nodes of a program of which two vectors fit the registers and caches side by side
_WRITTEN_OUT = 8  # entries of an output that are stored one by one
_CALLED = 64  # functions beyond which each is compiled once and called: written out, one takes g++ 20 ms
_LIBRARY = frozenset(("exp", "expm1", "log", "log1p", "sin", "cos", "tan", "tanh"))
_MANY = 1500  # nodes of which even a matrix that the vectors share does not pay for twice the text
_NEAR = 32  # numbers that loops collected, of each time and row
_COSTLY, _MEMORY = 20, 4  # operations that a function takes, and that a number written and read is worth
_FUNCTIONS = _LIBRARY | {"atan2", "pow", "sqrt", "div"}
_OF_NO_WORK = "const param row now state elem carry result carrys results collect pack loop"
_FREE = frozenset(_OF_NO_WORK.split())
_MOST_WORK = 2**30  # so that products with it are numbers of 64 bits


def emit(graph: Graph, layout: Sizes, following: Sequence[int], outputs: Sequence[int], copies: int) -> Text:
    """Write a program of nodes: ``following`` are the carry after a step, ``outputs`` what it puts out.

    ``copies`` vectors advance side by side; 0 for as many as suit many rows.
    """
    schedule = Schedule(graph, following, outputs, ahead=True)
    if not _worth(graph, schedule):
        schedule = Schedule(graph, following, outputs)
    writer = _CppWriter(graph, schedule, layout, copies or _copies(schedule))
    return writer.write(following, outputs)


def _worth(graph: Graph, schedule: Schedule) -> bool:
    """Return whether to compute ahead what times alone decide, although it goes through memory.

    What loops collected for the passes of an adjoint would not stay in the nearest cache.
    """
    if sum(graph.size(n) for n in schedule.cut_ahead() if graph.op[n] == "collect") > _NEAR:
        return False
    work = sum(_COSTLY if graph.op[n] in _FUNCTIONS else 1 for n in schedule.ahead if graph.op[n] != "now")
    return work > _MEMORY * len(schedule.cut_ahead())


def _work(graph: Graph, schedule: Schedule) -> dict[str, int]:
    """Return the operations of a row before its steps, and of a step: by them threads are called.

    A loop counts with all of its passes, one that rows may leave with an eighth.
    """
    once = step = 0
    for node in schedule.live:
        op, count = graph.op[node], graph.size(node)
        if op in _FREE:
            continue
        if op in IN_PLACE:
            count, op = graph.aux[node][1][0] ** 3, "add"
        elif op in ("map", "dot"):
            count *= graph.aux[node][1] if op == "dot" else 1
            op = "add" if op == "dot" else graph.aux[node][0]
        count *= schedule.repeats(node, skipped=8) * (_COSTLY if op in _FUNCTIONS else 1)
        if schedule.once(node):
            once += count
        else:
            step += count
    return {"WORK_ROW": min(once, _MOST_WORK), "WORK_STEP": min(step, _MOST_WORK)}


def _copies(schedule: Schedule) -> int:
    """Return the number of vectors that advance side by side, so that the processor is never idle."""
    steps = schedule.live - schedule.ahead
    waits = len(steps) < _MANY and any(map(schedule.reads_back, steps))  # for the pass before
    shares = len(steps) < _MANY and any(schedule.shares_a_matrix(node) for node in steps)
    return 2 if len(steps) < _FEW or shares or waits else 1


class _CppWriter(TableWriter):
    _infix: ClassVar[dict[str, str]] = TableWriter._infix | {"and": "&", "or": "|", "xor": "^"}
    _prefix: ClassVar[dict[str, str]] = TableWriter._prefix | {"not": "~", "cast": ""}

    def __init__(self, graph: Graph, schedule: Schedule, layout: Sizes, copies: int) -> None:
        super().__init__(graph, schedule, layout, {REAL: "V", NARROW: "V", WHOLE: "V", FLAG: "M"}, copies)

    def write(self, following: Sequence[int], outputs: Sequence[int]) -> Text:
        rows = sum(self.layout.rows)
        stored, fixed = self._places("row", self.schedule.cut(), rows)
        copies, self.copies = self.copies, 1
        prepare = self._function(lambda: self._prepare(stored))
        self._stored = stored
        found, numbers = self._places("ahead", self.schedule.cut_ahead(), sum(self.layout.nows))
        ahead = self._function(lambda: self._ahead(found))
        self._stored, self.copies = stored | found, copies
        advance = self._function(lambda: self._advance(following, outputs))
        layout = self.layout
        counts = {"ROWS": rows, "FIXED": fixed, "NOWS": sum(layout.nows), "AHEAD": numbers}
        counts |= {
            "CARRIES": sum(layout.carries),
            "SLOTS_ROW": len(layout.rows),
            "SLOTS_NOW": len(layout.nows),
        }
        counts |= {"SLOTS_CARRY": len(layout.carries), "COPIES": self.copies, "TILE": 64}
        counts |= _work(self.graph, self.schedule)
        single, graph = self.graph.single, self.graph
        used = {graph.aux[node][0] for node in self.schedule.live if graph.op[node] == "now"}
        read = [str(int(k in used)) for k in range(max(1, len(layout.nows)))]
        functions = sum(graph.op[node] in _LIBRARY for node in self.schedule.live) * self.copies
        calls = ["#define LANES_CALLS 1"] if functions > _CALLED else []
        head = [f"#define LANES_SINGLE {int(single)}", f"#define REAL {'float' if single else 'double'}"]
        head += [
            *calls,
            '#include "_lanes.hpp"',
            f"constexpr int {', '.join(f'{k} = {v}' for k, v in counts.items())};",
            f"constexpr bool READ[] = {{{', '.join(read)}}};",
        ]
        source = [*head, '#include "_driver.hpp"', *prepare, *ahead, *advance]
        return Text("\n".join(source) + "\n", self.table, self.parameters)

    def _places(
        self, buffer: str, nodes: Sequence[int], start: int
    ) -> tuple[dict[int, tuple[str, int]], int]:
        """Return the nodes' places in a buffer, and how many numbers they take."""
        places, taken = dict[int, tuple[str, int]](), 0
        for node in nodes:
            if self._in_place(node) is None:
                places[node] = buffer, start + taken
                taken += self.graph.size(node)
        return places, taken

    def _ahead(self, stored: dict[int, tuple[str, int]]) -> None:
        self._lines.append("static void ahead(const Frame &f) {")
        self._line("const REAL *const c = f.c, *const fixed = f.fixed;")
        self._line("(void)c, (void)fixed;")
        with self._braces(f"for (int n = 0; n < {'f.times * f.rows' if stored else '0'}; n += W)"):
            self._line("const REAL *const now = f.now + n;")
            self._line("(void)now;")
            self._block(self.schedule.block(NOW))
            self._keep(stored, "f.now + n", "f.span")
        self._lines.append("}")

    def _keep(self, stored: dict[int, tuple[str, int]], start: str, stride: str) -> None:
        for node, (_, place) in stored.items():
            for j in range(self.copies):
                loop, k, value = "", str(place), self._ref(node, j)
                if self._is_array(node):
                    loop = f"for (int p = 0; p < {self.graph.size(node)}; ++p) "
                    k, value = f"({place} + p)", self._read(node, "p", j)
                self._line(f"{loop}store({start} + {k} * {stride} + {j} * W, {self._number(node, value)});")

    def _prepare(self, stored: dict[int, tuple[str, int]]) -> None:
        self._lines.append("static void prepare(const Frame &f, int b) {")
        self._line("const REAL *const c = f.c, *const fixed = f.fixed + b;")
        self._line("(void)c, (void)fixed;")
        self._block(self.schedule.block(ROW))
        self._keep(stored, "f.fixed + b", "room")
        self._lines.append("}")

    def _advance(self, following: Sequence[int], outputs: Sequence[int]) -> None:
        self._lines.append("static void advance(const Frame &f, int b, int rows) {")
        self._line("const REAL *const c = f.c, *const fixed = f.fixed + b;")
        self._line("(void)c, (void)fixed, (void)rows;")
        slots = self._slots(following)
        self._find_ends(slots)
        for slot, _, nodes in slots:
            if slot in self._in_memory:
                self._line(f"{self._type(nodes[0])} S{slot}[{len(nodes) * self.copies}];")
        for name, loop, place, node, j in self._carried(slots):
            read = "load_flag" if self.graph.type[node] == FLAG else "load"
            kind = "" if loop else f"{self._type(node)} "
            self._line(f"{loop}{kind}{name} = {read}(f.carry + b + {place} * room + {j} * W);")
        self._line("Recorder recorder(f);")
        with self._braces("for (int t = 0; t < f.times; ++t)"):
            self._line("const REAL *const now = f.now + t * f.step + b;")
            self._line("(void)now;")
            self._steps(following)
            self._outputs(outputs)
            self._follow(slots)
        for name, loop, place, node, j in self._carried(slots):
            number = self._number(node, name)
            self._line(f"{loop}store(f.carry + b + {place} * room + {j} * W, {number});")
        self._lines.append("}")

    def _carried(
        self, slots: Sequence[tuple[int, int, Sequence[int]]]
    ) -> Iterator[tuple[str, str, str, int, int]]:
        """The variables of the carry: name, the loop around it, place, a node of its type, copy."""
        for slot, start, nodes in slots:
            if slot in self._in_memory:
                loop = f"for (int p = 0; p < {len(nodes)}; ++p) "
                for j in range(self.copies):
                    yield self._state(slot, "p", j), loop, f"({start} + p)", nodes[0], j
                continue
            for k, node in enumerate(nodes, start):
                for j in range(self.copies):
                    yield f"s{k}{self._copy(j)}", "", str(k), node, j

    def _steps(self, following: Sequence[int]) -> None:
        """Write a step for a processor that is to expect that no row stays behind.

        A mask that decides of half the carry or more whether it goes on or stays as it was becomes a branch:
        where it holds in all lanes, the next step need not wait for it.
        """
        nodes = self.schedule.block(STEP)
        mask, held = self._choices(following)
        kept, waiting, last = [node for node in nodes if node in held], set(held), list[int]()
        for node in nodes:
            if node not in held and not waiting.isdisjoint(self._read_by(node)):
                waiting.add(node)
                last.append(node)
        if not kept or any(not waiting.isdisjoint(self._read_by(node)) for node in kept):
            return self._block(nodes)
        self._block([node for node in nodes if node not in waiting])
        pairs = [(node, j) for j in range(self.copies) for node in kept]
        for node, j in pairs:
            going_on = self._ref(self.graph.args[node][1], j)
            self._line(f"{self._type(node)} t{node}{self._copy(j)} = {going_on};")
        stays = " | ".join(f"~{self._ref(mask, j)}" for j in range(self.copies))
        self._line(f"if (__builtin_expect(any({stays}), 0)) {{")
        for node, j in pairs:
            self._line(f"    t{node}{self._copy(j)} = {self._expression(node, j)};")
        self._line("}")
        self._block(last)

    def _choices(self, following: Sequence[int]) -> tuple[int, set[int]]:
        """The mask that lets most of the carry go on, and all choices of it between that and staying."""
        graph, masks = self.graph, Counter[int]()
        choices = [n for n in self.schedule.block(STEP) if graph.op[n] == "where"]
        choices = [n for n in choices if graph.op[graph.args[n][2]] == "state"]
        masks.update(graph.args[n][0] for n in choices if n in following)
        mask, count = masks.most_common(1)[0] if masks else (-1, 0)
        return mask, {n for n in choices if graph.args[n][0] == mask and 2 * count >= len(following)}

    def _read_by(self, node: int) -> set[int]:
        """The nodes that the statement of a node reads."""
        args, place = self.graph.args[node], self.schedule.fused.get(node)
        return set(args) if place is None else {*args, *self.graph.args[args[place]]}

    def _outputs(self, outputs: Sequence[int]) -> None:
        if not outputs:
            return
        with self._braces("if (recorder.due())"):
            done = 0
            for slot, size in enumerate(self.layout.outputs):
                entries = outputs[done : done + size]
                with self._braces(f"if (f.data[{slot}])") if self._kept(slot, entries) else nullcontext():
                    if size > _WRITTEN_OUT:
                        self._put_by_loop(slot, entries)
                    else:
                        for (e, node), j in itertools.product(enumerate(entries), range(self.copies)):
                            self._line(self._put(slot, str(e), self._number(node, self._ref(node, j)), j))
                done += size

    def _kept(self, slot: int, entries: Sequence[int]) -> bool:
        """Return whether an output is a leaf of the carry that a gradient may want, or not."""
        graph, leaf = self.graph, slot - len(self.layout.outputs) + len(self.layout.carries)
        states = [("state", (leaf, entry)) for entry in range(len(entries))]
        return [(graph.op[node], graph.aux[node]) for node in entries] == states

    def _put(self, slot: int, entry: str, value: str, j: int) -> str:
        return f"recorder.put({slot}, {entry}, b + {j} * W, rows - {j} * W, {value});"

    def _put_by_loop(self, slot: int, entries: Sequence[int]) -> None:
        """Outputs of many entries: their stores, written out, can take g++ longer than all the rest."""
        name, first = f"o{slot}", entries[0]
        self._line(f"{self._type(first)} {name}[{len(entries) * self.copies}];")
        self._fill(name, entries)
        with self._braces(f"for (int p = 0; p < {len(entries)}; ++p)"):
            for j in range(self.copies):
                place = self._sum(["p"], [self.copies], j)
                self._line(self._put(slot, "p", self._number(first, f"{name}[{place}]"), j))

    def _expression(self, node: int, j: int) -> str:
        """An exponential of -x as one of x: the compiler finds once what it has in common with e^x."""
        graph = self.graph
        of_minus = graph.op[node] == "exp" and graph.op[graph.args[node][0]] == "neg"
        if of_minus and graph.type[node] != NARROW:
            return f"exp_of_minus({self._ref(graph.args[graph.args[node][0]][0], j)})"
        return super()._expression(node, j)

    def _collected_places(self, number: int) -> dict[int, str]:
        graph, loop, found = self.graph, self.graph.loops[number], dict[int, str]()
        body = set(self.schedule.body(number))
        packs = {graph.args[node]: node for node in body if graph.op[node] == "pack"}
        for k in sorted(self.schedule.collected(number)):
            part = tuple(loop.collected[k])
            array = graph.args[part[0]][0] if graph.op[part[0]] == "elem" else packs.get(part, -1)
            entries = [("elem", (array,), e) for e in range(len(part))]
            whole = part in packs or [(graph.op[e], graph.args[e], graph.aux[e]) for e in part] == entries
            if array in body and whole and graph.size(array) == len(part):
                found.setdefault(array, f"y{number}_{k}")
        return found

    def _panels(self, node: int) -> None:
        """Products with a matrix of the table by a function of their own, which has all registers."""
        graph, (outs, count, *places) = self.graph, self.graph.aux[node]
        known = [constants(graph, a) for a in graph.args[node]]
        indices = [evenly(place, [outs, count]) for place in places]
        matrix, vector = (0, 1) if known[0] else (1, 0)
        (by, at), x = (indices[matrix], indices[vector]), graph.args[node][vector]
        alone = self.copies == 1 and graph.type[node] == REAL and known[matrix] and self._has_name(x)
        if not alone or by is None or at is None or at[0][0]:
            return super()._panels(node)
        (row, step), first = by
        sizes = ", ".join(map(str, (outs, count, row, step, at[0][1])))
        table = f"c + {self._entries_of(graph.args[node][matrix]) + first}"
        return self._line(f"products<{sizes}>({table}, {self._name(x)} + {at[1]}, a{node});")

    def _has_name(self, array: int) -> bool:
        """Return whether an array of numbers lies in memory of its own."""
        elsewhere = array in self._remade or array in self._stored or array in self._taken_over
        real = self.graph.type[array] == REAL and self._is_array(array)
        return real and not elsewhere and self._in_place(array) is None

    def _nobody(self, mask: int) -> str:
        return f"!any({' | '.join(self._ref(mask, j) for j in range(self.copies))})"

    def _narrowed(self, text: str) -> str:
        return f"narrowed({text})"

    def _fma(self, a: str, b: str, c: str) -> str:
        return f"fma({a}, {b}, {c})"

    def _buffer(self, op: str, place: int, j: int, at: str = "0") -> str:
        where, stride = ("fixed", "room") if op == "row" else ("now", "f.span")
        index = f"{place}" if at == "0" else f"({place} + {at})"
        return f"load({where} + {index} * {stride}{f' + {j} * W' if j else ''})"

    def _typed(self, node: int, text: str) -> str:
        return f"({text} != V{{}})" if self.graph.type[node] == FLAG else text

    def _number(self, node: int, text: str) -> str:
        return f"number({text})" if self.graph.type[node] == FLAG else text

    def _stated(self, value: float, type: str) -> str:
        return f"splat(REAL({value!r}))"

    def _literal(self, node: int) -> str:
        if self.graph.op[node] == "param":
            return self._typed(node, f"splat(c[{self._entry(node)}])")
        value = self.graph.value(node)
        if isinstance(value, bool):
            return f"all_of({str(value).lower()})"
        assert value is not None
        if math.isnan(value):
            return 'splat(REAL(__builtin_nan("")))'
        if math.isinf(value):
            return f"splat(REAL({'-' if value < 0 else ''}__builtin_inf()))"
        if abs(value) <= 1024 and value * 64 == int(value * 64):
            return f"splat(REAL({value!r}))"
        return f"splat(c[{self._entry(node)}])"

    def _table(self, pack: int, at: str) -> str:
        return self._typed(pack, f"splat(c[{self._entries_of(pack)} + {at}])")
