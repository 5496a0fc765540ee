"""Texts of a step: C++ for the processor, a kernel for a device."""

from __future__ import annotations

import torch

from .adjoint_steps import ReversedStep
from .cache import Trace
from .call import Given
from .emit.cpp import emit
from .emit.cuda import Dtypes, emit_cuda
from .emit.tables import Text
from .trace.step import Step, Traced, trace
from .trace.tracer import NotLoweredError
from .tree import plain

Form = int | torch.device
"""Of compiled code: how many vectors of rows advance side by side, or the device whose kernel it is."""


def written(step: Step, given: Given, form: Form) -> Trace:
    real = given.real
    if not isinstance(form, int):
        traced = _traced(step, given)
        text = kernel(traced, given)
        return _record(text, traced, real)
    try:
        traced = _traced(step, given)
        text = emit(*traced.program, form)
    except NotLoweredError:
        if real == torch.float64:
            raise
        # float64 within a program of float32: all of it in double, rounded where it ends.
        real = torch.float64
        traced = _traced(step, given, widened=True)
        text = emit(*traced.program, form)
    return _record(text, traced, real)


def _traced(step: Step, given: Given, *, widened: bool = False) -> Traced:
    return (
        step.traced(given, widened=widened)
        if isinstance(step, ReversedStep)
        else trace(step, given, widened=widened)
    )


def _record(text: Text, traced: Traced, real: torch.dtype) -> Trace:
    graph, _, following, outputs = traced.program
    times = graph.slots("now", [*following, *outputs])
    return Trace(text, traced.recipe, real, traced.outputs, traced.structure, traced.rows, times)


def kernel(traced: Traced, given: Given) -> Text:
    rows = [*(plain(leaf).dtype for leaf in given.row), *(numbers.dtype for numbers in traced.rows)]
    nows, carries = ([plain(leaf).dtype for leaf in leaves] for leaves in (given.now, given.carry))
    return emit_cuda(*traced.program, Dtypes(rows, nows, carries, [dtype for _, dtype in traced.outputs]))
