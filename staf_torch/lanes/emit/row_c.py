"""A step of one row as C: traced with its numbers apart, which stand in a table by their names."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from ..calls.inputs import Given
from ..dependencies.contents import Contents
from ..dependencies.told_numbers import leads_by_copies, told_copies
from ..trace.graph import WIDE
from ..trace.kept_numbers import kept
from ..trace.step import Step, Traced, trace
from ..trace.tracer import NotLoweredError
from ..tree import labels
from .c import CTable, Names, c_text
from .number_names import named_tensors, said

_log = logging.getLogger(__name__)


class RowC(NamedTuple):
    """A step of a single row, traced for C.

    Args:
        traced: the program.
        given: inputs, of which the first row's carry is that of the start.
        table: its numbers; none where they are part of the text.
    """

    traced: Traced
    given: Given
    table: CTable

    @classmethod
    def of(
        cls, step: Step, given: Given, parts: Sequence[Any] = (), make: Callable[..., Step] | None = None
    ) -> RowC:
        """Trace a step.

        Args:
            step: of a program.
            given: examples of its inputs.
            parts: all that the step reads, where that is known.
            make: the step of the parts, whose floats are then numbers of the table, too.

        Raises:
            NotLoweredError: if an operation has no scalar form.
        """
        why = "it has float64 inside of float32"
        for known, names in _spelled(step, parts, make):
            try:
                traced = _kept(known, given)
            except NotLoweredError as error:
                why = str(error)
                continue
            if not traced.rows and not wide(traced):
                values = [float(x) for x in traced.recipe.values.tolist()]
                return cls(traced, given, CTable(values, said(traced.recipe, named_tensors(names))))
        traced = trace(step, given, folded=True)
        _log.warning("C with its numbers in the text, not in a table that can be changed: %s", why)
        return cls(traced, given, CTable())

    def text(self, name: str, outputs: Sequence[str] | None = None, note: str = "") -> str:
        """Return the header, as `Program.c_source`."""
        traced, kinds = self.traced, self.given.structures
        rows, nows, carries = (labels(kinds[kind], kind) for kind in ("row", "now", "carry"))
        ends = labels(traced.structure, "out") if outputs is None else outputs
        start = [float(x) for leaf in self.given.carry for x in leaf[0].reshape(-1).tolist()]
        names = Names(rows, nows, carries, ends)
        return c_text(*traced.program, name=name, names=names, start=start, note=note, numbers=self.table)


def wide(traced: Traced) -> bool:
    """Return whether a program of float32 has float64 inside."""
    graph = traced.program[0]
    return graph.single and WIDE in graph.type


def _spelled(
    step: Step, parts: Sequence[Any], make: Callable[..., Step] | None
) -> Iterator[tuple[Step, dict[str, Any]]]:
    """Yield the step with floats of the library's objects as tensors, where it can be, and as it is."""
    given = tuple(parts)
    names = [""] if len(given) == 1 else [f"part{k}" for k in range(len(given))]
    if make is not None:
        read = Contents(*given, telling=True, watched=False)
        if read.told and read.key is not None and leads_by_copies(read, given):
            copies = told_copies(read.told, given)
            yield make(*copies), dict(zip(names, copies, strict=True))
    yield step, dict(zip(names, given, strict=True)) or {"": step}


def _kept(step: Step, given: Given) -> Traced:
    """Trace a step, once more where captured numbers can stay what they are."""
    traced = trace(step, given)
    stay = kept(traced.recipe, given.real)
    if stay:
        try:
            return trace(step, given, kept=stay)
        except NotLoweredError:  # it asks for a value that follows from them
            pass
    return traced
