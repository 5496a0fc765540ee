"""A row program as CUDA C, a thread a row, all times inside.

Inputs are read where they lie, by strides and in their own dtypes; what is written lies with the rows
innermost, so that the threads of a warp write one line. A number that the step captured stands in a table:
in the kernel's arguments, which a multiplication reads as fast as a register, or in memory where it is
long. The same text is C++ for the host, with loops in place of the grid.

Arrays of a thread that live one after the other lie in the same memory. As in register allocation by linear
scan (Poletto and Sarkar, 1999), an array lives from its declaration to the last line that names it, and
takes a place that is free by then. Declared one by one, all of them would take memory at once.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch

from ..trace.graph import FLAG, NARROW, REAL, ROW, STEP, WHOLE, WIDE, Graph, Sizes
from ..trace.tracer import LARGE, NotLoweredError
from .c import Names, ScalarWriter, random_numbers
from .schedule import Schedule, made_again
from .tables import TableWriter, Text

KERNEL = "lanes_kernel"
_KINDS = ("row", "now", "carry", "out")
_IN_ARGUMENTS = 12 * 1024  # bytes of a table that come with the arguments of a kernel
_CONSTANT = 48 * 1024  # bytes of arrays that constant memory holds
_SIZES = {"short": 2, "int": 4, "float": 4, "double": 8}
_OF_C = {
    torch.float64: "double",
    torch.float32: "float",
    torch.int64: "long long",
    torch.int32: "int",
    torch.int16: "short",
    torch.int8: "signed char",
    torch.uint8: "unsigned char",
    torch.bool: "unsigned char",
}
_LOOP = re.compile(r"for \(int ([pq]\w*) = \d+; [pq]\w* < (\d+);")
_UNROLLED = 16  # passes over an array that a compiler may write out
_WHOLE = 36  # entries that it is to write out, so that they may be in registers
_KNOWN = 256  # numbers of an array that it knows, where a pass that is written out has one of them
_PARTS = {"i0_2": 4, "u2 =": 2}  # passes over parts of a matrix that are written out
FEWER_REGISTERS = "-DFEWER_REGISTERS"
"""An option for a compiler that has too few registers: sums of products are not written out all at once."""
_SHARED_BLOCK = 32
"""Threads of a block at most, of a kernel that keeps in shared memory what registers have no room for."""
_PRELUDE = """#ifndef NAN
#define NAN __int_as_float(0x7fffffff)
#endif
#ifndef INFINITY
#define INFINITY __int_as_float(0x7f800000)
#endif
#ifdef FEWER_REGISTERS
constexpr int PANELS = 1;
#else
constexpr int PANELS = 16;
#endif
#ifndef OFFSET
#define OFFSET int
#endif
#ifdef UNIT
#define ENTRY(name) 1
#else
#define ENTRY(name) (OFFSET)call.name##_entry
#endif
"""


class Dtypes(NamedTuple):
    """Dtypes of what a kernel reads and writes."""

    rows: Sequence[torch.dtype]
    nows: Sequence[torch.dtype]
    carries: Sequence[torch.dtype]
    outputs: Sequence[torch.dtype]


def emit_cuda(
    graph: Graph, layout: Sizes, following: Sequence[int], outputs: Sequence[int], dtypes: Dtypes
) -> Text:
    """Write the kernel of a program: ``following`` are the carry after a step, ``outputs`` what it puts out.

    Its one argument is a structure: the addresses of row0, ..., now0, ..., carry0, ..., of the carry in the
    end and of out0, ...; the table, or its address where it is long or with `FAR`; for each input the strides
    from row to row, from time to time and from entry to entry; the numbers of rows, times and times from one
    recorded to the next. Offsets in what is written, and from entry to entry, are of the type `OFFSET`,
    32 bits by default. With `UNIT` the entries of every input lie side by side.

    Raises:
        NotLoweredError: if an operation, or a dtype, has no scalar form.
    """
    names = Names(
        *([f"{kind}{k}" for k in range(len(sizes))] for kind, sizes in zip(_KINDS, layout, strict=True))
    )
    writer = _CudaWriter(graph, Schedule(graph, following, outputs), layout, names, dtypes)
    return writer.write(following, outputs)


class _CudaWriter(ScalarWriter, TableWriter):
    _side = 5

    def __init__(self, graph: Graph, schedule: Schedule, layout: Sizes, names: Names, dtypes: Dtypes) -> None:
        super().__init__(graph, schedule, layout, names)
        self._all, self._dtypes = names, dtypes
        self._remade = made_again(graph, schedule, LARGE) - self._taken_over
        self._constants: list[str] = []
        self._held = 0  # bytes of them

    def write(self, following: Sequence[int], outputs: Sequence[int]) -> Text:
        body = in_rooms(self._function(lambda: self._body(following, outputs)), LARGE)
        source = [_PRELUDE + "\n".join(self._arguments()), *self._constants]
        source += random_numbers(body, self.real, "__device__ inline")
        source += [f'extern "C" __global__ void {KERNEL}(const __grid_constant__ Call call)', *body]
        return Text("\n".join(source) + "\n", self.table, self.parameters)

    def _arguments(self) -> list[str]:
        names, dtypes, real = self._all, self._dtypes, self.real
        read = [*zip(names.rows, dtypes.rows, strict=True), *zip(names.nows, dtypes.nows, strict=True)]
        read += zip(names.carries, dtypes.carries, strict=True)
        written = [(f"{name}_end", dtype) for name, dtype in zip(names.carries, dtypes.carries, strict=True)]
        written += zip(names.outputs, dtypes.outputs, strict=True)
        lines = [f"    const {_type_of(dtype)} *{name};" for name, dtype in read]
        lines += [f"    {_type_of(dtype)} *{name};" for name, dtype in written]
        size = max(len(self.table), 1)
        far = f"    const {real} *c;", "#define TABLE(at) __ldg(call.c + (at))"
        near = f"    {real} c[{size}];", "#define TABLE(at) call.c[at]"
        choice = ("#ifdef FAR", *far, "#else", *near, "#endif")
        lines += choice if in_arguments(size, self.graph.single) else far
        lines += [f"    long long {name}_row, {name}_time, {name}_entry;" for name, _ in read]
        return [
            "struct Call {",
            *lines,
            "    long long rows;",
            "    int times, every;",
            "};",
        ]

    def _line(self, text: str) -> None:
        """A line; a loop over few entries is written out by the compiler, one over many is not."""
        loop = _LOOP.match(text)
        if loop and loop[1] in ("p", "q") and int(loop[2]) <= _WHOLE:
            super()._line("#pragma unroll PANELS" if "p +=" in text else "#pragma unroll")
        elif loop and int(loop[2]) > _UNROLLED:
            super()._line("#pragma unroll 4")
        elif loop and loop[1][1:]:  # over a dimension of an array
            some = max(n for n in range(1, 6) if int(loop[2]) % n == 0) if loop[1] != "p0" else 1
            super()._line(f"#pragma unroll {some}")
        elif loop is None and text.startswith(("for (int i0_", "for (int u")):  # over parts of a matrix
            super()._line(f"#pragma unroll {_PARTS.get(text[9:13], 1)}")
        super()._line(text)

    def _constant_array(self, name: str, kind: str, values: Iterable[str]) -> None:
        if name in self._arrays:
            return
        self._arrays.add(name)
        written = [*values]
        size = len(written) * _SIZES[kind]
        fits = self._held + size <= _CONSTANT
        if len(written) <= _KNOWN:
            memory = "__device__ constexpr"
        else:
            self._held += size if fits else 0
            memory = "__constant__" if fits else "__device__ const"
        self._constants.append(f"{memory} {kind} {name}[] = {{{', '.join(written)}}};")

    # Numbers that are read.

    def _fma(self, a: str, b: str, c: str) -> str:
        return f"fma{self._suffix}({a}, {b}, {c})"

    def _buffer(self, op: str, place: int, j: int, at: str = "0") -> str:
        slot, entry = self._slot(op, place)
        name, starts = self._names[op][slot], self._starts[op]
        single = starts[slot + 1] - starts[slot] == 1
        index = f"{entry}" if at == "0" else f"({entry} + {at})" if entry else f"({at})"
        step = "" if single or index == "0" else f" + {index} * {name}_entry"
        return self._read_as_real(f"__ldg({name}{step})", self._dtype(op, slot))

    def _dtype(self, op: str, slot: int) -> torch.dtype:
        held = self._dtypes
        return {"row": held.rows, "now": held.nows, "state": held.carries}[op][slot]

    def _read_as_real(self, text: str, dtype: torch.dtype) -> str:
        """A number from memory as the program's float, or as double where that is its own."""
        kind = _type_of(dtype)
        wide = "double" if dtype == torch.float64 else self.real
        return text if kind == wide else f"({wide}){text}"

    def _literal(self, node: int) -> str:
        if self.graph.op[node] == "param":
            return self._typed(node, f"TABLE({self._entry(node)})")
        return super()._literal(node)

    def _table(self, pack: int, at: str) -> str:
        if all(self.graph.op[node] == "const" for node in self.graph.args[pack]):
            return super()._table(pack, at)
        start = self._entries_of(pack)
        return self._typed(pack, f"TABLE({start} + {at})" if start else f"TABLE({at})")

    # The kernel.

    def _body(self, following: Sequence[int], outputs: Sequence[int]) -> None:
        names = self._all
        self._lines.append("{")
        self._line("const OFFSET rows = call.rows, r = (OFFSET)blockIdx.x * blockDim.x + threadIdx.x;")
        self._line("if (r >= rows) return;")
        for op, some in (("row", names.rows), ("now", names.nows), ("state", names.carries)):
            for slot, name in enumerate(some):
                kind = _type_of(self._dtype(op, slot))
                moves = "" if op == "now" else "const "
                self._line(f"const {kind} *{moves}{name} = call.{name} + r * call.{name}_row;")
                self._line(f"const OFFSET {name}_entry = ENTRY({name});")
        self._block(self.schedule.block(ROW))
        slots = self._slots(following)
        self._find_ends(slots)
        for slot, start, nodes in slots:
            self._begin(slot, start, nodes)
        self._line("OFFSET place = r;")
        with self._braces("for (int t = 0, due = 0; t < call.times; ++t)"):
            self._block(self.schedule.block(STEP))
            self._write_outputs(outputs)
            self._follow(slots)
            for name in names.nows:
                self._line(f"{name} += call.{name}_time;")
        for slot, start, nodes in slots:
            self._end(slot, start, nodes)
        self._lines.append("}")

    def _begin(self, slot: int, start: int, nodes: Sequence[int]) -> None:
        kind = self._type(nodes[0]) if nodes else ""
        if slot in self._in_memory:
            self._line(f"{kind} S{slot}[{len(nodes)}];")
            value = self._typed(nodes[0], self._buffer("state", start, 0, "p"))
            self._line(f"for (int p = 0; p < {len(nodes)}; ++p) S{slot}[p] = {value};")
            return
        for place, node in enumerate(nodes, start):
            value = self._typed(node, self._buffer("state", place, 0))
            self._line(f"{kind} s{place} = {value};")

    def _end(self, slot: int, start: int, nodes: Sequence[int]) -> None:
        name, dtype = f"call.{self._all.carries[slot]}_end", self._dtypes.carries[slot]
        with self._braces(f"if ({name})"):
            if slot in self._in_memory:
                value = _as(dtype, self.real, f"S{slot}[p]", self.graph.type[nodes[0]])
                loop = f"for (int p = 0; p < {len(nodes)}; ++p)"
                self._line(f"{loop} {name}[(OFFSET)p * rows + r] = {value};")
                return
            for e, node in enumerate(nodes):
                value = _as(dtype, self.real, f"s{start + e}", self.graph.type[node])
                self._line(f"{name}[{_times('rows', e)}r] = {value};")

    def _write_outputs(self, outputs: Sequence[int]) -> None:
        if not outputs:
            return
        with self._braces("if (due == 0)"):
            self._line("due = call.every;")
            done = 0
            for name, size, dtype in zip(
                self._all.outputs, self.layout.outputs, self._dtypes.outputs, strict=True
            ):
                self._write_output(name, outputs[done : done + size], dtype)
                done += size
            self._line("place += rows;")
        self._line("--due;")

    def _write_output(self, name: str, nodes: Sequence[int], dtype: torch.dtype) -> None:
        """Entries of an output: those of row r at a time begin at (size * recorded) * rows + r."""
        size = len(nodes)
        at = "place" if size == 1 else f"{size} * place - {size - 1} * r"
        if size > LARGE:
            array = f"o_{name}"
            self._line(f"{self._type(nodes[0])} {array}[{size}];")
            self._fill(array, nodes)
            value = _as(dtype, self.real, f"{array}[p]", self.graph.type[nodes[0]])
            self._line(f"for (int p = 0; p < {size}; ++p) call.{name}[{at} + p * rows] = {value};")
            return
        for e, node in enumerate(nodes):
            value = _as(dtype, self.real, self._ref(node, 0), self.graph.type[node])
            self._line(f"call.{name}[{at}{f' + {e} * rows' if e else ''}] = {value};")


