"""Step of the closed loop, plant and controller together, all rows at once; its checks, its program.

What `simulate` checks, linearises and prepares follows from controller, plant, cost and settings, and takes
longer than few rows of a compiled loop. A loop that runs for the third time with objects that have not
changed since (`Contents`) is that of the second time, if nothing had to be said of it.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ...approximation.basis import StaFBasis
from ...lanes import Program, shared_program
from ...lanes.calls.inputs import served
from ...lanes.dependencies.contents import Contents
from ...lanes.gradients import wants_gradient
from ...lanes.per_row.decisions import decided, each_row
from ...lanes.row_numbers import anybodys, nonzero, over_rows
from ...lanes.trace.philox import seed_parts, uniform
from ...lanes.tree import flatten, unflatten
from ...numerics.angles import wrap
from ...numerics.checks import choice, fail, flag, positive_real, trailing
from ...numerics.default_device import without_numbers
from ...numerics.rows import is_ours
from ...numerics.runge_kutta import TOLERANCE
from ...systems import ControlAffineSystem, Plant
from ..problem.cost import Cost
from ..problem.held_plant import RESOLVED, Holding, Substeps, fewest_and_most
from ..problem.rules import check_problem, warn_if_restless, warn_if_unstable
from .controller import Carried, Controller, Feedback

_ROWS = 16  # with numbers of their own, that are looked at
_MOST = 16  # loops that are kept
_known: dict[Hashable, _Kept] = {}
_once: dict[Hashable, tuple[Any, ...]] = {}  # parts of loops that ran one time


def by_generator(controller: nn.Module) -> bool:
    """Return whether a controller asks for the numbers of a generator a row: `RandomPoints(random=...)`."""
    return any(getattr(part, "random", "") == "generator" for part in controller.modules())


def points_of_step(seed: Tensor, step: Tensor, draws: int, dim: int) -> Tensor:
    """Return uniform numbers on [-1, 1), (B, draws, n): those of a row's seed (B, 4) at a step (B,)."""
    drawn: Tensor = uniform(seed, step, draws * dim).unflatten(-1, (draws, dim))
    return drawn


def points_of_steps(x: Tensor, seeds: Sequence[int], first: int, count: int, draws: int) -> Tensor:
    """Return numbers of ``count`` steps from a first one on for the rows x (B, n), (B, count, draws, n)."""
    if not draws:
        return x.new_empty(len(x), count, 0, x.shape[-1])
    key = seed_parts(seeds, x).unsqueeze(1).expand(-1, count, -1)
    step = torch.arange(first, first + count, dtype=x.dtype, device=x.device).expand(len(x), count)
    return points_of_step(key, step, draws, x.shape[-1])


def generated(x0: Tensor, count: int, draws: int, generators: Sequence[torch.Generator]) -> Tensor:
    """Return the next ``count`` steps' numbers, (B, count, draws, n), one generator of the CPU a row."""
    rows, dim = x0.shape
    if not draws or x0.is_meta:
        return x0.new_empty(rows, count, draws, dim)
    drawn = torch.empty(rows, count, draws, dim, dtype=torch.float64, device="cpu")
    for row, generator in zip(drawn.unbind(0), generators, strict=False):
        row.uniform_(-1.0, 1.0, generator=generator)
    return drawn.to(x0)


class LoopState(NamedTuple):
    """Everything that one step maps to the next."""

    x: Tensor  # (B, n)
    cost: Tensor  # (B,) the integral of the cost rate so far
    alive: Tensor  # (B,) bool; a row that became non-finite keeps its last finite values
    lived: Tensor  # (B,) steps taken alive
    bent: Tensor  # (B,) of `Holding.watched`, the largest so far
    carried: Carried


