"""Statements of eliminations in place: a factor of a matrix, and right sides under a triangle."""

from __future__ import annotations

from .matrices import MatrixWriter


class EliminationWriter(MatrixWriter):
    """Writes, besides, Cholesky's factor and the solution under a lower triangle, in an array of the node.

    Each entry is computed as by the passes over whole matrices in `trace.factorisations`, in their order.
    """

    def _cholesky(self, node: int) -> None:
        """L in the place of K, and after it 0 or the place of a pivot that is not positive."""
        size = self.graph.aux[node][1][0]
        self._read_in_place(node, size)
        self._variables(node, 1, 0.0)  # the place
        self._variables(node, 2, 1.0)  # of this pass
        with self._over("i0_0", "0", size):
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
            with self._over("i0_1", "i0_0 + 1", size), self._over("i0_2", "i0_0 + 1", "i0_1 + 1"):
                for j in range(self.copies):
                    entry, one, other = (
                        self._part("a", node, at, j)
                        for at in (f"i0_1 * {size} + i0_2", f"i0_1 * {size} + i0_0", f"i0_2 * {size} + i0_0")
                    )
                    self._line(f"{entry} = {entry} - {one} * {other};")
        with self._over("i0_1", "0", size), self._over("i0_2", "i0_1 + 1", size):
            for j in range(self.copies):
                zero = self._stated(0.0, self.graph.type[node])
                self._line(f"{self._part('a', node, f'i0_1 * {size} + i0_2', j)} = {zero};")
        for j in range(self.copies):
            self._line(f"{self._part('a', node, str(size * size), j)} = t{node}_1{self._copy(j)};")

    def _substitute(self, node: int, unit: bool = False) -> None:
        """T^-1 B in the place of B, beside T row by row."""
        size, row = self.graph.aux[node][1]
        self._read_in_place(node, row)
        with self._over("i0_0", "0", size):
            if not unit:
                with self._over("i0_1", str(size), row):
                    for j in range(self.copies):
                        entry = self._part("a", node, f"i0_0 * {row} + i0_1", j)
                        pivot = self._part("a", node, f"i0_0 * {row} + i0_0", j)
                        self._line(f"{entry} = {entry} / {pivot};")
            with self._over("i0_1", "i0_0 + 1", size), self._over("i0_2", str(size), row):
                for j in range(self.copies):
                    entry, one, other = (
                        self._part("a", node, at, j)
                        for at in (f"i0_1 * {row} + i0_2", f"i0_1 * {row} + i0_0", f"i0_0 * {row} + i0_2")
                    )
                    self._line(f"{entry} = {entry} - {one} * {other};")

    def _substitute_unit(self, node: int) -> None:
        self._substitute(node, unit=True)

    def _read_in_place(self, node: int, row: int) -> None:
        """Copy what is read into the array of the node."""
        size = self.graph.aux[node][1][0]
        self._declare(node)
        with self._over("i0_0", "0", size), self._over("i0_1", "0", row):
            ats = self._entry_of_each(node, [size, row])
            for j in range(self.copies):
                entry = self._part("a", node, f"i0_0 * {row} + i0_1", j)
                self._line(f"{entry} = {self._mapped(node, iter(ats), j)};")
