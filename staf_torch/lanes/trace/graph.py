"""A scalar program: single numbers of one row, each an operation on others, no two of them equal.

Every node is looked up by operation, operands and type before it is made (value numbering by hashing: Cocke
and Schwartz, 1970), so that a subexpression that torch computes twice is one number. A node knows its depth,
what of a call it depends on, which later decides where it is computed. Only what keeps every bit is
simplified, as compiled must equal the definition; a compiler's -ffast-math does more and promises less.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

Ids = np.ndarray[Any, np.dtype[np.int64]]
"""Numbers of a tensor: the nodes of its entries."""

REAL, WIDE, NARROW, FLAG, WHOLE = "real", "wide", "narrow", "flag", "whole"
"""Types of a node: the program's float, float64 within a program of float32, float32 within one of float64
(held in double; an operation is rounded to float32 after it), bool, integer."""

_EXACT = "neg abs min max where floor ceil trunc round copysign fmod copy"
EXACT = frozenset(_EXACT.split())
"""Operations on numbers of float32 whose result is one: there is nothing to round."""

FIXED = ("const", "param")
"""Operations of nodes that are the same for all rows and times."""

ROW, NOW, STEP = 0, 1, 2
"""Depths: what a row has once, what a time brings whatever the carry is, what depends on the carry.
Loops inside a step are deeper."""


class Sizes(NamedTuple):
    """Numbers of entries that a program reads and writes."""

    rows: Sequence[int]  # of every input that a row has once
    nows: Sequence[int]  # of every input of a time
    carries: Sequence[int]
    outputs: Sequence[int]


@dataclasses.dataclass
class Loop:
    """A body that runs ``count`` times with numbers that pass from one pass to the next."""

    count: int
    depth: int
    home: int = ROW  # depth at which the loop itself stands
    node: int = -1
    carry: list[int] = dataclasses.field(default_factory=list)
    initial: list[int] = dataclasses.field(default_factory=list)
    following: list[int] = dataclasses.field(default_factory=list)
    collected: list[list[int]] = dataclasses.field(default_factory=list)  # a pass's entries of every output
    going: int = -1  # whether the row takes a pass, found at its head; -1 where it takes all

    @property
    def condition(self) -> list[int]:
        """``going``, where there is one."""
        return [self.going] if self.going >= 0 else []


_OPERATIONS = """add sub mul div neg abs min max sqrt exp expm1 log log1p sin cos tan tanh atan2
    floor ceil trunc round lt le eq ne and or xor not"""
_OF_NUMPY = """add subtract multiply divide negative abs minimum maximum sqrt exp expm1 log log1p sin cos tan
    tanh arctan2 floor ceil trunc rint less less_equal equal not_equal logical_and logical_or logical_xor
    logical_not"""
_NAMES = zip(_OPERATIONS.split(), _OF_NUMPY.split(), strict=True)
_FOLD: dict[str, Callable[..., Any]] = {op: getattr(np, name) for op, name in _NAMES}
_COMMUTE = frozenset({"add", "mul", "eq", "ne", "and", "or", "xor"})
_COMPARE = frozenset({"lt", "le", "eq", "ne"})


IN_PLACE = ("tridiagonal", "cholesky", "substitute", "substitute_unit")
"""Operations on a matrix in memory, which write over a copy of it."""


class Graph:
    """Nodes in topological order; a node that has been made before is not made again.

    What is simplified is exact in every bit, infinities, NaN and signed zeros included: constants, x * 1,
    x / 1, x - 0, x + (-0), -(-x), choices between equals.
    """

    def __init__(self, single: bool) -> None:
        self.single = single
        self.op: list[str] = []
        self.args: list[tuple[int, ...]] = []
        self.aux: list[Any] = []
        self.type: list[str] = []
        self.depth: list[int] = []
        self.loops: list[Loop] = []
        self._known: dict[Hashable, int] = {}
        self._signed: list[bool] = []  # whether a node may be -0

    def add(self, op: str, args: Sequence[int], type: str, aux: Any = None, depth: int | None = None) -> int:
        """The node of an operation, simplified nowhere."""
        key = (op, tuple(args), aux, type)
        found = self._known.get(key)
        if found is None:
            found = len(self.op)
            self._known[key] = found
            self.op.append(op)
            self.args.append(tuple(args))
            self.aux.append(aux)
            self.type.append(type)
            self.depth.append(max([self.depth[a] for a in args], default=ROW) if depth is None else depth)
            self._signed.append(self._may_be_negative_zero(found))
        return found

    def slots(self, op: str, ends: Sequence[int]) -> tuple[int, ...]:
        """The inputs of a kind that some nodes depend on."""
        stack, seen, found = [*ends], set[int](), set[int]()
        while stack:
            node = stack.pop()
            if node in seen:
                continue
            seen.add(node)
            stack += self.args[node]
            if self.op[node] == op:
                found.add(self.aux[node][0])
            elif self.op[node] == "loop":
                loop = self.loops[self.aux[node]]
                inside = [*loop.following, *loop.condition, *(n for part in loop.collected for n in part)]
                stack += [*loop.initial, *inside]
        return tuple(sorted(found))

    def close(self, number: int) -> None:
        """Place a loop that has been written down: as far outside as what it reads allows."""
        loop, seen = self.loops[number], set[int]()
        free, stack = set(loop.initial), [*loop.following, *loop.condition]
        stack += [node for part in loop.collected for node in part]
        while stack:
            node = stack.pop()
            if self.depth[node] < loop.depth:
                free.add(node)
            elif node not in seen:
                seen.add(node)
                stack += self.args[node]
        loop.home = max((self.depth[node] for node in free), default=0)
        loop.node = self.add("loop", sorted(free), "none", number, loop.home)

    def constant(self, value: float | bool, type: str) -> int:
        """The node of a number."""
        if type == FLAG:
            return self.add("const", (), type, bool(value))
        number = float(value)
        if type == NARROW or (type == REAL and self.single):
            with np.errstate(all="ignore"):
                number = float(np.float32(number))
        # 0 and -0 are equal and NaN is not equal to itself: the sign and the text tell them apart.
        return self.add(
            "const", (), type, (number, math.copysign(1.0, number)) if number == number else "nan"
        )

    def size(self, node: int) -> int:
        """The entries of an array, 1 for a number."""
        op, aux = self.op[node], self.aux[node]
        if op == "map":
            return math.prod(aux[1])
        if op in IN_PLACE:
            return 2 * int(aux[1][0]) if op == "tridiagonal" else math.prod(aux[1]) + (op == "cholesky")
        if op in ("collect", "carrys", "results"):
            return int(aux[2])
        return int(aux if op == "pack" else aux[0]) if op in ("pack", "dot") else 1

    def parameter(self, number: int, type: str) -> int:
        """The node of a number that only the table of a program knows, so that no text depends on it."""
        return self.add("param", (), type, number)

    def value(self, node: int) -> float | bool | None:
        """The number of a constant, else None."""
        if self.op[node] != "const":
            return None
        aux = self.aux[node]
        return math.nan if aux == "nan" else aux if isinstance(aux, bool) else aux[0]

    def apply(self, op: str, *args: int) -> int:
        """The node of an operation on numbers, simplified."""
        values = [self.value(a) for a in args]
        type = FLAG if op in _COMPARE else self.type[args[0]]
        if op in _FOLD and all(v is not None for v in values):
            return self.constant(self._fold(op, self.type[args[0]], values), type)
        known = self._simpler(op, args, values)
        if known is not None:
            return known
        if op in _COMMUTE and args[0] > args[1]:
            args = (args[1], args[0])
        return self.add(op, args, type)

    def where(self, chosen: int, a: int, b: int) -> int:
        """a where chosen, else b."""
        flag = self.value(chosen)
        if flag is not None:
            return a if flag else b
        if a == b:
            return a
        if self.op[chosen] == "not":
            return self.where(self.args[chosen][0], b, a)
        if self.type[a] == FLAG:
            one, other = self.value(a), self.value(b)
            if one is True and other is False:
                return chosen
            if one is False and other is True:
                return self.apply("not", chosen)
        return self.add("where", (chosen, a, b), self.type[a])

    def convert(self, node: int, type: str) -> int:
        """Convert a number to another type."""
        old = self.type[node]
        if old == type:
            return node
        value = self.value(node)
        if value is not None:
            if type == FLAG:
                return self.constant(bool(value), FLAG)
            number = float(value)
            return self.constant(
                math.trunc(number) if type == WHOLE and math.isfinite(number) else number, type
            )
        if old == FLAG:
            return self.where(node, self.constant(1.0, type), self.constant(0.0, type))
        if type == FLAG:
            return self.apply("ne", node, self.constant(0.0, old))
        if type == WHOLE and old != WHOLE:
            node = self.apply("trunc", node)
        if type == NARROW and self.op[node] == "cast" and self.type[self.args[node][0]] == NARROW:
            return self.args[node][0]  # it was float32 before
        return self.add("cast", (node,), type)

    def _fold(self, op: str, type: str, values: Sequence[Any]) -> Any:
        narrow = type == NARROW or (type == REAL and self.single)
        kind: Any = bool if type == FLAG else np.float32 if narrow else np.float64
        with np.errstate(all="ignore"):
            return _FOLD[op](*(kind(v) for v in values)).item()

    def _simpler(self, op: str, args: Sequence[int], values: Sequence[Any]) -> int | None:
        """A node that is equal in every bit, None where there is none."""
        a, b = args[0], args[-1]
        left, right = values[0], values[-1]
        if op == "add":
            for x, y, v in ((a, b, right), (b, a, left)):
                if v == 0 and (math.copysign(1.0, v) < 0 or not self._signed[x]):
                    return x
                if self.op[y] == "neg":
                    return self.apply("sub", x, self.args[y][0])
        elif op == "sub":
            if right == 0 and (math.copysign(1.0, right) > 0 or not self._signed[a]):
                return a
            if left == 0 and math.copysign(1.0, left) < 0:
                return self.apply("neg", b)
            if self.op[b] == "neg":
                return self.apply("add", a, self.args[b][0])
        elif op == "mul":
            for x, v in ((a, right), (b, left)):
                if v == 1:
                    return x
                if v == -1:
                    return self.apply("neg", x)
        elif op == "div":
            if right == 1:
                return a
            if right == -1:
                return self.apply("neg", a)
            if right is not None and _power_of_two(right):
                return self.apply("mul", a, self.constant(1 / right, self.type[a]))
        elif (op in ("neg", "not") and self.op[a] == op) or (op == "abs" and self.op[a] == "neg"):
            return self.args[a][0] if op != "abs" else self.apply("abs", self.args[a][0])
        elif (op == "abs" and self.op[a] == "abs") or (op in ("min", "max", "and", "or") and a == b):
            return a
        elif op in ("and", "or"):
            for x, v in ((a, right), (b, left)):
                if v is not None:
                    return x if bool(v) == (op == "and") else self.constant(op == "or", FLAG)
        elif op in ("floor", "ceil", "trunc", "round") and self.type[a] == WHOLE:
            return a
        return None

    def _may_be_negative_zero(self, node: int) -> bool:
        op, args = self.op[node], self.args[node]
        if op == "const":
            return self.aux[node] != "nan" and not isinstance(self.aux[node], bool) and self.aux[node][1] < 0
        if op in ("add", "min", "max"):
            # A sum of numbers that cancel is +0: only -0 + -0 is -0.
            both = [self._signed[a] for a in args]
            return all(both) if op == "add" else any(both)
        if op == "sub":
            return self._signed[args[0]]
        if op == "mul":
            return args[0] != args[1]
        if op == "where":
            return self._signed[args[1]] or self._signed[args[2]]
        return op not in ("exp", "abs") and self.type[node] != FLAG


def _power_of_two(value: float) -> bool:
    # Within the normal numbers of both dtypes, and so their reciprocals.
    return abs(math.frexp(value)[0]) == 0.5 and 2**-100 < abs(value) < 2**100
