"""Data sheet of an exported file for an embedded programmer: measured, and as text."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.export import ExportedProgram

from ..lanes.calls.inputs import Given
from ..lanes.emit.schedule import Schedule
from ..lanes.trace.graph import FIXED
from ..lanes.trace.row_independence import doubt
from ..lanes.trace.step import Step, Traced
from ..lanes.trace.step import trace as trace_step
from ..lanes.trace.tracer import NotLoweredError
from ..results.files import visible
from ..signs import Sign

CALLS = 10_000
_WARM = 500


@dataclasses.dataclass(frozen=True)
class Port:
    """An input or an output, a row of the batch each."""

    name: str
    size: int | None  # entries a row; None for a scalar a row
    unit: str
    region: str  # where it is meant to be, or what it is


@dataclasses.dataclass(frozen=True)
class Latency:
    """Wall time of a call with one row, on one core."""

    calls: int
    median_us: float
    p99_us: float
    worst_us: float


@dataclasses.dataclass(frozen=True)
class Work:
    """Return the cost of a call with a row, from the operations of the program."""

    parameters: int  # constants
    flops: int  # additions and multiplications one each, a division and a comparison too
    functions: int  # exp, sin, cos, tanh, sqrt, pow: calls beside the flops
    bytes_constants: int
    bytes_in_out: int


_FUNCTIONS = {"exp", "expm1", "sin", "cos", "tanh", "sqrt", "rsqrt", "pow", "log", "log1p", "atan", "sigmoid"}
_FREE = {
    *("view", "slice", "select", "unsqueeze", "squeeze", "expand", "permute", "transpose", "cat", "clone"),
    *("full", "scalar_tensor", "empty", "ones_like", "zeros_like", "full_like", "new_ones", "new_zeros"),
    *("alias", "split_with_sizes", "getitem", "reshape", "arange", "t", "_unsafe_view", "copy", "_to_copy"),
}


def work(program: ExportedProgram) -> Work:
    """Return the cost of a call of a program of `trace`, at a row."""
    flops = functions = 0
    for node in program.graph.nodes:
        out = node.meta.get("val")
        if node.op != "call_function" or not isinstance(out, Tensor):
            continue
        name = getattr(node.target, "_opname", None) or node.target.__name__
        if name in _FREE:
            continue
        if name in _FUNCTIONS:
            functions += _count(out)
        elif name in ("mm", "bmm", "addmm"):
            left = node.args[1 if name == "addmm" else 0].meta["val"]
            inner = int(left.shape[-1])  # never the batch: rows do not meet
            flops += _count(out) * (2 * inner - 1) + (_count(out) if name == "addmm" else 0)
        elif name in ("sum", "mean", "prod", "amax", "amin"):
            flops += _count(node.args[0].meta["val"]) - _count(out)
        else:
            flops += _count(out)
    held = (*program.state_dict.values(), *program.constants.values())
    constants = [t for t in held if isinstance(t, Tensor)]
    placeholders = [n for n in program.graph.nodes if n.op == "placeholder"]
    fed = set(program.graph_signature.user_inputs)
    given = set(program.graph_signature.user_outputs)
    ends = [n.meta["val"] for n in placeholders if n.name in fed]
    ends += [n.meta["val"] for n in program.graph.nodes if n.name in given]
    return Work(
        parameters=sum(t.numel() for t in constants),
        flops=flops,
        functions=functions,
        bytes_constants=sum(t.numel() * t.element_size() for t in constants),
        bytes_in_out=sum(_count(t) * t.element_size() for t in ends),
    )


def _count(value: Tensor) -> int:
    """Entries of a tensor for a batch of one row."""
    return math.prod(int(size) for size in value.shape if not isinstance(size, torch.SymInt))


@Sign("timing the export")
def latency(run: Callable[[Tensor], object], x: Tensor, calls: int = CALLS) -> Latency:
    """Time calls one by one with the input x (1, n), on one core where the system lets us choose."""
    taken = torch.empty(calls, dtype=torch.float64, device="cpu")
    with torch.no_grad(), _one_core():
        for _ in range(_WARM):
            run(x)
        for k in range(calls):
            start = time.perf_counter_ns()
            run(x)
            taken[k] = time.perf_counter_ns() - start
    micro = taken / 1000
    return Latency(calls, float(micro.median()), float(micro.quantile(0.99)), float(micro.max()))


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {max(before)})
        yield
    finally:
        os.sched_setaffinity(0, before)


def worst_difference(got: tuple[Tensor, ...], wanted: tuple[Tensor, ...]) -> list[float]:
    """A number an output: the largest |got - wanted|, over the largest |wanted|."""
    pairs = zip(got, wanted, strict=True)
    wide = [(a.detach().double(), b.detach().double()) for a, b in pairs]
    return [float((a - b).abs().max() / b.abs().max()) for a, b in wide]


def markdown(sheet: Mapping[str, Any]) -> str:
    """The sheet of `staf-export` as text, from the JSON beside it."""
    work, late = sheet["work"], sheet["latency"]
    ports = [
        f"| {way} | `{port['name']}` | {_shape(port['size'])} "
        f"| {sheet['dtype']} | {port['unit']} | {port['region']} |"
        for way in ("input", "output")
        for port in sheet[way + "s"]
    ]
    errors = [
        f"| `{name}` | {sheet['equality'][name]:.2g} | {sheet['float32_error'][name]:.2g} |"
        for name in sheet["equality"]
    ]
    lines = [
        f"# {sheet['file']}",
        "",
        sheet["what"],
        "",
        f"From `{_named(sheet['run'])}`, trajectory {sheet['row']}, by staf_torch {sheet['version']} and "
        f"torch {sheet['torch']}. Batch B: {sheet['batch']}. Name: `{sheet['name']}`.",
        "",
        "| | name | shape | dtype | unit | region |",
        "|---|---|---|---|---|---|",
        *ports,
        "",
        "| a call with one row | |",
        "|---|---|",
        f"| constants | {work['parameters']} ({work['bytes_constants']} bytes) |",
        f"| flops | {work['flops']}, and {work['functions']} calls of exp, sin, ... |",
        f"| bytes | {work['bytes_constants'] + work['bytes_in_out']}: constants, input and output once |",
        f"| latency, median | {late['median_us']:.1f} us |",
        f"| latency, 99 % | {late['p99_us']:.1f} us |",
        f"| latency, worst of {late['calls']} | {late['worst_us']:.1f} us |",
        "",
        f"Latency: from Python, {sheet['runtime']}, one core of {sheet['machine']}.",
        "",
        "| output | file against library, same dtype | float32 against float64 |",
        "|---|---|---|",
        *errors,
        "",
        "Errors are the largest difference over the largest value, at 1000 random points of the region.",
    ]
    return "\n".join(lines) + "\n"


def _named(path: str) -> str:
    """A path as it stands between backquotes: on one line, and with nothing that a terminal obeys."""
    return visible(path).replace("\n", "\\n").replace("`", "'")


def _shape(size: int | None) -> str:
    return "(B,)" if size is None else f"(B, {size})"


_CHEAP_SCALARS = set("add sub mul div lt le eq ne and or xor neg abs min max not where sqrt".split())  # noqa: SIM905
_FREE_SCALARS = set("const param elem result collect carry state row now load pack cast loop".split())  # noqa: SIM905


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
        if op in _CHEAP_SCALARS:
            flops += count
        elif op not in _FREE_SCALARS:
            functions += count
    return Source(constants, flops, functions)


def traced_row(step: Step, row: Mapping[str, Tensor]) -> Traced | None:
    """Return the trace of a step of a row without a carry, (1, ...); None where it has no scalar form."""
    two = {key: part.expand(2, *part.shape[1:]).contiguous() for key, part in row.items()}
    given = Given.of((), (), two, 1)
    try:
        traced = trace_step(step, given, folded=True)
    except NotLoweredError:
        return None
    real = next(iter(row.values())).dtype
    plain = all(len(shape) < 2 and dtype == real for shape, dtype in traced.outputs)
    return traced if plain and doubt(step, given) is None else None
