"""Functions of the rows of a batch that a program serves: what stands behind a compiled method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from .calls import inputs
from .calls.planned_call import PlannedCall
from .prepared_call import Plan
from .program import Program
from .shared_programs import shared_program
from .trace.step import Step
from .tree import Tree

_KEPT = 64  # shapes of calls that are remembered


def is_state(x: Tensor) -> bool:
    return x.is_floating_point() and x.dim() > 0


def check_states(given: Sequence[Tensor]) -> None:
    """Refuse states that are integers, flags or single numbers, when their form is new."""
    for x in given:
        if not is_state(x):
            raise ValueError(f"states must be (..., n) of floating point; got {tuple(x.shape)} of {x.dtype}.")


class Rows:
    """y = function(a, b, ...), (B, ...) to (B, ...), where nobody traces or differentiates.

    Args:
        function: plain torch, in which no row sees another.
        name: in the log.
        parts: all that ``function`` reads, for `shared_program`; none where nothing is to be shared.
        copies: as in `Program`.
        make: ``function`` from the parts, as in `shared_program`.
    """

    def __init__(
        self,
        function: Callable[..., Tree],
        name: str,
        *parts: Any,
        copies: int = 1,
        make: Callable[..., Callable[..., Tree]] | None = None,
    ) -> None:
        def step_of(function: Callable[..., Tree]) -> Step:
            return lambda carry, _, row: (carry, function(*row))

        if parts:
            told = None if make is None else (lambda *others: step_of(make(*others)))
            self.program = shared_program(name, step_of(function), *parts, copies=copies, make=told)
        else:
            self.program = Program(step_of(function), name=name, copies=copies)
        self._plans: dict[Any, Plan] = {}
        self.at_once: dict[Any, Callable[[Tensor], Tensor]] = {}

    @property
    def compiled(self) -> bool:
        """Return whether a compiled program has served a call."""
        return bool(self._plans)

    def __call__(self, *given: Tensor) -> Tensor:
        """Return y with a dimension of one time after the rows, (B, 1, ...); (n,) is one row."""
        # Shapes alone: the caller has looked at the rest.
        key = tuple(
            [(x.shape, x.stride(), x.dtype, inputs.processor if x.is_cpu else x.device) for x in given]
        )
        plan = self._plans.get(key)
        if plan is not None:
            return plan(given)[0]
        check_states(given)
        rows = [x.unsqueeze(0) if x.dim() == 1 else x for x in given]
        plan, found = self.planned(*rows)
        if plan is not None:
            if len(self._plans) >= _KEPT:
                self._plans.clear()
                self.at_once.clear()
            self._plans[key] = plan
            keep_at_once(self.at_once, plan, *given)
        return found

    def planned(self, *given: Tensor) -> tuple[Plan | None, Tensor]:
        """Return the plan of calls with such inputs, (B, ...), None where the definition runs; and y."""
        prepared = self.program.prepare((), (), tuple(given), steps=1)
        found: Tensor = prepared((), (), tuple(given))[1]
        return prepared.plan, found


def keep_at_once(known: dict[Any, Callable[[Tensor], Tensor]], plan: Plan, x: Tensor, *more: Tensor) -> None:
    """Note what finds y for states like x alone, (n,) or (B, n), where that is a call of machine code."""
    found = plan.of_states(*x.shape[:-1]) if isinstance(plan, PlannedCall) and not more else None
    if found is not None:
        known[x.shape, x.stride(), x.dtype] = found


class Trees:
    """The variant of `Rows` that maps trees (B, ...) to trees (B, ...)."""

    def __init__(self, rows: Rows) -> None:
        self.program, self.compiled = rows.program, False
        self.at_once: dict[Any, Callable[[Tensor], Tensor]] = {}

    def __call__(self, *given: Tree) -> Tree:
        self.compiled = self.compiled or self.program.compiles((), (), given, steps=1)
        return self.program.once(*given)
