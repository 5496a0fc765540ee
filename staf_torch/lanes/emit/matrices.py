"""Statements about whole matrices that stay in memory: sums of products, a tridiagonal form, eliminations.

A sum by itself reads two numbers for a multiplication. Several rows of sums, or of two matrices a square of
rows and columns, are computed side by side; each still adds its products in its own order, so that the bits
are those of one.

As single numbers an elimination is a text that grows with the cube of its size; as passes over whole
matrices (`trace.factorisations`) it writes every entry to memory once a pass. Here loops go through the
entries, in the order of those passes, which keeps every bit, and what becomes of an entry stays in a
register until it is done.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import ClassVar

import numpy as np

from ..trace.graph import NARROW
from ..trace.tracer import LARGE
from .schedule import evenly, leaves
from .statements import StatementWriter

Index = tuple[list[int], int]
_COLUMNS = 5  # of a solution that are in registers at once
_ARRAYS = {"a": "", "h": "_1", "v": "_2", "w": "_3"}
"""What of an operation is in arrays: its result, the triangle, the vector of a reflection and its image."""


class MatrixWriter(StatementWriter):
    """Writes, besides numbers and arrays, sums of products and operations on matrices in memory.

    Products of two matrices are written by squares of the result.
    """

    _side: ClassVar[int] = 0  # rows and columns of a square at most; 0 for none

    def _over(self, name: str, begin: str, end: str | int, step: int = 1) -> AbstractContextManager[None]:
        further = f"++{name}" if step == 1 else f"{name} += {step}"
        return self._braces(f"for (int {name} = {begin}; {name} < {end}; {further})")

    def _dot(self, node: int) -> None:
        self._declare(node)
        outs = self.graph.aux[node][0]
        columns, indices = self._columns(node) if self._side and outs > LARGE else (0, [])
        if not columns:
            return self._panels(node)
        for rows, across in itertools.product(cuts(outs // columns, self._side), cuts(columns, self._side)):
            with self._over("u0", str(rows[0]), *rows[1:]), self._over("u1", str(across[0]), *across[1:]):
                self._square(node, columns, indices, rows[2], across[2])

    def _columns(self, node: int) -> tuple[int, list[Index]]:
        """The columns of a product of two matrices, and where these are read; 0 where it is none."""
        outs, count, *places = self.graph.aux[node]
        for columns in (n for n in range(outs // 2, 1, -1) if outs % n == 0 and None not in places):
            indices = [evenly(place, [outs // columns, columns, count]) for place in places]
            found = [index for index in indices if index is not None]
            if len(found) == 2 and sorted((bool(s[0]), bool(s[1])) for s, _ in found) == [
                (False, True),
                (True, False),
            ]:
                return columns, found
        return 0, []

    def _square(self, node: int, columns: int, indices: list[Index], rows: int, across: int) -> None:
        """Sums of some rows and columns: a pass reads a number of each."""
        count, operands = self.graph.aux[node][1], self.graph.args[node]
        kind = self._type(node)
        rounded = self._narrowed if self.graph.type[node] == NARROW else str
        by_row = [bool(strides[0]) for strides, _ in indices]
        sides = [rows if of_row else across for of_row in by_row]
        entries = [(r, c, j) for r in range(rows) for c in range(across) for j in range(self.copies)]

        def read(q: str) -> None:
            for k, operand in enumerate(operands):
                for e, j in itertools.product(range(sides[k]), range(self.copies)):
                    u = [f"(u{0 if by_row[k] else 1} + {e})", q]
                    at = self._sum(u, [indices[k][0][0] or indices[k][0][1], indices[k][0][2]], indices[k][1])
                    self._line(f"const {kind} x{k}_{e}{self._copy(j)} = {self._read(operand, at, j)};")

        def factors(r: int, c: int, j: int) -> tuple[str, str]:
            first, second = (f"x{k}_{r if by_row[k] else c}{self._copy(j)}" for k in range(2))
            return first, second

        for r, c, j in entries:
            self._line(f"{kind} r{r}_{c}{self._copy(j)};")
        with self._braces(""):
            read("0")
            for r, c, j in entries:
                self._line(f"r{r}_{c}{self._copy(j)} = {rounded(' * '.join(factors(r, c, j)))};")
        with self._over("u2", "1", count):
            read("u2")
            for r, c, j in entries:
                name = f"r{r}_{c}{self._copy(j)}"
                self._line(f"{name} = {rounded(self._fma(*factors(r, c, j), name))};")
        for r, c, j in entries:
            at = f"((u0 + {r}) * {columns} + u1 + {c}) * {self.copies} + {j}"
            self._line(f"a{node}[{at}] = r{r}_{c}{self._copy(j)};")

    def _panels(self, node: int) -> None:
        """Sums of products, some rows of them in registers at once."""
        outs, count, *places = self.graph.aux[node]
        kind = self._type(node)
        rounded = self._narrowed if self.graph.type[node] == NARROW else str
        indices = [evenly(place, [outs, count]) for place in places]
        widths = range(4, 1 + (6 if self.copies > 1 else 8))
        panel = min(outs, min(reversed(widths), key=lambda width: -(-outs // width) * width))
        full = outs // panel
        for start, rows, passes in ((0, panel, full), (full * panel, outs % panel, 1)):
            if rows == 0 or passes == 0:
                continue
            with self._braces(f"for (int p = {start}; p < {start + rows * passes}; p += {rows})"):
                every = [*itertools.product(range(rows), range(self.copies))]
                for r, j in every:
                    first = " * ".join(self._factors(node, indices, r, "0", j))
                    self._line(f"{kind} r{r}{self._copy(j)} = {rounded(first)};")
                with self._braces(f"for (int q = 1; q < {count}; ++q)"):
                    for r, j in every:
                        name = f"r{r}{self._copy(j)}"
                        a, b = self._factors(node, indices, r, "q", j)
                        self._line(f"{name} = {rounded(self._fma(a, b, name))};")
                for r, j in every:
                    self._line(f"a{node}[(p + {r}) * {self.copies} + {j}] = r{r}{self._copy(j)};")

    def _factors(self, node: int, indices: Sequence[Index | None], r: int, q: str, j: int) -> list[str]:
        """Product q of sum p + r."""
        count, values = self.graph.aux[node][1], []
        for operand, place, index in zip(
            self.graph.args[node], self.graph.aux[node][2:], indices, strict=True
        ):
            if place is None:
                values.append(self._ref(operand, j))
            elif index is not None:
                values.append(self._read(operand, self._sum([f"(p + {r})", q], *index), j))
            else:
                values.append(self._read(operand, self._lookup(place, f"(p + {r}) * {count} + {q}"), j))
        return values

    # Householder's tridiagonal form.

    def _tridiagonal(self, node: int) -> None:
        """Loops over the lower triangle, in place: Golub and Van Loan, 8.3.1.

        The matrix is divided by its largest |entry| first. The array of the node is then its diagonal, the
        squares of what is beside it, and that entry.
        """
        size, every = self.graph.aux[node][1][0], self._every(node)
        self._declare(node)
        self._read_triangle(node, size)
        with self._over("i0_0", "0", size - 2):
            self._reflector(node, size)
            self._image(node, size)
            with self._over("i0_1", "i0_0 + 1", size), self._over("i0_2", "i0_0 + 1", "i0_1 + 1"):
                for c in every:
                    h, v, w = c("h", _packed("i0_1", "i0_2")), c("v", "i0_1"), c("w", "i0_1")
                    moved = self._fma(v, c("w", "i0_2"), f"{w} * {c('v', 'i0_2')}")
                    self._line(f"{h} = {h} - ({moved});")
        for c in every:
            for k in (size - 2, size - 1):
                self._line(f"{c('a', k)} = {c('h', _packed(k, k))};")
            side = c("h", _packed(size - 1, size - 2))
            self._line(f"{c('a', 2 * size - 2)} = {side} * {side};")

    def _read_triangle(self, node: int, size: int) -> None:
        """Copy the lower triangle, over its largest |entry|, into an array of its own."""
        every, count = self._every(node), size * (size + 1) // 2
        for name, entries in (("h", count), ("v", size), ("w", size)):
            self._line(f"{self._type(node)} a{node}{_ARRAYS[name]}[{entries * self.copies}];")
        self._variables(node, 1, 0.0)
        with self._over("i0_0", "0", size), self._over("i0_1", "0", "i0_0 + 1"):
            ats = self._entry_of_each(node, [size, size])
            for c in every:
                h, most = c("h", _packed("i0_0", "i0_1")), c.variable(1)
                self._line(f"{h} = {self._mapped(node, iter(ats), c.j)};")
                length = c.op("abs", h)
                self._line(f"{most} = {c.op('where', c.op('lt', most, length), length, most)};")
        for c in every:
            most = c.variable(1)
            some = c.op("lt", c.stated(0.0), most)
            self._line(f"{most} = {c.op('where', some, most, c.stated(1.0))};")
            self._line(f"{c('a', 2 * size - 1)} = {most};")
        with self._over("i0_0", "0", count):
            for c in every:
                self._line(f"{c('h', 'i0_0')} = {c('h', 'i0_0')} / {c.variable(1)};")

    def _reflector(self, node: int, size: int) -> None:
        """Column i0_0 below the diagonal as the vector v of a reflection, scaled by x = 2 / v'v."""
        every = self._every(node)
        self._variables(node, 2, 0.0)
        with self._over("i0_1", "i0_0 + 1", size):
            for c in every:
                v, square = c("v", "i0_1"), c.variable(2)
                self._line(f"{v} = {c('h', _packed('i0_1', 'i0_0'))};")
                self._line(f"{c('w', 'i0_1')} = {c.stated(0.0)};")
                self._line(f"{square} = {self._fma(v, v, square)};")
        for c in every:
            head, square, factor, zero = c("v", "i0_0 + 1"), c.variable(2), c.variable(1), c.stated(0.0)
            self._line(f"{c('a', 'i0_0')} = {c('h', _packed('i0_0', 'i0_0'))};")
            self._line(f"{c('a', f'i0_0 + {size}')} = {square};")
            self._line(f"{factor} = {c.op('sqrt', square)};")
            moved = c.op("where", c.op("lt", head, zero), f"{head} - {factor}", f"{head} + {factor}")
            self._line(f"{head} = {moved};")
            self._line(f"{square} = {zero};")
        with self._over("i0_1", "i0_0 + 1", size):
            for c in every:
                v, square = c("v", "i0_1"), c.variable(2)
                self._line(f"{square} = {self._fma(v, v, square)};")
        for c in every:
            square, factor = c.variable(2), c.variable(1)
            some = c.op("lt", c.stated(0.0), square)
            self._line(f"{factor} = {c.stated(2.0)} / ({c.op('where', some, square, c.stated(1.0))});")
            self._line(f"{factor} = {c.op('where', some, factor, c.stated(0.0))};")

    def _image(self, node: int, size: int) -> None:
        """w = x H v - x/2 (x v'H v) v."""
        every = self._every(node)

        def cleared() -> None:
            for c in every:
                self._line(f"{c.variable(2)} = {c.stated(0.0)};")

        with self._over("i0_1", "i0_0 + 1", size):
            cleared()
            with self._over("i0_2", "i0_0 + 1", "i0_1"):
                for c in every:
                    h, w, total = c("h", _packed("i0_1", "i0_2")), c("w", "i0_2"), c.variable(2)
                    self._line(f"{total} = {self._fma(h, c('v', 'i0_2'), total)};")
                    self._line(f"{w} = {self._fma(h, c('v', 'i0_1'), w)};")
            for c in every:
                h, v, w = c("h", _packed("i0_1", "i0_1")), c("v", "i0_1"), c("w", "i0_1")
                self._line(f"{w} = {w} + ({self._fma(h, v, c.variable(2))});")
        cleared()
        with self._over("i0_1", "i0_0 + 1", size):
            for c in every:
                v, w, total = c("v", "i0_1"), c("w", "i0_1"), c.variable(2)
                self._line(f"{w} = {w} * {c.variable(1)};")
                self._line(f"{total} = {self._fma(w, v, total)};")
        for c in every:
            self._line(f"{c.variable(2)} = {c.stated(0.5)} * {c.variable(1)} * {c.variable(2)};")
        with self._over("i0_1", "i0_0 + 1", size):
            for c in every:
                self._line(f"{c('w', 'i0_1')} = {c('w', 'i0_1')} - {c.variable(2)} * {c('v', 'i0_1')};")

    # Eliminations: each entry as by the passes over whole matrices in `trace.factorisations`, in their order.

    def _cholesky(self, node: int) -> None:
        """L, and after it 0 or the place of a pivot that is not positive."""
        size, every = self.graph.aux[node][1][0], self._every(node)
        pivot, entry = f"i0_0 * {size} + i0_0", f"i0_1 * {size} + i0_0"
        self._declare(node)
        self._variables(node, 1, 0.0)  # the place
        self._variables(node, 2, 1.0)  # of this pass
        with self._over("i0_0", "0", size):
            with self._over("i0_1", "i0_0", size):
                ats = self._entry_of_each(node, [size, size], ("i0_1", "i0_0"))
                self._begin_with(node, "sum", lambda j: self._mapped(node, iter(ats), j))
                with self._over("i0_2", "0", "i0_0"):
                    for c in every:
                        one, other, total = (
                            *(c("a", f"{at} * {size} + i0_2") for at in ("i0_1", "i0_0")),
                            f"sum{c.end}",
                        )
                        self._line(f"{total} = {total} - {one} * {other};")
                for c in every:
                    self._line(f"{c('a', entry)} = sum{c.end};")
            for c in every:
                failed, done = c.variable(1), c.variable(2)
                first = c.op("where", c.op("eq", failed, c.stated(0.0)), done, failed)
                fine = c.op("lt", c.stated(0.0), c("a", pivot))
                self._line(f"{failed} = {c.op('where', fine, failed, first)};")
                self._line(f"{done} = {done} + {c.stated(1.0)};")
                self._line(f"const {self._type(node)} {c.variable(3)} = {c.op('sqrt', c('a', pivot))};")
            with self._over("i0_1", "i0_0", size):
                for c in every:
                    self._line(f"{c('a', entry)} = {c('a', entry)} / {c.variable(3)};")
        with self._over("i0_1", "0", size), self._over("i0_2", "i0_1 + 1", size):
            for c in every:
                self._line(f"{c('a', f'i0_1 * {size} + i0_2')} = {c.stated(0.0)};")
        for c in every:
            self._line(f"{c('a', size * size)} = {c.variable(1)};")

    def _substitute(self, node: int, unit: bool = False) -> None:
        """T^-1 B beside the place of T, row by row: some columns at a time."""
        size, row = self.graph.aux[node][1]
        self._declare(node)
        with self._over("i0_0", "0", size):
            for begin, end, width in cuts(row - size, _COLUMNS):
                with self._over("i0_1", str(begin), end, width):
                    self._substituted(node, size, row, width, unit)

    def _substituted(self, node: int, size: int, row: int, width: int, unit: bool) -> None:
        """Entries of row i0_0 of the solution."""
        read, columns = self._sides(node), [*itertools.product(range(width), self._every(node))]
        for k, c in columns:
            self._line(f"{self._type(node)} r{k}{c.end} = {read(1, f'(i0_1 + {k})', c.j)};")
        with self._over("i0_2", "0", "i0_0"):
            self._begin_with(node, "x", lambda j: read(0, "i0_2", j))
            for k, c in columns:
                other = c("a", f"i0_2 * {row} + i0_1 + {size + k}")
                self._line(f"r{k}{c.end} = r{k}{c.end} - x{c.end} * {other};")
        if not unit:
            self._begin_with(node, "x", lambda j: read(0, "i0_0", j))
        for k, c in columns:
            entry = c("a", f"i0_0 * {row} + i0_1 + {size + k}")
            self._line(f"{entry} = r{k}{c.end}{'' if unit else f' / x{c.end}'};")

    def _substitute_unit(self, node: int) -> None:
        self._substitute(node, unit=True)

    def _sides(self, node: int) -> Callable[[int, str, int], str]:
        """Return what reads an entry of row i0_0 of T (0) or of B (1)."""
        size, row = self.graph.aux[node][1]
        apart = self._apart(node)

        def read(side: int, column: str, j: int) -> str:
            if apart is not None:
                entry, index = apart[side]
                return self._read_like(entry, self._sum(["i0_0", column], *index), j)
            ats = self._entry_of_each(node, [size, row], ("i0_0", f"({column} + {side * size})"))
            return self._mapped(node, iter(ats), j)

        return read

    def _apart(self, node: int) -> list[tuple[int, Index]] | None:
        """An entry of T and of B and where the others lie, if an array is there for them alone; else None."""
        graph, (pack,), (_, (size, row), places) = self.graph, self.graph.args[node], self.graph.aux[node]
        alone = self.schedule.uses[pack] == 1 and self.schedule.together(pack, node)
        if graph.op[pack] != "pack" or not alone or self._in_place(pack) is not None:
            return None
        table, found = np.array(graph.args[pack])[list(places)].reshape(size, row), []
        for part in (table[:, :size], table[:, size:]):
            of = [self._place_in_array(int(entry)) for entry in part.flat]
            index = evenly([place for _, place in of], part.shape)
            if index is None or len({source for source, _ in of}) > 1:
                return None
            found.append((int(part.flat[0]), index))
        return found

    def _pack(self, node: int) -> None:
        """Write an array, unless it is there for a substitution alone, which reads what it is made of."""
        reader = self._readers.get(node)
        if reader is None or self._apart(reader) is None:
            super()._pack(node)

    @functools.cached_property
    def _readers(self) -> dict[int, int]:
        """The substitutions, by what they read."""
        graph = self.graph
        of = [n for n in self.schedule.live if graph.op[n] in ("substitute", "substitute_unit")]
        return {graph.args[n][0]: n for n in of}

    # What these have in common.

    def _every(self, node: int) -> list[_Copy]:
        return [_Copy(self, node, j) for j in range(self.copies)]

    def _entry_of_each(self, node: int, sizes: list[int], at: Sequence[str] = ("i0_0", "i0_1")) -> list[str]:
        """Return where an entry of a matrix is in each of what is read."""
        found = []
        for _, places in leaves(self.graph, self._taken_over, node):
            index = evenly(places, sizes)
            irregular = f"{at[0]} * {sizes[1]} + {at[1]}"
            found.append(self._lookup(places, irregular) if index is None else self._sum(at, *index))
        return found

    def _variables(self, node: int, number: int, value: float) -> None:
        self._begin_with(node, f"t{node}_{number}", lambda _: self._stated(value, self.graph.type[node]))

    def _begin_with(self, node: int, name: str, value: Callable[[int], str]) -> None:
        """Declare a variable that begins with a value."""
        for j in range(self.copies):
            self._line(f"{self._type(node)} {name}{self._copy(j)} = {value(j)};")


