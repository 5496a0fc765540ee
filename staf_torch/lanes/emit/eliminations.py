"""Statements of eliminations in place: a factor of a matrix, and right sides under a triangle.

As single numbers an elimination is a text that grows with the cube of its size; as passes over whole
matrices (`trace.factorisations`) it writes every entry to memory once a pass. Here loops go through the
entries, in the order of those passes, which keeps every bit, and what becomes of an entry stays in a
register until it is done.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable

import numpy as np

from .matrices import MatrixWriter
from .products import cuts
from .schedule import evenly

_COLUMNS = 5  # of a solution that are in registers at once


class EliminationWriter(MatrixWriter):
    """Writes, besides, Cholesky's factor and the solution under a lower triangle, in an array of the node.

    Each entry is computed as by the passes over whole matrices in `trace.factorisations`, in their order.
    """

    def _cholesky(self, node: int) -> None:
        """L, and after it 0 or the place of a pivot that is not positive."""
        size = self.graph.aux[node][1][0]
        self._declare(node)
        self._variables(node, 1, 0.0)  # the place
        self._variables(node, 2, 1.0)  # of this pass
        with self._over("i0_0", "0", size):
            with self._over("i0_1", "i0_0", size):
                ats = self._entry_of_each(node, [size, size], ("i0_1", "i0_0"))
                self._sums(node, "sum", lambda j: self._mapped(node, iter(ats), j))
                with self._over("i0_2", "0", "i0_0"):
                    for j in range(self.copies):
                        one, other = (
                            self._part("a", node, f"{at} * {size} + i0_2", j) for at in ("i0_1", "i0_0")
                        )
                        self._line(f"sum{self._copy(j)} = sum{self._copy(j)} - {one} * {other};")
                for j in range(self.copies):
                    entry = self._part("a", node, f"i0_1 * {size} + i0_0", j)
                    self._line(f"{entry} = sum{self._copy(j)};")
            for j in range(self.copies):
                failed, done, root = (f"t{node}_{k}{self._copy(j)}" for k in (1, 2, 3))
                zero, one = (self._stated(value, self.graph.type[node]) for value in (0.0, 1.0))
                pivot = self._part("a", node, f"i0_0 * {size} + i0_0", j)
                first = self._op("where", node, self._op("eq", node, failed, zero), done, failed)
                fine = self._op("lt", node, zero, pivot)
                self._line(f"{failed} = {self._op('where', node, fine, failed, first)};")
                self._line(f"{done} = {done} + {one};")
                self._line(f"const {self._type(node)} {root} = {self._op('sqrt', node, pivot)};")
            with self._over("i0_1", "i0_0", size):
                for j in range(self.copies):
                    entry = self._part("a", node, f"i0_1 * {size} + i0_0", j)
                    self._line(f"{entry} = {entry} / t{node}_3{self._copy(j)};")
        with self._over("i0_1", "0", size), self._over("i0_2", "i0_1 + 1", size):
            for j in range(self.copies):
                zero = self._stated(0.0, self.graph.type[node])
                self._line(f"{self._part('a', node, f'i0_1 * {size} + i0_2', j)} = {zero};")
        for j in range(self.copies):
            self._line(f"{self._part('a', node, str(size * size), j)} = t{node}_1{self._copy(j)};")

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
        read = self._sides(node)
        for c in range(width):
            for j in range(self.copies):
                self._line(f"{self._type(node)} r{c}{self._copy(j)} = {read(1, f'(i0_1 + {c})', j)};")
        with self._over("i0_2", "0", "i0_0"):
            self._sums(node, "x", lambda j: read(0, "i0_2", j))
            for c, j in itertools.product(range(width), range(self.copies)):
                other = self._part("a", node, f"i0_2 * {row} + i0_1 + {size + c}", j)
                self._line(f"r{c}{self._copy(j)} = r{c}{self._copy(j)} - x{self._copy(j)} * {other};")
        if not unit:
            self._sums(node, "x", lambda j: read(0, "i0_0", j))
        for c, j in itertools.product(range(width), range(self.copies)):
            entry = self._part("a", node, f"i0_0 * {row} + i0_1 + {size + c}", j)
            self._line(f"{entry} = r{c}{self._copy(j)}{'' if unit else f' / x{self._copy(j)}'};")

    def _substitute_unit(self, node: int) -> None:
        self._substitute(node, unit=True)

    def _sums(self, node: int, name: str, value: Callable[[int], str]) -> None:
        """Declare a variable that begins with a value."""
        for j in range(self.copies):
            self._line(f"{self._type(node)} {name}{self._copy(j)} = {value(j)};")

    def _sides(self, node: int) -> Callable[[int, str, int], str]:
        """Return what reads an entry of row i0_0 of T (0) or of B (1)."""
        size, row = self.graph.aux[node][1]
        apart = self._apart(node)
        if apart is None:

            def read(side: int, column: str, j: int) -> str:
                ats = self._entry_of_each(node, [size, row], ("i0_0", f"({column} + {side * size})"))
                return self._mapped(node, iter(ats), j)

        else:

            def read(side: int, column: str, j: int) -> str:
                entry, index = apart[side]
                return self._read_like(entry, self._sum(["i0_0", column], *index), j)

        return read

    def _apart(self, node: int) -> list[tuple[int, tuple[list[int], int]]] | None:
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
