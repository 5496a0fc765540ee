"""A CasADi that does as much as the program of `rivals` asks of it, with numbers of NumPy.

Expressions are functions of the numbers of their symbols; its solver finds that a guess is the solution.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Known = dict[Any, Any]  # arrays by the ids of symbols, and by those of expressions what was found before


class MX:
    """An expression, (rows, columns)."""

    __array_ufunc__ = None

    def __init__(self, of: Callable[[Known], Any], parts: Sequence[MX] = ()) -> None:
        def once(known: Known) -> np.ndarray:  # a state is a part of all that come later
            if ("found", id(self)) not in known:
                known["found", id(self)] = _matrix(of(known))
            return known["found", id(self)]

        self.of = once
        self.parts = list(parts)  # of which a column is put together
        self.shape: tuple[int, int] | None = None  # of a symbol

    @staticmethod
    def sym(name: str, rows: int = 1, columns: int = 1) -> MX:
        assert (type(rows), type(columns)) == (int, int), "sizes are whole numbers"
        symbol = MX(lambda known: known[id(symbol)])
        symbol.shape = rows, columns
        return symbol

    def __getitem__(self, place: Any) -> MX:
        if isinstance(place, tuple):
            rows, columns = map(_slice, place)
            return MX(lambda known: self.of(known)[rows, columns])
        return MX(lambda known: self.of(known).reshape(-1, 1, order="F")[_slice(place)])

    @property
    def T(self) -> MX:  # noqa: N802
        return MX(lambda known: self.of(known).T)

    def _with(self, other: Any, of: Callable[[Any, Any], Any]) -> MX:
        second = _of(other)
        return MX(lambda known: of(self.of(known), second(known)))

    def __add__(self, other: Any) -> MX:
        return self._with(other, lambda a, b: a + b)

    def __sub__(self, other: Any) -> MX:
        return self._with(other, lambda a, b: a - b)

    def __mul__(self, other: Any) -> MX:
        return self._with(other, lambda a, b: a * b)

    def __truediv__(self, other: Any) -> MX:
        return self._with(other, lambda a, b: a / b)

    def __rsub__(self, other: Any) -> MX:
        return self._with(other, lambda a, b: b - a)

    def __rtruediv__(self, other: Any) -> MX:
        return self._with(other, lambda a, b: b / a)

    def __pow__(self, power: int) -> MX:
        return MX(lambda known: self.of(known) ** power)

    def __neg__(self) -> MX:
        return MX(lambda known: -self.of(known))

    __radd__, __rmul__ = __add__, __mul__


def _slice(place: Any) -> slice:
    return place if isinstance(place, slice) else slice(place, place + 1 or None)


def _matrix(value: Any) -> np.ndarray:
    found = np.asarray(value, dtype=float)
    return found if found.ndim == 2 else found.reshape(-1, 1)


def _of(value: Any) -> Callable[[Known], np.ndarray]:
    return value.of if isinstance(value, MX) else lambda known: _matrix(value)


def _elementwise(function: Callable[..., np.ndarray]) -> Callable[..., MX]:
    return lambda *given: MX(lambda known: function(*(_of(each)(known) for each in given)))


def vertcat(*parts: Any) -> MX:
    return MX(lambda known: np.vstack([_of(part)(known) for part in parts]), parts)


def vec(matrix: MX) -> MX:
    return MX(lambda known: matrix.of(known).reshape(-1, 1, order="F"), [matrix])


def sum2(matrix: MX) -> MX:
    return MX(lambda known: matrix.of(known).sum(1, keepdims=True))


def bilin(matrix: Any, left: MX, right: MX) -> MX:
    return MX(lambda known: left.of(known).T @ np.asarray(matrix) @ right.of(known))


class Function:
    """Named expressions of symbols, also of several columns at once."""

    def __init__(self, name: str, given: Sequence[MX], found: Sequence[Any]) -> None:
        self.given, self.found, self.columns = given, found, 1

    def map(self, columns: int) -> Function:
        other = Function("map", self.given, self.found)
        other.columns = columns
        return other

    def __call__(self, *values: MX) -> list[MX]:
        def of(part: Any, known: Known) -> np.ndarray:
            numbers = [_of(value)(known) for value in values]
            assert {each.shape[1] for each in numbers} == {self.columns}
            found = []
            for column in range(self.columns):
                each = {id(s): n[:, [column]] for s, n in zip(self.given, numbers, strict=True)}
                assert all(s.shape == (len(each[id(s)]), 1) for s in self.given)
                found.append(_of(part)(each))
            return np.hstack(found)

        return [MX(lambda known, part=part: of(part, known)) for part in self.found]


def _symbols(expression: MX) -> list[MX]:
    if expression.shape is not None:
        return [expression]
    assert expression.parts, "unknowns are symbols"
    return [symbol for part in expression.parts for symbol in _symbols(part)]


class Solver:
    """Finds that a guess is the solution, and keeps how it was asked."""

    def __init__(self, kind: str, program: dict[str, MX], options: dict[str, Any]) -> None:
        self.kind, self.program, self.options = kind, program, options
        self.asked: dict[str, Any] = {}

    def __call__(self, x0: Any, p: Any, lbx: Any, ubx: Any, lbg: Any, ubg: Any) -> dict[str, np.ndarray]:
        self.asked = {"lbx": lbx, "ubx": ubx, "lbg": lbg, "ubg": ubg}
        known = self._known("x", x0) | self._known("p", p)
        return {"x": _matrix(x0)} | {name: self.program[name].of(known) for name in ("f", "g")}

    def _known(self, name: str, numbers: Any) -> dict[int, np.ndarray]:
        left, found = np.asarray(numbers, dtype=float).ravel(), {}
        for symbol in _symbols(self.program[name]):
            assert symbol.shape is not None
            size = symbol.shape[0] * symbol.shape[1]
            found[id(symbol)], left = left[:size].reshape(symbol.shape, order="F"), left[size:]
        assert not len(left), f"more numbers than {name} has"
        return found

    def stats(self) -> dict[str, Any]:
        return {"success": True, "iter_count": 0}


def module(made: list[Solver]) -> types.ModuleType:
    """What takes the place of the package; solvers that are asked for are put into the list."""
    found: Any = types.ModuleType("casadi")

    def nlpsol(name: str, kind: str, program: dict[str, MX], options: dict[str, Any]) -> Solver:
        made.append(Solver(kind, program, options))
        return made[-1]

    found.MX, found.Function, found.nlpsol = MX, Function, nlpsol
    found.DM = lambda numbers: MX(lambda known: list(numbers))
    found.vertcat, found.vec, found.sum2, found.bilin = vertcat, vec, sum2, bilin
    for name, function in (
        ("sin", np.sin),
        ("cos", np.cos),
        ("floor", np.floor),
        ("fmin", np.minimum),
        ("fmax", np.maximum),
    ):
        setattr(found, name, _elementwise(function))
    return found  # type: ignore[no-any-return]
