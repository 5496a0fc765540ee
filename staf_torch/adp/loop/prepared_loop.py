"""Checks and parts of a closed loop before its first step; those of a loop that ran before are kept.

What `simulate` checks, linearises and prepares follows from controller, plant, cost and settings, and takes
longer than few rows of a compiled loop. A loop that runs for the third time with objects that have not
changed since (`Contents`) is that of the second time, if nothing had to be said of it.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Hashable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...approximation.basis import StaFBasis
from ...lanes import Program
from ...lanes.calls.inputs import served
from ...lanes.dependencies.contents import Contents
from ...lanes.gradients import wants_gradient
from ...lanes.per_row.decisions import decided, each_row
from ...lanes.row_numbers import anybodys, over_rows
from ...numerics.checks import fail, positive_real, trailing
from ...numerics.default_device import without_numbers
from ...numerics.rows import is_ours
from ...numerics.runge_kutta import TOLERANCE
from ...systems import ControlAffineSystem, Plant
from ..problem.cost import Cost
from ..problem.held_plant import RESOLVED, Holding, Substeps, fewest_and_most
from ..problem.rules import check_problem, warn_if_restless, warn_if_unstable
from .controller import Controller, Feedback
from .step import ClosedLoop, by_generator, program

_ROWS = 16  # with numbers of their own, that are looked at
_MOST = 16  # loops that are kept


class LoopSettings(NamedTuple):
    """Settings of `ClosedLoop`, as `simulate` takes them."""

    dt: float
    integrator: str
    substeps: Substeps
    renew: bool
    limit: float


class LoopTraits(NamedTuple):
    """What the parts of a loop say of its steps."""

    work: float  # of a step of the controller, in steps of a feedback law
    costly: bool  # whether a program of a step takes a compiler very long
    generated: bool  # whether random numbers come from a generator a row

    @classmethod
    def of(cls, loop: ClosedLoop) -> LoopTraits:
        """Return those of a loop."""
        parts = list(loop.controller.modules())
        work = max(getattr(part, "work", 1.0) for part in parts)
        costly = any(getattr(part, "costly", False) for part in parts)
        return cls(work, costly, by_generator(loop.controller))


@dataclasses.dataclass(frozen=True)
class PreparedLoop:
    """A loop that has been checked."""

    loop: ClosedLoop  # one step
    settings: LoopSettings
    silent: bool  # whether the checks had nothing to say
    traits: LoopTraits
    _compiled: list[Program] = dataclasses.field(default_factory=list)

    def program(self, compile: bool) -> Program:
        """Return the loop over many steps, as `step.program`; that of an earlier call if there is one."""
        if not compile:
            return program(self.loop, compile)
        if not self._compiled:
            self._compiled.append(program(self.loop, compile))
        return self._compiled[0]


class _Kept(NamedTuple):
    """A loop that is kept, with all that it follows from."""

    ready: PreparedLoop
    read: Contents
    devices: list[torch.device]
    parts: tuple[Any, ...]  # whose addresses are the key


_known: dict[Hashable, _Kept] = {}
_once: dict[Hashable, tuple[Any, ...]] = {}  # parts of loops that ran one time


def key_of(controller: Controller, system: Plant, cost: Cost, x0: Tensor, settings: LoopSettings) -> Hashable:
    """Return by which a loop is known again: these objects, settings, and states of this form; None of one
    whose checks are not those of another call."""
    if type(x0) is not Tensor or (x0.requires_grad and torch.is_grad_enabled()):
        return None
    ours = x0.layout is torch.strided and not x0.is_nested and served((x0,)) and anybodys()
    if not ours or any(isinstance(value, Tensor | list) for value in settings):
        return None
    policy = controller.policy if type(controller) is Feedback else controller
    return id(policy), type(controller), id(system), id(cost), settings, x0.shape, x0.dtype, x0.device


def known(key: Hashable) -> PreparedLoop | None:
    """Return the loop of a key of `key_of`, if it is kept and nothing has changed; where a gradient is wanted
    there is none."""
    kept = _known.get(key)
    if kept is None:
        return None
    if not kept.read.unchanged() or [each.device for each in kept.read.tensors] != kept.devices:
        _known.pop(key, None)
        return None
    return None if kept.read.wants_gradient() else kept.ready


def remember(key: Hashable, ready: PreparedLoop, *parts: Any) -> None:
    """Keep a loop of a key of `key_of` that runs for the second time; ``parts`` are controller, plant and
    cost."""
    if key is None or not ready.silent:
        return
    if _once.pop(key, None) is None:  # to read all of it takes as long as a few steps
        _forget(_once)
        _once[key] = parts
        return
    read = Contents(ready.loop, *parts)
    if read.reason is None:
        _forget(_known)
        _known[key] = _Kept(ready, read, [each.device for each in read.tensors], parts)


def prepared(
    controller: Controller,
    system: Plant,
    cost: Cost,
    x0: Tensor,
    settings: LoopSettings,
    *,
    learned: bool,
) -> PreparedLoop:
    """Check a loop and its initial states, as `simulate` says, and make it; ``learned`` where a gradient
    is wanted."""
    dt, substeps = settings.dt, settings.substeps
    with torch.no_grad():
        cost, silent = _check(system, cost, x0)
    if substeps is not None:
        fewest_and_most("simulate", substeps)
    fastest = math.inf
    if isinstance(controller, Feedback) and x0.device.type == "cpu":
        with torch.no_grad():
            controller.check(x0)
            _check_control(controller, x0, cost.inputs)
            period = positive_real("simulate", "dt", dt)
            fastest, stable = warn_if_unstable(controller.policy, system, cost, period)
        silent = silent and stable
    # Of slow plants one step is tried, as rows that are fast elsewhere run again.
    tried = 1 if substeps is None and fastest * dt <= RESOLVED else substeps
    holding = Holding("simulate", system, cost, dt, 1) if tried is not substeps else None
    more: dict[str, Any] = settings._asdict()
    loop = ClosedLoop(controller, system, cost, holding=holding, **more)
    if learned and loop.holding.table is not None and wants_gradient(system, cost):
        rule = "must be given where the plant or its cost requires a gradient"
        raise fail("simulate", "substeps", rule, substeps)
    loop = copy.deepcopy(loop) if x0.is_meta else loop  # whose parts keep their numbers
    loop.to(x0.device)
    for basis in (part for part in loop.modules() if isinstance(part, StaFBasis)):
        basis.check_learned()
    if isinstance(controller, Feedback) and x0.device.type != "cpu":
        controller.check(x0)
    error = loop.holding.error
    silent = silent and (error is None or error <= TOLERANCE)
    return PreparedLoop(loop, settings, silent, LoopTraits.of(loop))


def _forget(kept: dict[Hashable, Any]) -> None:
    while len(kept) >= _MOST:
        kept.pop(next(iter(kept)), None)  # by whichever thread comes first


def _check(system: Plant, cost: Cost, x0: Tensor) -> tuple[Cost, bool]:
    """Return the cost around the plant, once all shapes are right, and whether nothing had to be said."""
    trailing("simulate", "x0", x0, dims=2, last=system.dim, vmap=False)
    if x0.dim() != 2 or x0.shape[0] == 0:
        raise ValueError(f"`simulate(x0=...)` must have the shape (B, n); got {tuple(x0.shape)}.")
    name, size, inputs = type(system).__name__, x0.shape[1], cost.inputs
    if cost.dim != size:
        raise fail("simulate", "cost", f"must be for the plant's {size} states", cost.dim)
    affine = isinstance(system, ControlAffineSystem)
    for method, shape in () if not affine else (("drift", x0.shape), ("effectiveness", (*x0.shape, inputs))):
        returned = over_rows(getattr(system, method), x0)
        if not isinstance(returned, Tensor) or returned.shape != shape:
            got = tuple(returned.shape) if isinstance(returned, Tensor) else returned
            raise ValueError(
                f"`{name}.{method}` must map {tuple(x0.shape)} to {tuple(shape)} "
                f"(the cost is for {inputs} inputs); got {got}."
            )
    check_problem(system, cost)
    placed, silent = cost.around(system), list[bool]()
    if without_numbers(system, cost):
        return placed, False
    decided(lambda: silent.append(warn_if_restless("simulate", system, placed)), _ROWS)
    return placed, all(silent)


def _check_control(controller: Feedback, x0: Tensor, inputs: int) -> None:
    """Refuse a policy that is not one control a row, of numbers of rows by those of the first."""
    if is_ours(controller.policy):
        return
    try:
        with torch.no_grad():
            (u,) = each_row(lambda: controller.policy(x0), 1)
    except RuntimeError as error:
        if "dtype" not in str(error):
            raise
        rule = f"must take states of {x0.dtype}: write `net.double()`, or x0 in its precision"
        raise ValueError(f"`simulate(controller=...)` {rule}; torch's error: {error}") from error
    whole = (len(x0), inputs)
    fits = isinstance(u, Tensor) and u.is_floating_point() and u.dim() in (1, 2)
    if not fits or any(size not in (1, w) for size, w in zip(u.shape, whole[-u.dim() :], strict=True)):
        got = f"{tuple(u.shape)} of {u.dtype}" if isinstance(u, Tensor) else type(u).__name__
        rule = f"must map states {tuple(x0.shape)} to controls {(len(x0), inputs)} of floating point"
        raise ValueError(f"`simulate(controller=...)` {rule}; got {got}.")
