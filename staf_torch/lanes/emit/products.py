"""Statements of sums of products: some of them in registers at once, so that a number is read for several.

A sum by itself reads two numbers for a multiplication. Several rows of sums, or of two matrices a square of
rows and columns, are computed side by side; each still adds its products in its own order, so that the bits
are those of one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any, ClassVar

from ..trace.graph import NARROW
from ..trace.tracer import LARGE
from .schedule import evenly
from .statements import StatementWriter

Index = tuple[list[int], int]


class ProductWriter(StatementWriter):
    """Writes sums of products; those of two matrices in memory by squares of the result."""

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
                for r in range(rows):
                    for j in range(self.copies):
                        first = self._product(node, indices, places, r, "0", j)[2]
                        self._line(f"{kind} r{r}{self._copy(j)} = {rounded(first)};")
                with self._braces(f"for (int q = 1; q < {count}; ++q)"):
                    for r in range(rows):
                        for j in range(self.copies):
                            a, b, _ = self._product(node, indices, places, r, "q", j)
                            name = f"r{r}{self._copy(j)}"
                            self._line(f"{name} = {rounded(self._fma(a, b, name))};")
                for r in range(rows):
                    for j in range(self.copies):
                        self._line(f"a{node}[(p + {r}) * {self.copies} + {j}] = r{r}{self._copy(j)};")

    def _product(self, node: int, indices: Any, places: Any, r: int, q: str, j: int) -> tuple[str, str, str]:
        count, values = self.graph.aux[node][1], []
        for operand, place, index in zip(self.graph.args[node], places, indices, strict=True):
            if place is None:
                values.append(self._ref(operand, j))
            elif index is not None:
                values.append(self._read(operand, self._sum([f"(p + {r})", q], *index), j))
            else:
                values.append(self._read(operand, self._lookup(place, f"(p + {r}) * {count} + {q}"), j))
        return values[0], values[1], f"{values[0]} * {values[1]}"


def cuts(size: int, widest: int) -> Iterator[tuple[int, int, int]]:
    """Begin, end and width of the pieces of a length: as many alike as there are, and what is left."""
    width = min(size, min(range(widest, widest // 2, -1), key=lambda width: -(-size // width) * width))
    whole = size // width * width
    yield 0, whole, width
    if whole < size:
        yield whole, size, size - whole
