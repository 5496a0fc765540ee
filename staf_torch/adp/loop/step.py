"""Step of the closed loop, plant and controller together, all rows at once; its program, random numbers."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ...lanes import Program, shared_program
from ...lanes.row_numbers import nonzero
from ...lanes.trace.philox import seed_parts, uniform
from ...lanes.tree import flatten, unflatten
from ...numerics.angles import wrap
from ...numerics.checks import choice, fail, flag, positive_real
from ...systems import Plant
from ..problem.cost import Cost
from ..problem.held_plant import Holding, Substeps
from .controller import Carried, Controller, Feedback


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
