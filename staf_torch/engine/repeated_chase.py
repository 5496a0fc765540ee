"""Chases that were made before, of other states: a call is then that of its program and no more.

What a chase checks and starts from follows, but for its states, from objects that have not changed since.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any

from torch import Tensor

from ..lanes import Program
from ..lanes.calls.choice import worth
from ..lanes.calls.inputs import form, ordinary
from ..lanes.dependencies.walk import is_users
from ..lanes.device.kernel import DeviceCall, beside_history
from ..lanes.tree import flatten, unflatten
from .problem import Problem
from .quantities import Numbers
from .recursion import last_weights, start
from .result import ChaseResult, ChaseWeights
from .row_program import SHORTEST, first_carry, kept, settings_of

_MOST = 64  # chases that are remembered


class Repeated:
    """A chase from zero weights.

    Args:
        program: of it.
        problem: what is chased.
        states: an example, (B, T, n).
        everything: whether all results are wanted, or the weights alone.
        history: whether those of every time are, or the last.
    """

    def __init__(
        self, program: Program, problem: Problem, states: Tensor, *, everything: bool, history: bool
    ) -> None:
        self.program, self._problem, self._history = program, problem, history
        rows, times, _ = states.shape
        one = first_carry(problem, start(problem, states[:1], None))
        leaves, structure = flatten(one)
        self._begun = next((k for k, leaf in enumerate(leaves, 1) if leaf is one.chase.states), 0)
        self._first = [leaf.expand(rows, *leaf.shape[1:]) for leaf in leaves]
        if self._begun:
            self._first[self._begun - 1] = _twice(states)
        carry = unflatten(structure, iter(self._first))
        prepared = program.prepare(carry, states, every=1 if history else times)
        self.plan, self._where = prepared.planned([states, *self._first]), ordinary((states,))
        if self.plan is None:
            return
        self._end: Any = unflatten(structure, iter(range(len(leaves))))  # which result is what
        self._outputs: Any = unflatten(self.plan.structure, iter(range(len(leaves), 10**6)))
        settings = settings_of(problem, states, everything)
        self._warns, self._owners = settings[-1], (*_parts(problem), *settings)
        chase = self._end.chase
        wanted = {chase.diverged_at} if history else {chase.diverged_at, chase.weights, chase.log_gain}
        if isinstance(self.plan, DeviceCall):
            self.plan.leave_out({*range(len(leaves))} - wanted)

    def rooms(self, states: Tensor) -> Sequence[Any] | None:
        """Return what the program leaves behind at states of this form, None where more is to be done."""
        if (
            self.plan is None
            or not worth(states.shape[1] >= SHORTEST, states)
            or ordinary((states,)) != self._where
            or self.program.differentiated()
        ):
            return None
        leaves = [states, *self._first]
        if self._begun:
            leaves[self._begun] = _twice(states)
        # A device computes while we look whether objects have changed; then nobody takes what it finds.
        begun = self.plan(leaves) if isinstance(self.plan, DeviceCall) else None
        if kept.unchanged(*self._owners) is not self.program:
            return None
        found = self.plan(leaves) if begun is None else begun
        if self._warns:
            self._problem.basis.warn_reach(float(found[self._end.reach].max()), stacklevel=5)
        return found

    def weights(self, rooms: Sequence[Any]) -> ChaseWeights:
        """Return the weights among what the program left behind."""
        chase = self._end.chase
        diverged_at = rooms[chase.diverged_at]
        if self._history:
            weights = rooms[self._outputs.weights]
            return ChaseWeights(weights, beside_history(diverged_at, weights))
        carry = chase._replace(weights=rooms[chase.weights], log_gain=rooms[chase.log_gain])
        return ChaseWeights(last_weights(carry).unsqueeze(1), diverged_at)

    def results(self, states: Tensor, rooms: Sequence[Any]) -> ChaseResult:
        """Return everything among what the program left behind."""
        numbers, certificate = self._outputs.numbers, self._outputs.certificate
        found: Numbers = type(numbers)(*(rooms[k] for k in numbers))
        vouched = None if certificate is None else type(certificate)(*(rooms[k] for k in certificate))
        return found.result(states, rooms[self._end.chase.diverged_at], vouched)


_known: dict[Hashable, Repeated] = {}
_once: dict[Hashable, Problem] = {}  # chases made one time, kept so that an address is used once


def repeated(key: Hashable) -> Repeated | None:
    """Return the chase of a key of `key_of`, if there was one."""
    return _known.get(key)


def remember(
    key: Hashable,
    program: Program | None,
    problem: Problem,
    states: Tensor,
    *,
    everything: bool,
    history: bool,
) -> None:
    """Prepare for a chase that is made for the second time, where its program needs no more than its states.

    Args:
        key: of `key_of`.
        program, problem, states, everything, history: as in `Repeated`.
    """
    if key is None or program is None or is_users(type(problem.law)) or program.has_rows():
        return
    if _once.pop(key, None) is None:  # to prepare takes as long as a short chase
        while len(_once) >= _MOST:
            _once.pop(next(iter(_once)), None)  # by whichever thread comes first
        _once[key] = problem
        return
    while len(_known) >= _MOST:
        _known.pop(next(iter(_known)), None)
    _known[key] = Repeated(program, problem, states, everything=everything, history=history)


def key_of(states: Any, parts: tuple[Any, ...], *settings: Any) -> Hashable:
    """Return by which a chase is known again; None of one that begins elsewhere, or that is refused.

    Args:
        states: one tensor, or what is refused.
        parts: basis, target, law, predictor.
        settings: iterations, and what else decides.
    """
    if type(states) is not Tensor or type(settings[0]) is not int:
        return None
    try:
        return (*map(id, parts), *settings, form(states))
    except RuntimeError:  # it is not dense, which the checks refuse
        return None


def _parts(problem: Problem) -> tuple[Any, ...]:
    return problem.basis, problem.target, problem.law, problem.predictor


def _twice(states: Tensor) -> Tensor:
    """The first state as the two before it, (B, 2, n)."""
    return states[:, :1].expand(-1, 2, -1)
