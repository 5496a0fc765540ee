"""The step of a chase as a row program: the definition of `recursion.py`, compiled by `lanes`.

Everything is evaluated in the step from the state x_k alone: kernel, V at the centers, local space,
predictor, law and results. No matrix and no value at a center ever reaches memory.
"""

from __future__ import annotations

import copy
from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..approximation.basis import GramStructure, StaFBasis, Target
from ..lanes import Program
from ..lanes.calls.choice import say_transformed, worth
from ..lanes.calls.inputs import form, ordinary, served
from ..lanes.dependencies.walk import is_users
from ..lanes.device.kernel import DeviceCall, beside_history
from ..lanes.shared_programs import SharedPrograms
from ..lanes.tree import flatten, unflatten
from ..optim.base import UpdateLaw
from ..optim.objective import NativeError, Objective, Precomputed
from .predictors import Predictor
from .problem import Problem
from .quantities import Known, Numbers, know, numbers, precompute, unless
from .recursion import Carry, Corrected, Link, Moment, all_finite, correct, last_weights, start
from .result import Certificate, ChaseResult, ChaseWeights, certify, first_link

SHORTEST = 16  # times of a chase that is worth a program, which takes some tenths of a second to trace
_UNROLLED = 8  # centers up to which the Gram matrix is formed; above it stays in its factors


kept = SharedPrograms("a chase")


class RowCarry(NamedTuple):
    """Carry of the compiled chase from one time to the next."""

    chase: Carry
    reach: Tensor  # (B,) the largest |x| nu(x) so far, of which a caller may warn
    unit: Tensor  # (B,) e^{-log_gain} of the chase


class Outputs(NamedTuple):
    """Outputs recorded at a time; None where they are not requested."""

    weights: Tensor | None = None  # the paper's w, (B, M)
    numbers: Numbers | None = None
    certificate: Certificate | None = None


class Step:
    """The step of a chase: (carry, x_k) to the carry and `Outputs`."""

    def __init__(self, problem: Problem, everything: bool, warns: bool = True) -> None:
        self.problem, self.everything, self.warns = problem, everything, warns

    def __call__(self, carry: RowCarry, x: Tensor, row: object) -> tuple[RowCarry, Outputs]:
        problem, last = self.problem, carry.chase
        known = know(problem, x, local=self.everything or bool(problem.law.needs))
        structure = known.structure
        assert isinstance(last.time, Tensor)
        begins = last.time == 0
        if structure.log_gain is None:  # it never changes: a compiler is told what it is
            last = last._replace(log_gain=known.log_gain)
        else:  # weights begin in units of the first state
            last = last._replace(log_gain=torch.where(begins, known.log_gain, last.log_gain))
        gram = _symmetric(structure.scaled()).expand(*x.shape[:-1], problem.basis.count, problem.basis.count)
        found = precompute(problem, known, gram)
        prediction: tuple[Tensor, ...] = ()
        states = last.states
        if problem.predictor is not None and states is not None:
            around = torch.cat((states, x.unsqueeze(1)), dim=1)
            prepared = problem.predictor.prepare(problem.basis, problem.target, around, last.time)
            prediction, states = tuple(part.squeeze(1) for part in prepared), around[:, 1:]
        at = Moment(known.log_gain, _usable(structure, gram, known.values), prediction)
        objective = _objective(structure, gram, known.values, found)
        before, now = correct(problem, objective, at, last)
        now = now._replace(states=states)
        warns = self.warns and structure.log_gain is not None
        reach = torch.maximum(carry.reach, self._reach(x)) if warns else carry.reach
        lost = now.diverged_at >= 0
        unit = (-known.log_gain).exp()  # not of now.log_gain: of x_k alone, for many times at once
        if structure.log_gain is None:  # 1 at all times: the results are the weights that are carried on
            kept = RowCarry(now._replace(log_gain=carry.chase.log_gain), reach, carry.unit)
        else:
            unit = torch.where(lost & ~begins, carry.unit, unit)
            kept = RowCarry(now, reach, unit)
        if not self.everything:
            return kept, Outputs(weights=now.weights * unit.unsqueeze(-1))
        run = Corrected(before, now.weights, known.values, known.log_gain)
        outputs = Outputs(numbers=numbers(known, run, unit, lost, objective.curvature))
        if problem.certificate:
            vouched, link = self._certified(known, gram, run, last)
            outputs = outputs._replace(certificate=Certificate(*(unless(lost, term) for term in vouched)))
            kept = kept._replace(chase=kept.chase._replace(link=link))
        return kept, outputs

    def _certified(self, known: Known, gram: Tensor, run: Corrected, last: Carry) -> tuple[Certificate, Link]:
        assert known.local is not None
        assert last.link is not None
        assert isinstance(last.time, Tensor)
        ideal, begins = known.local.ideal, last.time == 0
        first = first_link(gram, run.log_gain, ideal)
        pairs = zip(first, last.link, strict=True)
        before = (torch.where(begins.view(-1, *[1] * (new.dim() - 1)), new, old) for new, old in pairs)
        return certify(self.problem, gram, run, ideal, Link(*before))

    def _reach(self, x: Tensor) -> Tensor:
        reach = x.square().sum(-1).sqrt() * self.problem.basis.centers.radius(x)
        return torch.where(torch.isfinite(reach), reach, 0.0)