class ClosedLoop(nn.Module):
    """Step of controller and plant: the control is computed at the state, clipped to the bounds of the
    cost or the plant, and held for dt.

    Args:
        controller: the controller.
        system: the plant.
        cost: the cost rate.
        dt: s.
        integrator: of the plant over a step, ``runge_kutta`` (fourth order) or ``euler`` (as published). A
            plant in discrete time takes its own steps.
        substeps: Runge-Kutta steps while the control is held, at least 1; None for as many as are accurate to
            1e-6 of the state, as `Holding` chooses them. Of a plant with a `Plant.step_limit` each row has
            lengths of its own, and of two numbers, (1, 16), it takes the first where no limit is met, the
            second at most.
        renew: whether the control follows the state at every substep, in place of being held for dt. Of
            feedback laws alone.
        limit: a row whose state, its angles in [-pi, pi], exceeds it in norm has diverged.
        holding: in place of one with these ``substeps``.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        controller: Controller,
        system: Plant,
        cost: Cost,
        *,
        dt: float,
        integrator: str = "runge_kutta",
        substeps: Substeps = None,
        renew: bool = False,
        limit: float = 1e6,
        holding: Holding | None = None,
    ) -> None:
        super().__init__()
        choice("ClosedLoop", "integrator", integrator, ("runge_kutta", "euler"))
        self.controller, self.system, self.cost = controller, system, cost.around(system)
        self.dt = positive_real("ClosedLoop", "dt", dt)
        self.limit = positive_real("ClosedLoop", "limit", limit)
        self.renew = flag("ClosedLoop", "renew", renew)
        if self.renew and (not isinstance(controller, Feedback) or system.period is not None):
            rule = "needs a feedback law and a plant in continuous time"
            raise fail("ClosedLoop", "renew", rule, controller.label)
        self.euler = integrator == "euler" and system.period is None
        if holding is None:
            first = 1 if self.euler else substeps
            holding = Holding("ClosedLoop", system, self.cost, self.dt, first, exponential=not self.renew)
        self.holding = holding

    def init(self, x0: Tensor) -> LoopState:
        """The state at time 0 of the rows x0 (B, n)."""
        alive = (x0.abs() < torch.inf).all(-1)  # fewer kernels than isfinite
        zeros = x0.new_zeros(x0.shape[0])
        carried = self.controller.init(x0)
        for part in flatten(carried)[0]:
            if part.shape[:1] != x0.shape[:1]:
                raise ValueError(
                    f"`{type(self.controller).__name__}.init` must return tensors (B, ...), here with "
                    f"B = {x0.shape[0]}; got one of {tuple(part.shape)}."
                )
        return LoopState(x0, zeros, alive, zeros.clone(), zeros.clone(), carried)

    def forward(self, state: LoopState, uniform: Tensor) -> tuple[LoopState, Tensor]:
        """The state after dt seconds, and the control held until then, (B, m)."""
        u, carried = self.controller.step(state.x, state.carried, uniform, self.dt)
        wanted = (len(state.x), self.system.inputs)
        if u.shape != wanted:
            raise ValueError(
                f"`{type(self.controller).__name__}.step` must return a control (B, m), here {wanted}; "
                f"got {tuple(u.shape)}."
            )
        u = self.cost.admissible(u)
        x, spent, bent = self._advance(state.x, u)
        size = wrap(x, self.system.periodic).square().sum(-1)  # an angle may turn as often as it likes
        good = torch.isfinite(spent) & (size <= self.limit**2)
        parts, before = flatten(carried), flatten(state.carried)
        shapes, given = ([tuple(part.shape) for part in each[0]] for each in (parts, before))
        if parts[1] != before[1] or shapes != given:
            raise ValueError(
                f"`{type(self.controller).__name__}.step` must return a memory like the one it got, "
                f"tensors of the shapes {given}; got {shapes}."
            )
        for part in (u, *parts[0]):
            good = good & torch.isfinite(part).reshape(len(part), -1).all(-1)
        alive = state.alive & good
        pairs = zip(parts[0], before[0], strict=True)
        kept = unflatten(parts[1], (_where(alive, new, old) for new, old in pairs))
        if nonzero(self.cost.discount):
            spent = spent * torch.exp(-self.cost.discount * self.dt * state.lived)
        cost = state.cost + torch.where(alive, spent, 0.0)
        bent = torch.maximum(bent, state.bent)  # of what is not a number: that
        return LoopState(_where(alive, x, state.x), cost, alive, state.lived + alive, bent, kept), u

    def _advance(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The state after dt with u held, the cost until then, and how much the rate bends."""
        if self.euler:
            paid = self.dt * self.cost.rate(x, u)
            return x + self.dt * self.system.motion(x, u), paid, torch.zeros_like(paid)
        if self.renew and isinstance(self.controller, Feedback):
            policy = self.controller.policy
            return self.holding.watched(x, u, lambda at: self.cost.admissible(policy(at)))
        return self.holding.watched(x, u)


def _where(alive: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(alive[(..., *([None] * (new.dim() - 1)))], new, old)


def program(loop: ClosedLoop, compile: bool) -> Program:
    """Return ``loop`` over many steps, compiled where that is possible and asked for: it records the state
    before every step, and the control.

    Compiled loops that differ in numbers alone share one text: `lanes.dependencies.contents`.
    """
    make = functools.partial(functools.partial, recorded)
    if not compile:
        return Program(make(loop), name="the closed loop", compile=False)
    return shared_program("the closed loop", make(loop), loop, make=make)


def recorded(
    loop: ClosedLoop, state: LoopState, uniform: Tensor, row: Mapping[str, Tensor]
) -> tuple[LoopState, Record]:
    """Return the state after one step with random numbers (B, draws, n), and what is recorded of the time
    before it. ``row`` may have by ``seed`` the parts of each row's seed, (B, 4), by which they are drawn
    here instead."""
    if "seed" in row:
        uniform = points_of_step(row["seed"], state.lived, loop.controller.draws, state.x.shape[-1])
    after, u = loop(state, uniform)
    return after, record(loop, state, torch.where(after.alive.unsqueeze(-1), u, torch.nan))


class Record(NamedTuple):
    """Record of one time."""

    x: Tensor  # (B, n)
    u: Tensor  # (B, m)
    cost: Tensor  # (B,)
    recorded: dict[str, Tensor]  # of `Controller.recorded`, (B, ...) each


def record(loop: ClosedLoop, state: LoopState, u: Tensor) -> Record:
    """Return what is kept of a state and the control that is held from it on."""
    return Record(state.x, u, state.cost, loop.controller.recorded(state.carried))


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
