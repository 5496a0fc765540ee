"""Scalar programs computed node by node in NumPy: what was written down of a step, without any compiler."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from staf_torch.lanes.given import Given
from staf_torch.lanes.one_row import Traced, trace

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in ("sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan")},
    **{name: getattr(np, name) for name in ("tanh", "sinh", "cosh", "floor", "ceil", "trunc", "log2")},
    **{name: getattr(np, name) for name in ("log10", "exp2", "hypot", "copysign", "fmod", "abs")},
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asin", "acos", "atan", "asinh", "acosh", "atanh")},
    **{"atan2": np.arctan2, "pow": np.power, "round": np.rint, "min": np.minimum, "max": np.maximum},
    **{"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative},
    **{"lt": np.less, "le": np.less_equal, "eq": np.equal, "ne": np.not_equal},
    **{"and": np.logical_and, "or": np.logical_or, "xor": np.logical_xor, "not": np.logical_not},
    "where": lambda chosen, a, b: a if chosen else b,
    "erf": lambda x: math.erf(x),
    "erfc": lambda x: math.erfc(x),
    "lgamma": lambda x: torch.lgamma(torch.tensor(float(x), dtype=torch.float64)).item(),
    "cast": lambda x: np.float64(x),
    "copy": lambda x: x,
}


class Row:
    """One row of a program at one time: every node once, those of a loop once a pass."""

    def __init__(self, traced: Traced, inputs: Mapping[str, Sequence[Tensor]]) -> None:
        """Of what a row has, what a time brings and what is carried: a list of tensors each."""
        self.graph, _, self.following, self.outputs = traced.program
        self.parameters = traced.recipe.values.tolist()
        self.inputs = {op: [leaf.reshape(-1).tolist() for leaf in leaves] for op, leaves in inputs.items()}
        self.depths, self.memories = [-1], [dict[int, Any]()]  # of the program, of the loops that run
        self.passes: dict[int, int] = {}
        self.carried: dict[int, list[Any]] = {}
        self.done: dict[int, tuple[list[Any], list[list[Any]]]] = {}

    def value(self, node: int) -> Any:
        """The number, flag or array of a node."""
        depth = self.graph.depth[node]
        at = max(k for k, of_loop in enumerate(self.depths) if of_loop <= depth)
        if node not in self.memories[at]:
            self.memories[at][node] = self._found(node)
        return self.memories[at][node]

    def _found(self, node: int) -> Any:
        graph = self.graph
        op, args, aux = graph.op[node], graph.args[node], graph.aux[node]
        if op == "const":
            found = graph.value(node)
            return found if isinstance(found, bool) else np.float64(found)  # type: ignore[arg-type]
        if op == "param":
            return np.float64(self.parameters[aux])
        if op in self.inputs:
            number = self.inputs[op][aux[0]][aux[1]]
            return number if isinstance(number, bool) else np.float64(number)
        if op == "elem":
            return self.value(args[0])[aux]
        if op == "pack":
            return [self.value(each) for each in args]
        if op == "map":
            name, shape, *places = aux
            return [self._call(name, self._entries(args, places, k)) for k in range(math.prod(shape))]
        if op == "dot":
            outs, count, *places = aux
            rows = [range(out * count, (out + 1) * count) for out in range(outs)]
            return [np.sum([math.prod(self._entries(args, places, k)) for k in row]) for row in rows]
        if op == "load":
            number, start, stride = aux
            return self.value(args[0])[start + self.passes[number] * stride]
        if op in ("carry", "carrys"):
            return self.carried[aux[0]][aux[1]]
        if op in ("result", "results", "collect"):
            ends, collected = self._loop(aux[0])
            return collected[aux[1]] if op == "collect" else ends[aux[1]]
        return self._call(op, [self.value(each) for each in args])

    def _entries(self, args: Sequence[int], places: Sequence[Any], k: int) -> list[Any]:
        read = zip(args, places, strict=True)
        return [self.value(n) if place is None else self.value(n)[place[k]] for n, place in read]

    def _call(self, op: str, values: Sequence[Any]) -> Any:
        with np.errstate(all="ignore"):
            return _FUNCTIONS[op](*values)

    def _loop(self, number: int) -> tuple[list[Any], list[list[Any]]]:
        home = self.memories[max(k for k, d in enumerate(self.depths) if d <= self.graph.loops[number].home)]
        key = -1 - number  # no node is called so
        if key not in home:
            home[key] = self._run(number)
        return home[key]  # type: ignore[no-any-return]

    def _run(self, number: int) -> tuple[list[Any], list[list[Any]]]:
        loop = self.graph.loops[number]
        collected: list[list[Any]] = [[] for _ in loop.collected]
        carried = [self.value(each) for each in loop.initial]
        for k in range(loop.count):
            self.depths.append(loop.depth)
            self.memories.append({})
            self.passes[number], self.carried[number] = k, carried
            ends = loop.going >= 0 and not self.value(loop.going)
            if not ends:
                carried = [self.value(each) for each in loop.following]
                for into, nodes in zip(collected, loop.collected, strict=True):
                    into += [self.value(each) for each in nodes]
            self.depths.pop()
            self.memories.pop()
            if ends:
                break
        return carried, collected


def interpreted(body: Callable[..., Any], *rows: Tensor, folded: bool = False) -> list[list[Tensor]]:
    """What the program of a function of rows computes: for every row its results, as one row would.

    Args:
        body: of (B, ...) to a list of tensors.
        rows: (B, ...).
        folded: whether captured numbers are a part of the program.
    """

    def step(carry: Tensor, now: tuple[()], row: tuple[Tensor, ...]) -> tuple[Tensor, list[Tensor]]:
        return carry, [each if each.shape[:1] == (len(carry),) else each.unsqueeze(0) for each in body(*row)]

    carry = torch.zeros(len(rows[0]), dtype=rows[0].dtype)
    traced = trace(step, Given.of(carry, (), rows, 1), folded=folded)
    found = []
    for b in range(len(rows[0])):
        row = Row(traced, {"row": [each[b] for each in rows], "now": [], "state": [carry[b]]})
        numbers, leaves = iter(traced.program[3]), []
        for shape, dtype in traced.outputs:
            values = [row.value(next(numbers)) for _ in range(shape.numel())]
            leaves.append(
                torch.tensor([float(v) for v in values], dtype=torch.float64).reshape(shape).to(dtype)
            )
        found.append(leaves)
    return found


def check(body: Callable[..., Any], *rows: Tensor, folded: bool = False) -> None:
    """Fail where a program does not compute what the function itself does."""
    rtol = 1e-11 if rows[0].dtype == torch.float64 else 1e-5
    for b, leaves in enumerate(interpreted(body, *rows, folded=folded)):
        wanted = body(*(row[b : b + 1] for row in rows))
        assert len(wanted) == len(leaves)
        for k, (one, other) in enumerate(zip(leaves, wanted, strict=True)):
            other = other[0] if other.shape[:1] == (1,) else other
            assert one.dtype == other.dtype
            torch.testing.assert_close(
                one, other, rtol=rtol, atol=rtol, equal_nan=True, msg=lambda text, k=k: f"result {k}: {text}"
            )