def first_carry(problem: Problem, carry: Carry) -> RowCarry:
    """Return what a program starts from."""
    weights = carry.weights
    zero, count = torch.zeros_like(carry.log_gain), weights.shape[-1]
    link = None
    if problem.certificate:
        link = Link(weights.new_zeros(*weights.shape, count), zero, torch.zeros_like(weights))
    return RowCarry(
        carry._replace(time=torch.zeros_like(carry.diverged_at), link=link), zero, (-carry.log_gain).exp()
    )


def settings_of(problem: Problem, states: Tensor, everything: bool) -> tuple[int, bool, bool, bool]:
    """Return the numbers that decide what a program does.

    The last says whether |x| nu(x) is looked at: not on a device, where a call waits for nothing.
    """
    return problem.inner_steps, problem.certificate, everything, served((states,)) is True


def program(problem: Problem, states: Tensor, carry: RowCarry, *, everything: bool) -> Program | None:
    """Return the program of a chase, None where the definition serves.

    One that differs from another in numbers alone takes over its text: `lanes.shared_programs`.
    """
    formal = states.is_meta  # of which a program needs one time alone
    if not formal and not worth(states.shape[1] >= SHORTEST, states):
        return None
    if not formal and not served((states, carry.chase.weights)):
        say_transformed("the chase")
        return None
    settings = settings_of(problem, states, everything)
    owners = problem.basis, problem.target, problem.law, problem.predictor, *settings
    made = kept.unchanged(*owners)
    if made is None:

        def make(
            basis: StaFBasis, target: Target, law: UpdateLaw, predictor: Predictor | None, _: Any
        ) -> Step:
            other = copy.copy(problem)  # which was checked
            vars(other).update(basis=basis, target=target, law=law, predictor=predictor)
            return Step(other, everything, settings[-1])

        parts = problem.basis, _plain(problem.target), problem.law, problem.predictor, settings
        made = kept.of(make(*parts), *parts, owners=owners, make=make)
    return made if formal or made.compiles(carry, states) else None


def _plain(target: Target) -> Target:
    """Return a target without `torch.compile`, which has nothing to gain here."""
    plain: Any = getattr(target, "_orig_mod", None) if isinstance(target, nn.Module) else None
    plain = plain if plain is not None else getattr(target, "_torchdynamo_orig_callable", None)
    return target if plain is None else plain


def _symmetric(gram: Tensor) -> Tensor:
    """Return K with its lower triangle in the place of the upper one: half the numbers."""
    lower = torch.ones(gram.shape[-2:], dtype=torch.bool, device=gram.device).tril()
    return torch.where(lower, gram, gram.mT)


def _usable(structure: GramStructure, gram: Tensor, values: Tensor) -> Tensor:
    """Return whether V(c) and K are finite, (B,); K = S K0 S is where its largest entries are."""
    if structure.core.dim() > 2:
        return all_finite(values) & all_finite(gram.flatten(-2))
    largest = structure.core.abs().amax()
    if structure.scale is not None:
        largest = largest * structure.scale.amax(-1).square()
    return all_finite(values) & (largest < torch.inf)


def _objective(structure: GramStructure, gram: Tensor, values: Tensor, found: Precomputed) -> Objective:
    if structure.core.dim() == 2 and values.shape[-1] > _UNROLLED:
        return NativeError(gram, values, found, _symmetric(structure.core), structure.scale)
    return NativeError(gram, values, found)


# Chases that were made before, of other states: a call is then that of its program and no more. What a chase
# checks and starts from follows, but for its states, from objects that have not changed since.

_REMEMBERED = 64  # chases


class Repeated:
    """A chase from zero weights."""

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
    """Prepare for a chase made for the second time, where its program needs no more than its states."""
    if key is None or program is None or is_users(type(problem.law)) or program.has_rows():
        return
    if _once.pop(key, None) is None:  # to prepare takes as long as a short chase
        while len(_once) >= _REMEMBERED:
            _once.pop(next(iter(_once)), None)  # by whichever thread comes first
        _once[key] = problem
        return
    while len(_known) >= _REMEMBERED:
        _known.pop(next(iter(_known)), None)
    _known[key] = Repeated(program, problem, states, everything=everything, history=history)


def key_of(states: Any, parts: tuple[Any, ...], *settings: Any) -> Hashable:
    """Return by which a chase is known again; None of one that begins elsewhere, or that is refused."""
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
