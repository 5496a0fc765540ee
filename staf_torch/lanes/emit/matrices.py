"""Statements about whole matrices that stay in memory."""

from __future__ import annotations

from contextlib import AbstractContextManager

from .schedule import evenly, leaves
from .statements import StatementWriter


class MatrixWriter(StatementWriter):
    """Writes, besides numbers and arrays, Householder's tridiagonal form of a symmetric matrix."""

    def _tridiagonal(self, node: int) -> None:
        """Loops over the lower triangle, in place: Golub and Van Loan, 8.3.1.

        The matrix is divided by its largest |entry| first. The array of the node is then its diagonal, the
        squares of what is beside it, and that entry.
        """
        size, end = self.graph.aux[node][1][0], self.graph.aux[node][1][0] - 1
        self._declare(node)
        self._read_triangle(node, size)
        with self._over("u0", "0", size - 2):
            self._reflector(node, size)
            self._image(node, size)
            with self._over("u1", "u0 + 1", size), self._over("u2", "u0 + 1", "u1 + 1"):
                for j in range(self.copies):
                    h = self._part("h", node, _packed("u1", "u2"), j)
                    v, w, across, beside = (self._part(x, node, u, j) for u in ("u1", "u2") for x in "vw")
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
            self._line(f"{kind} {name}{node}[{entries * self.copies}];")
        self._variables(node, "x", 0.0)
        with self._over("u0", "0", size), self._over("u1", "0", "u0 + 1"):
            ats = [
                self._sum(["u0", "u1"], *index)
                if index is not None
                else self._lookup(places, f"u0 * {size} + u1")
                for _, places in leaves(self.graph, self._taken_over, node)
                for index in [evenly(places, [size, size])]
            ]
            for j in range(self.copies):
                h, most = self._part("h", node, _packed("u0", "u1"), j), f"x{node}{self._copy(j)}"
                self._line(f"{h} = {self._mapped(node, iter(ats), j)};")
                length = self._op("abs", node, h)
                self._line(
                    f"{most} = {self._op('where', node, self._op('lt', node, most, length), length, most)};"
                )
        for j in range(self.copies):
            most = f"x{node}{self._copy(j)}"
            some = self._op("lt", node, self._stated(0.0, self.graph.type[node]), most)
            one = self._stated(1.0, self.graph.type[node])
            self._line(f"{most} = {self._op('where', node, some, most, one)};")
            self._line(f"{self._part('a', node, str(2 * size - 1), j)} = {most};")
        with self._over("u0", "0", count):
            for j in range(self.copies):
                h = self._part("h", node, "u0", j)
                self._line(f"{h} = {h} / x{node}{self._copy(j)};")

    def _reflector(self, node: int, size: int) -> None:
        """Column u0 below the diagonal as the vector v of a reflection, scaled by x = 2 / v'v."""
        zero, one, two = (self._stated(value, self.graph.type[node]) for value in (0.0, 1.0, 2.0))
        self._variables(node, "y", 0.0)
        with self._over("u1", "u0 + 1", size):
            for j in range(self.copies):
                v, square = self._part("v", node, "u1", j), f"y{node}{self._copy(j)}"
                self._line(f"{v} = {self._part('h', node, _packed('u1', 'u0'), j)};")
                self._line(f"{self._part('w', node, 'u1', j)} = {zero};")
                self._line(f"{square} = {self._fma(v, v, square)};")
        for j in range(self.copies):
            square, factor = f"y{node}{self._copy(j)}", f"x{node}{self._copy(j)}"
            head, root = self._part("v", node, "u0 + 1", j), self._op("sqrt", node, square)
            self._line(f"{self._part('a', node, 'u0', j)} = {self._part('h', node, _packed('u0', 'u0'), j)};")
            self._line(f"{self._part('a', node, f'u0 + {size}', j)} = {square};")
            self._line(f"{factor} = {root};")
            moved = self._op(
                "where", node, self._op("lt", node, head, zero), f"{head} - {factor}", f"{head} + {factor}"
            )
            self._line(f"{head} = {moved};")
            self._line(f"{square} = {zero};")
        with self._over("u1", "u0 + 1", size):
            for j in range(self.copies):
                v, square = self._part("v", node, "u1", j), f"y{node}{self._copy(j)}"
                self._line(f"{square} = {self._fma(v, v, square)};")
        for j in range(self.copies):
            square, factor = f"y{node}{self._copy(j)}", f"x{node}{self._copy(j)}"
            some = self._op("lt", node, zero, square)
            self._line(f"{factor} = {two} / ({self._op('where', node, some, square, one)});")
            self._line(f"{factor} = {self._op('where', node, some, factor, zero)};")

    def _image(self, node: int, size: int) -> None:
        """w = x H v - x/2 (x v'H v) v."""
        zero = self._stated(0.0, self.graph.type[node])
        with self._over("u1", "u0 + 1", size):
            for j in range(self.copies):
                self._line(f"y{node}{self._copy(j)} = {zero};")
            with self._over("u2", "u0 + 1", "u1"):
                for j in range(self.copies):
                    h, total = self._part("h", node, _packed("u1", "u2"), j), f"y{node}{self._copy(j)}"
                    v, across, w = (
                        self._part(x, node, u, j) for x, u in (("v", "u1"), ("v", "u2"), ("w", "u2"))
                    )
                    self._line(f"{total} = {self._fma(h, across, total)};")
                    self._line(f"{w} = {self._fma(h, v, w)};")
            for j in range(self.copies):
                h, total = self._part("h", node, _packed("u1", "u1"), j), f"y{node}{self._copy(j)}"
                v, w = (self._part(x, node, "u1", j) for x in "vw")
                self._line(f"{w} = {w} + ({self._fma(h, v, total)});")
        for j in range(self.copies):
            self._line(f"y{node}{self._copy(j)} = {zero};")
        with self._over("u1", "u0 + 1", size):
            for j in range(self.copies):
                v, w = (self._part(x, node, "u1", j) for x in "vw")
                total = f"y{node}{self._copy(j)}"
                self._line(f"{w} = {w} * x{node}{self._copy(j)};")
                self._line(f"{total} = {self._fma(w, v, total)};")
        for j in range(self.copies):
            half = self._stated(0.5, self.graph.type[node])
            total = f"y{node}{self._copy(j)}"
            self._line(f"{total} = {half} * x{node}{self._copy(j)} * {total};")
        with self._over("u1", "u0 + 1", size):
            for j in range(self.copies):
                v, w = (self._part(x, node, "u1", j) for x in "vw")
                self._line(f"{w} = {w} - y{node}{self._copy(j)} * {v};")

    def _variables(self, node: int, name: str, value: float) -> None:
        for j in range(self.copies):
            stated = self._stated(value, self.graph.type[node])
            self._line(f"{self._type(node)} {name}{node}{self._copy(j)} = {stated};")

    def _over(self, name: str, begin: str, end: str | int) -> AbstractContextManager[None]:
        return self._braces(f"for (int {name} = {begin}; {name} < {end}; ++{name})")

    def _part(self, name: str, node: int, at: str, j: int) -> str:
        """An entry of an array of the node's own."""
        return f"{name}{node}[{at}]" if self.copies == 1 else f"{name}{node}[({at}) * {self.copies} + {j}]"

    def _op(self, op: str, node: int, *values: str) -> str:
        return self._operation(op, values, self.graph.type[node])


def _packed(row: str, column: str) -> str:
    """The place of an entry of a lower triangle, row by row."""
    return f"({row}) * (({row}) + 1) / 2 + {column}"