class _Copy:
    """The spelling of what an operation on a matrix reads and writes, in one of the copies."""

    def __init__(self, writer: MatrixWriter, node: int, j: int) -> None:
        self._writer, self._node, self._kind = writer, node, writer.graph.type[node]
        self.j, self.end = j, writer._copy(j)

    def __call__(self, array: str, at: str | int) -> str:
        """An entry of an array of the node's own."""
        name, copies = f"a{self._node}{_ARRAYS[array]}", self._writer.copies
        return f"{name}[{at}]" if copies == 1 else f"{name}[({at}) * {copies} + {self.j}]"

    def variable(self, number: int) -> str:
        return f"t{self._node}_{number}{self.end}"

    def op(self, op: str, *values: str) -> str:
        return self._writer._operation(op, values, self._kind)

    def stated(self, value: float) -> str:
        return self._writer._stated(value, self._kind)


def _packed(row: str | int, column: str | int) -> str:
    """The place of an entry of a lower triangle, row by row."""
    return f"({row}) * (({row}) + 1) / 2 + {column}"


def cuts(size: int, widest: int) -> Iterator[tuple[int, int, int]]:
    """Begin, end and width of the pieces of a length: as many alike as there are, and what is left."""
    width = min(size, min(range(widest, widest // 2, -1), key=lambda width: -(-size // width) * width))
    whole = size // width * width
    yield 0, whole, width
    if whole < size:
        yield whole, size, size - whole
