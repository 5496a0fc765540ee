"""Texts of a step, C++ for the processor or a kernel for a device, and what is built of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import trace_files
from .adjoint.carries import carried
from .adjoint.steps import ReversedStep
from .calls.inputs import Given
from .calls.planned_call import Compiled
from .compilation.compiler import REVERSED
from .dependencies.contents import Contents
from .emit.cpp import emit
from .emit.cuda import Dtypes, emit_cuda
from .emit.tables import Text
from .row_numbers import RowNumbers
from .trace.step import Step, Traced, trace
from .trace.tracer import NotLoweredError
from .trace_files import Trace
from .tree import plain

Form = int | torch.device
"""Of compiled code: how many vectors of rows advance side by side, or the device whose kernel it is."""


class Built(NamedTuple):
    """The record of a program that was built."""

    compiled: Compiled
    trace: Trace  # from which it was made
    followed: bool = False  # whether the trace is of the program that this one follows

    @classmethod
    def of(cls, made: Trace, call: Any, given: Given) -> Built:
        """Return the record of a trace and of the code of its text, for the numbers that it was made with."""
        table = made.text.numbers(made.recipe.values, made.real)
        shapes = tuple((leaf.shape[1:], leaf.dtype) for leaf in given.carry)
        return cls(Compiled(call, table, made.real, shapes, made.outputs, made.structure, made.rows), made)

    def with_others(
        self, others: Mapping[int, Tensor], in_place_of: Callable[[Tensor], Tensor]
    ) -> Built | None:
        """Return the built code with a table of the numbers of other tensors, None where its text differs."""
        numbers = self.trace.recipe.again(others)
        if numbers is None:
            return None
        table = self.trace.text.numbers(numbers, self.compiled.real)
        given = [in_place_of(each) for each in self.trace.rows]
        rows = tuple(each for each in given if isinstance(each, RowNumbers))
        if len(rows) < len(given):
            return None
        return self._replace(compiled=self.compiled._replace(table=table, rows=rows))


def known(step: Step, described: tuple[bytes, Sequence[Tensor]] | None, given: Given, form: Form) -> Trace:
    """Return the trace of a step with a single row, from the cache where it has been traced before.

    Args:
        step: of the program.
        described: as `Program.described` was told; None where nobody has.
        given: examples of the inputs.
        form: of the code.
    """
    shapes = None if described is None else Contents(given.key()).signature()
    if described is None or shapes is None or not trace_files.unpatched():
        return written(step, given, form)
    by, tensors = described
    path = trace_files.place(by, shapes, form)
    found = trace_files.load(path, tensors)
    if found is None:
        found = written(step, given, form)
        trace_files.save(path, found, tensors)
    return found


def written(step: Step, given: Given, form: Form) -> Trace:
    real = given.real
    if not isinstance(form, int):
        traced = _traced(step, given)
        text = kernel(traced, given)
        return _record(text, traced, real)
    try:
        traced = _traced(step, given)
        text = _emitted(step, traced, form)
    except NotLoweredError:
        if real == torch.float64:
            raise
        # float64 within a program of float32: all of it in double, rounded where it ends.
        real = torch.float64
        traced = _traced(step, given, widened=True)
        text = _emitted(step, traced, form)
    return _record(text, traced, real)


def _emitted(step: Step, traced: Traced, form: int) -> Text:
    text = emit(*traced.program, form)
    return text._replace(source=f"{REVERSED}\n{text.source}") if isinstance(step, ReversedStep) else text


def _traced(step: Step, given: Given, *, widened: bool = False) -> Traced:
    return (
        step.traced(given, widened=widened)
        if isinstance(step, ReversedStep)
        else trace(step, given, widened=widened)
    )


def _record(text: Text, traced: Traced, real: torch.dtype) -> Trace:
    graph, _, following, outputs = traced.program
    times, where = graph.slots("now", [*following, *outputs]), carried(*traced.program)
    return Trace(text, traced.recipe, real, traced.outputs, traced.structure, traced.rows, times, where)


def kernel(traced: Traced, given: Given) -> Text:
    rows = [*(plain(leaf).dtype for leaf in given.row), *(numbers.dtype for numbers in traced.rows)]
    nows, carries = ([plain(leaf).dtype for leaf in leaves] for leaves in (given.now, given.carry))
    return emit_cuda(*traced.program, Dtypes(rows, nows, carries, [dtype for _, dtype in traced.outputs]))
