"""Statements about whole matrices that stay in memory."""

from __future__ import annotations

from collections.abc import Sequence

from .products import ProductWriter
from .schedule import evenly, leaves

_ARRAYS = {"a": "", "h": "_1", "v": "_2", "w": "_3"}
"""What of the operation is in arrays: its result, the triangle, the vector of a reflection and its image."""


class MatrixWriter(ProductWriter):
    """Writes, besides numbers and arrays, Householder's tridiagonal form of a symmetric matrix."""

    def _tridiagonal(self, node: int) -> None:
        """Loops over the lower triangle, in place: Golub and Van Loan, 8.3.1.

        The matrix is divided by its largest |entry| first. The array of the node is then its diagonal, the
        squares of what is beside it, and that entry.
        """
        size, end = self.graph.aux[node][1][0], self.graph.aux[node][1][0] - 1
        self._declare(node)
        self._read_triangle(node, size)
        with self._over("i0_0", "0", size - 2):
            self._reflector(node, size)
            self._image(node, size)
            with self._over("i0_1", "i0_0 + 1", size), self._over("i0_2", "i0_0 + 1", "i0_1 + 1"):
                for j in range(self.copies):
                    h = self._part("h", node, _packed("i0_1", "i0_2"), j)
                    v, w, across, beside = (self._part(x, node, u, j) for u in ("i0_1", "i0_2") for x in "vw")
                    self._line(f"{h} = {h} - ({self._fma(v, beside, f'{w} * {across}')});")
        for j in range(self.copies):
            side = self._part("h", node, _packed(str(end), str(end - 1)), j)
            for k in (end - 1, end):
                self._line(
                    f"{self._part('a', node, str(k), j)} = "
                    f"{self._part('h', node, _packed(str(k), str(k)), j)};"
                )
            self._line(f"{self._part('a', node, str(2 * size - 2), j)} = {side} * {side};")

    def _read_triangle(self, node: int, size: int) -> None:
        """Copy the lower triangle, over its largest |entry|, into an array of its own."""
        kind, count = self._type(node), size * (size + 1) // 2
        for name, entries in (("h", count), ("v", size), ("w", size)):
            self._line(f"{kind} a{node}{_ARRAYS[name]}[{entries * self.copies}];")
        self._variables(node, 1, 0.0)
        with self._over("i0_0", "0", size), self._over("i0_1", "0", "i0_0 + 1"):
            ats = self._entry_of_each(node, [size, size])
            for j in range(self.copies):
                h, most = self._part("h", node, _packed("i0_0", "i0_1"), j), f"t{node}_1{self._copy(j)}"
                self._line(f"{h} = {self._mapped(node, iter(ats), j)};")
                length = self._op("abs", node, h)
                self._line(
                    f"{most} = {self._op('where', node, self._op('lt', node, most, length), length, most)};"
                )
        for j in range(self.copies):
            most = f"t{node}_1{self._copy(j)}"
            some = self._op("lt", node, self._stated(0.0, self.graph.type[node]), most)
            one = self._stated(1.0, self.graph.type[node])
            self._line(f"{most} = {self._op('where', node, some, most, one)};")
            self._line(f"{self._part('a', node, str(2 * size - 1), j)} = {most};")
        with self._over("i0_0", "0", count):
            for j in range(self.copies):
                h = self._part("h", node, "i0_0", j)
                self._line(f"{h} = {h} / t{node}_1{self._copy(j)};")

    def _entry_of_each(self, node: int, sizes: list[int], at: Sequence[str] = ("i0_0", "i0_1")) -> list[str]:
        """Return where an entry of a matrix is in each of what is read."""
        found = []
        for _, places in leaves(self.graph, self._taken_over, node):
            index = evenly(places, sizes)
            regular = None if index is None else self._sum(at, *index)
            found.append(
                self._lookup(places, f"{at[0]} * {sizes[1]} + {at[1]}") if regular is None else regular
            )
        return found

    def _reflector(self, node: int, size: int) -> None:
        """Column i0_0 below the diagonal as the vector v of a reflection, scaled by x = 2 / v'v."""
        zero, one, two = (self._stated(value, self.graph.type[node]) for value in (0.0, 1.0, 2.0))
        self._variables(node, 2, 0.0)
        with self._over("i0_1", "i0_0 + 1", size):
            for j in range(self.copies):
                v, square = self._part("v", node, "i0_1", j), f"t{node}_2{self._copy(j)}"
                self._line(f"{v} = {self._part('h', node, _packed('i0_1', 'i0_0'), j)};")
                self._line(f"{self._part('w', node, 'i0_1', j)} = {zero};")
                self._line(f"{square} = {self._fma(v, v, square)};")
        for j in range(self.copies):
            square, factor = f"t{node}_2{self._copy(j)}", f"t{node}_1{self._copy(j)}"
            head, root = self._part("v", node, "i0_0 + 1", j), self._op("sqrt", node, square)
            self._line(
                f"{self._part('a', node, 'i0_0', j)} = {self._part('h', node, _packed('i0_0', 'i0_0'), j)};"
            )
            self._line(f"{self._part('a', node, f'i0_0 + {size}', j)} = {square};")
            self._line(f"{factor} = {root};")
            moved = self._op(
                "where", node, self._op("lt", node, head, zero), f"{head} - {factor}", f"{head} + {factor}"
            )
            self._line(f"{head} = {moved};")
            self._line(f"{square} = {zero};")
        with self._over("i0_1", "i0_0 + 1", size):
            for j in range(self.copies):
                v, square = self._part("v", node, "i0_1", j), f"t{node}_2{self._copy(j)}"
                self._line(f"{square} = {self._fma(v, v, square)};")
        for j in range(self.copies):
            square, factor = f"t{node}_2{self._copy(j)}", f"t{node}_1{self._copy(j)}"
            some = self._op("lt", node, zero, square)
            self._line(f"{factor} = {two} / ({self._op('where', node, some, square, one)});")
            self._line(f"{factor} = {self._op('where', node, some, factor, zero)};")

    def _image(self, node: int, size: int) -> None:
        """w = x H v - x/2 (x v'H v) v."""
        zero = self._stated(0.0, self.graph.type[node])
        with self._over("i0_1", "i0_0 + 1", size):
            for j in range(self.copies):
                self._line(f"t{node}_2{self._copy(j)} = {zero};")
            with self._over("i0_2", "i0_0 + 1", "i0_1"):
                for j in range(self.copies):
                    h, total = self._part("h", node, _packed("i0_1", "i0_2"), j), f"t{node}_2{self._copy(j)}"
                    v, across, w = (
                        self._part(x, node, u, j) for x, u in (("v", "i0_1"), ("v", "i0_2"), ("w", "i0_2"))
                    )
                    self._line(f"{total} = {self._fma(h, across, total)};")
                    self._line(f"{w} = {self._fma(h, v, w)};")
            for j in range(self.copies):
                h, total = self._part("h", node, _packed("i0_1", "i0_1"), j), f"t{node}_2{self._copy(j)}"
                v, w = (self._part(x, node, "i0_1", j) for x in "vw")
                self._line(f"{w} = {w} + ({self._fma(h, v, total)});")
        for j in range(self.copies):
            self._line(f"t{node}_2{self._copy(j)} = {zero};")
        with self._over("i0_1", "i0_0 + 1", size):
            for j in range(self.copies):
                v, w = (self._part(x, node, "i0_1", j) for x in "vw")
                total = f"t{node}_2{self._copy(j)}"
                self._line(f"{w} = {w} * t{node}_1{self._copy(j)};")
                self._line(f"{total} = {self._fma(w, v, total)};")
        for j in range(self.copies):
            half = self._stated(0.5, self.graph.type[node])
            total = f"t{node}_2{self._copy(j)}"
            self._line(f"{total} = {half} * t{node}_1{self._copy(j)} * {total};")
        with self._over("i0_1", "i0_0 + 1", size):
            for j in range(self.copies):
                v, w = (self._part(x, node, "i0_1", j) for x in "vw")
                self._line(f"{w} = {w} - t{node}_2{self._copy(j)} * {v};")

    def _variables(self, node: int, name: int, value: float) -> None:
        for j in range(self.copies):
            stated = self._stated(value, self.graph.type[node])
            self._line(f"{self._type(node)} t{node}_{name}{self._copy(j)} = {stated};")

    def _part(self, name: str, node: int, at: str, j: int) -> str:
        """An entry of an array of the node's own."""
        name = f"a{node}{_ARRAYS[name]}"
        return f"{name}[{at}]" if self.copies == 1 else f"{name}[({at}) * {self.copies} + {j}]"

    def _op(self, op: str, node: int, *values: str) -> str:
        return self._operation(op, values, self.graph.type[node])


def _packed(row: str, column: str) -> str:
    """The place of an entry of a lower triangle, row by row."""
    return f"({row}) * (({row}) + 1) / 2 + {column}"
