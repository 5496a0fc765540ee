"""Scalar programs of one row for headers and ONNX files in loops, and what a call of them costs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes.calls.inputs import Given
from ..lanes.emit.schedule import Schedule
from ..lanes.trace.graph import FIXED
from ..lanes.trace.row_independence import doubt
from ..lanes.trace.step import Step, Traced, trace
from ..lanes.trace.tracer import NotLoweredError
from .data_sheet import Work

_CHEAP = set("add sub mul div lt le eq ne and or xor neg abs min max not where sqrt".split())  # noqa: SIM905
_FREE = set("const param elem result collect carry state row now load pack cast loop".split())  # noqa: SIM905


class Source(NamedTuple):
    """Cost of a call of a header."""

    constants: int  # numbers in it
    flops: int
    functions: int  # calls of exp and the like

    def work(self, entries: int, dtype: torch.dtype) -> Work:
        """Return the cost in the words of `staf-export`, with as many entries of all inputs and outputs."""
        size = dtype.itemsize
        return Work(self.constants, self.flops, self.functions, self.constants * size, entries * size)


def counted(traced: Traced) -> Source:
    """Return the cost of a call: loops have fixed lengths, and both sides of a choice are computed."""
    graph, _, following, ends = traced.program
    schedule = Schedule(graph, following, ends)
    constants = flops = functions = 0
    for node in schedule.live:
        op, count = graph.op[node], schedule.repeats(node)
        constants += op in FIXED
        if op in ("map", "dot"):
            aux = graph.aux[node]
            count *= math.prod(aux[1]) if op == "map" else 2 * aux[0] * aux[1]
            op = aux[0] if op == "map" else "add"
        if op in _CHEAP:
            flops += count
        elif op not in _FREE:
            functions += count
    return Source(constants, flops, functions)


def traced_row(step: Step, row: Mapping[str, Tensor]) -> Traced | None:
    """Return the trace of a step of a row without a carry, (1, ...); None where it has no scalar form."""
    two = {key: part.expand(2, *part.shape[1:]).contiguous() for key, part in row.items()}
    given = Given.of((), (), two, 1)
    try:
        traced = trace(step, given, folded=True)
    except NotLoweredError:
        return None
    real = next(iter(row.values())).dtype
    plain = all(len(shape) < 2 and dtype == real for shape, dtype in traced.outputs)
    return traced if plain and doubt(step, given) is None else None
