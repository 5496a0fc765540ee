"""A CasADi that does as much as `rivals` asks of it, with numbers of NumPy.

Expressions are functions of the numbers of their symbols; its solver returns the guess as the solution.
"""

from __future__ import annotations

import operator
import types
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Known = dict[Any, np.ndarray]  # arrays by the ids of symbols, and of expressions that have been evaluated


def _matrix(value: Any) -> np.ndarray:
    found = np.asarray(value, dtype=float)
    return found if found.ndim == 2 else found.reshape(-1, 1)


class MX:
    """An expression, (rows, columns)."""

    __array_ufunc__ = None

    def __init__(self, function: Callable[[Known], Any], parts: Sequence[MX] = ()) -> None:
        self.function, self.parts = function, list(parts)  # parts: of which a column is put together
        self.shape: tuple[int, int] | None = None  # of a symbol

    def of(self, known: Known) -> np.ndarray:
        key = ("found", id(self))
        if key not in known:
            known[key] = _matrix(self.function(known))
        return known[key]

    @staticmethod
    def sym(name: str, rows: int = 1, columns: int = 1) -> MX:
        symbol = MX(lambda known: known[id(symbol)])
        symbol.shape = rows, columns
        return symbol

    def __getitem__(self, place: Any) -> MX:
        def kept(at: Any) -> slice:
            return at if isinstance(at, slice) else slice(at, at + 1 or None)

        if isinstance(place, tuple):
            return MX(lambda known: self.of(known)[kept(place[0]), kept(place[1])])
        return MX(lambda known: self.of(known).reshape(-1, 1, order="F")[kept(place)])

    @property
    def T(self) -> MX:  # noqa: N802
        return MX(lambda known: self.of(known).T)


def _apply(function: Callable[..., Any]) -> Callable[..., MX]:
    return lambda *given: MX(
        lambda known: function(*(each.of(known) if isinstance(each, MX) else _matrix(each) for each in given))
    )


for _name in ("add", "sub", "mul", "truediv", "pow"):
    _operation = _apply(getattr(operator, _name))
    setattr(MX, f"__{_name}__", _operation)
    setattr(MX, f"__r{_name}__", lambda one, other, operation=_operation: operation(other, one))
MX.__neg__ = _apply(np.negative)  # type: ignore[attr-defined]


class Function:
    """Expressions of symbols, also of several columns at once."""

    def __init__(self, name: str, given: Sequence[MX], found: Sequence[Any]) -> None:
        self.given, self.found, self.columns = given, found, 1

    def map(self, columns: int) -> Function:
        other = Function("map", self.given, self.found)
        other.columns = columns
        return other

    def __call__(self, *values: MX) -> list[MX]:
        def of(part: Any, known: Known) -> np.ndarray:
            numbers = [value.of(known) for value in values]
            assert {each.shape[1] for each in numbers} == {self.columns}
            columns = [
                {id(s): n[:, [k]] for s, n in zip(self.given, numbers, strict=True)}
                for k in range(self.columns)
            ]
            return np.hstack([part.of(column) for column in columns])

        return [MX(lambda known, part=part: of(part, known)) for part in self.found]


class Solver:
    """Returns the guess as the solution, and keeps how it was asked."""

    def __init__(self, program: dict[str, MX], options: dict[str, Any]) -> None:
        self.program, self.options, self.asked = program, options, list[dict[str, Any]]()

    def __call__(self, x0: Any, p: Any, **bounds: Any) -> dict[str, np.ndarray]:
        self.asked.append({"x0": np.ravel(x0), "p": np.ravel(p)} | bounds)
        known = self._known("x", x0) | self._known("p", p)
        return {"x": _matrix(x0)} | {name: self.program[name].of(known) for name in ("f", "g")}

    def _known(self, name: str, numbers: Any) -> Known:
        left, found = np.asarray(numbers, dtype=float).ravel(), Known()
        for symbol in _symbols(self.program[name]):
            assert symbol.shape is not None
            size = symbol.shape[0] * symbol.shape[1]
            found[id(symbol)], left = left[:size].reshape(symbol.shape, order="F"), left[size:]
        assert not len(left), f"more numbers than {name} has"
        return found

    def stats(self) -> dict[str, Any]:
        return {"success": True}


def _symbols(expression: MX) -> list[MX]:
    if expression.shape is not None:
        return [expression]
    return [symbol for part in expression.parts for symbol in _symbols(part)]


def module(made: list[Solver]) -> Any:
    """What takes the place of the package; solvers that are asked for are put into the list."""
    found: Any = types.ModuleType("casadi")

    def nlpsol(name: str, kind: str, program: dict[str, MX], options: dict[str, Any]) -> Solver:
        assert kind == "ipopt"
        made.append(Solver(program, options))
        return made[-1]

    stacked = _apply(lambda *parts: np.vstack(parts))
    columns = _apply(lambda matrix: matrix.reshape(-1, 1, order="F"))
    found.MX, found.Function, found.nlpsol = MX, Function, nlpsol
    found.DM = lambda numbers: MX(lambda known: list(numbers))
    found.vertcat = lambda *parts: MX(stacked(*parts).function, parts)
    found.vec = lambda matrix: MX(columns(matrix).function, [matrix])
    found.sum2 = _apply(lambda matrix: matrix.sum(1, keepdims=True))
    found.bilin = _apply(lambda matrix, left, right: left.T @ matrix @ right)
    for name in ("sin", "cos", "floor"):
        setattr(found, name, _apply(getattr(np, name)))
    found.fmin, found.fmax = _apply(np.minimum), _apply(np.maximum)
    return found