def with_shared_memory(text: str) -> str:
    """Return the text of a kernel that keeps in its block's shared memory what registers have no room for.

    A compiler before CUDA 13.0 does not do so. It takes no more than leaves the warps of a multiprocessor.
    """
    name = f"{KERNEL}(const __grid_constant__ Call call)\n{{\n"
    head, kernel, body = text.rpartition(name)
    asked = '    asm volatile(".pragma \\"enable_smem_spilling\\";");\n'
    return f"{head}__launch_bounds__({_SHARED_BLOCK}) {kernel}{asked}{body}" if kernel else text


def in_arguments(numbers: int, single: bool) -> bool:
    """Return whether a table of so many numbers comes with the arguments of its kernel."""
    return numbers * (4 if single else 8) <= _IN_ARGUMENTS


def _times(factor: str, count: int) -> str:
    return "" if count == 0 else f"{factor} + " if count == 1 else f"{count} * {factor} + "


def _as(dtype: torch.dtype, real: str, text: str, kind: str) -> str:
    """A number of the program as one of a dtype."""
    wanted = _type_of(dtype)
    held = {REAL: real, WHOLE: real, WIDE: "double", NARROW: "double", FLAG: "int"}[kind]
    if dtype == torch.bool and kind != FLAG:
        return f"({text} != 0)"
    return text if wanted == held else f"({wanted})({text})"


def _type_of(dtype: torch.dtype) -> str:
    if dtype not in _OF_C:
        raise NotLoweredError(f"{dtype} is not read or written by a kernel", "half")
    return _OF_C[dtype]


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
