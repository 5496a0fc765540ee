"""Calls of a program for inputs of fixed forms, with everything found out that does not change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from .adjoint.gradient_call import GradientCall
from .calls.choice import say, say_transformed
from .calls.inputs import Given, Where, form, ordinary, seen, seen_by_others, whole
from .calls.planned_call import PlannedCall
from .device.kernel import DeviceCall
from .torch_compile.operators import one_operator
from .tree import Tree, flatten, unflatten

if TYPE_CHECKING:
    from .program import Program

Plan = PlannedCall | DeviceCall


class Prepared:
    """A call of a program for inputs of fixed shapes, strides and dtypes; `Program.prepare` makes one.

    Called as the program is, without ``steps`` and ``every``. Inputs of other forms go to the program.

    Attributes:
        program: that is called.
        plan: of the compiled call, once there was one; None before, and where the definition runs.
            On a device of its own it is a plan of kernels.
    """

    def __init__(self, program: Program, given: Given, every: int) -> None:
        self.program, self._steps, self._every = program, given.times, whole("every", every, 1)
        leaves, self._structure = flatten(given.trees())
        self._forms = tuple(map(form, leaves))
        self._carries, self._carry = len(given.carry), given.structures["carry"]
        self.plan: Plan | None = None
        self._where: Where | None = None  # of the plan, be there one or not
        self._gradient: GradientCall | None = None
        self._refused = given.rows == 0 or given.times == 0

    def __getstate__(self) -> dict[str, Any]:
        """Return the parts of a copy, which finds its plan by itself."""
        return {**vars(self), "plan": None, "_where": None, "_gradient": None}

    @one_operator
    def __call__(self, carry: Tree, now: Tree = (), row: Tree = ()) -> tuple[Tree, Tree]:
        """The carry after the last step, and the outputs."""
        leaves, structure = flatten((row, now, carry))
        forms, where = seen(leaves)
        if structure != self._structure or forms != self._forms:
            return self.program(carry, now, row, steps=self._steps, every=self._every)
        return self.run(leaves, where, carry, now, row)

    def run(
        self, leaves: Sequence[Any], where: Where, carry: Tree, now: Tree, row: Tree
    ) -> tuple[Tree, Tree]:
        """Run with inputs that are known to fit, and to be somewhere."""
        if self._refused or not where or self.program.differentiated():
            return self._otherwise(leaves, carry, now, row)
        if where != self._where:
            given = Given.of(carry, now, row, self._steps)
            self.program.reads()
            if not self.program.differentiated():
                self.plan, self._where = self._planned(given, leaves, where), where
            if self.program.differentiated():
                return self._otherwise(leaves, carry, now, row)
        if self.plan is None:
            return self.program.definition(carry, now, row, steps=self._steps, every=self._every)
        rooms = iter(self.plan(leaves))
        return unflatten(self._carry, rooms), unflatten(self.plan.structure, rooms)

    def planned(self, leaves: Sequence[Any]) -> Plan | None:
        """Return the plan of the compiled call, made now if there is none; None where the definition runs.

        Leaves are those of the row, of the times and of the carry, of the forms that the call is prepared
        for.
        """
        where = ordinary(leaves)
        if self.plan is None and where and not self._refused:
            row, now, carry = unflatten(self._structure, iter(leaves))
            given = Given.of(carry, now, row, self._steps)
            self.plan, self._where = self._planned(given, leaves, where), where
        return self.plan

    def _otherwise(self, leaves: Sequence[Any], carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        """Run with gradients, or by the definition where no compiled code serves."""
        if not self._refused and torch.is_grad_enabled() and not seen_by_others():
            if self._gradient is None:
                given = Given.of(carry, now, row, self._steps)
                self._gradient = GradientCall(self.program, given, self._every)
            found = self._gradient(leaves)
            if found is not None:
                return found
        if self.program.compile:
            say_transformed(self.program.name)
        return self.program.definition(carry, now, row, steps=self._steps, every=self._every)

    def _planned(self, given: Given, leaves: Sequence[Any], where: Where) -> Plan | None:
        compiled = self.program.find(given)
        if compiled is None:
            return None
        times = [False] * len(given.row) + [True] * len(given.now) + [False] * len(given.carry)
        sizes: dict[str, Any] = {
            "rows": given.rows,
            "steps": given.times,
            "every": self._every,
            "once": len(given.row),
        }
        if isinstance(where, bool):
            return PlannedCall(compiled, leaves, times, **sizes)
        try:
            return DeviceCall(compiled, leaves, times, **sizes, where=where)
        except OSError as error:
            say(f"programs on {where}", str(error), "no build")
            return None
