"""Closed loops over time: the steps, their random numbers, what is recorded of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from .._checks import choice, fail, integer, trailing
from ..systems import ControlAffineSystem
from .closed_loop import ClosedLoop, LoopState
from .compilation import Step, compiled
from .controller import Controller
from .cost import Cost
from .lqr import check_equilibrium

_DRAWN_AHEAD = 1024  # steps whose random numbers are drawn at once


@dataclasses.dataclass(frozen=True)
class LoopResult:
    """A closed loop at the recorded times 0, every dt, 2 every dt, ...

    A row whose plant, control or weights became non-finite, or whose state left the ``limit``, is frozen at
    its last good values from there on: `frozen_at` says when, and it counts as diverged.
    """

    time: Tensor  # (T,) seconds
    state: Tensor  # (B, T, n)
    control: Tensor  # (B, T, m) held from that time on; NaN at the end, where none is, and once frozen
    actor_weights: Tensor  # (B, T, M); M = 0 for feedback laws
    critic_weights: Tensor  # (B, T, M)
    running_cost: Tensor  # (B, T) the cost from 0 to that time
    identifier: Tensor  # (B, T, K) what the controller remembers of the plant; K = 0 without identification
    frozen_at: Tensor  # (B,) seconds, inf for rows that never froze

    @property
    def cost(self) -> Tensor:
        """(B,) the cost of the whole run; of a frozen row, until it froze."""
        return self.running_cost[:, -1]

    @property
    def diverged(self) -> Tensor:
        """(B,) bool."""
        return torch.isfinite(self.frozen_at)


def simulate(
    controller: Controller,
    system: ControlAffineSystem,
    cost: Cost,
    x0: Tensor,
    *,
    dt: float = 0.001,
    steps: int,
    every: int = 1,
    seed: int | Sequence[int] = 0,
    integrator: str = "runge_kutta",
    limit: float = 1e6,
    compile: bool | str = False,
    progress: Callable[[int], None] | None = None,
) -> LoopResult:
    """The closed loop of a controller and a plant from the initial states x0.

    Row b draws from its own generator, seeded ``seed + b``: what it does depends on no other row.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> lqr = adp.Feedback(adp.LQR(plant, cost))
        >>> x0 = torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
        >>> adp.simulate(lqr, plant, cost, x0, dt=0.01, steps=1000).cost.shape
        torch.Size([1])

    Args:
        controller: the controller.
        system: the plant.
        cost: the cost rate that is integrated along.
        x0: (B, n).
        dt: s; the control is held that long.
        steps: at least 1.
        every: steps from one recorded time to the next; divides ``steps``.
        seed: of the first row, the next row having the next; or one a row.
        integrator: as in `ClosedLoop`.
        limit: as in `ClosedLoop`.
        compile: one compiled step: True, False, or ``auto`` (where the run is long enough to pay for it);
            what cannot be compiled runs uncompiled, with one line in the log.
        progress: called with the number of steps done since its last call.

    Raises:
        ValueError: if an argument breaks its rule, the plant does not rest at 0 or returns another shape.
    """
    _check(system, cost, x0)
    integer("simulate", "steps", steps, least=1)
    integer("simulate", "every", every, least=1)
    if steps % every:
        raise fail("simulate", "every", f"must divide the {steps} steps", every)
    choice("simulate", "compile", compile, (True, False, "auto"))
    loop = ClosedLoop(controller, system, cost, dt=dt, integrator=integrator, limit=limit)
    loop.to(x0.device)
    with torch.no_grad():
        step = compiled(loop, x0, steps, compile)
        return _run(loop, step, x0, steps, every, _seeds(seed, len(x0)), progress)


def _run(
    loop: ClosedLoop,
    step: Step,
    x0: Tensor,
    steps: int,
    every: int,
    seeds: Sequence[int],
    progress: Callable[[int], None] | None,
) -> LoopResult:
    state = loop.init(x0)
    rows: list[tuple[Tensor, ...]] = []
    numbers = _uniform(x0, loop.controller.draws, seeds)
    for k in range(steps):
        now = state
        state, u = step(now, next(numbers))
        if k % every == 0:
            held = torch.where(state.alive.unsqueeze(-1), u, torch.nan)
            rows.append(_record(now, held))
        if progress is not None and (k + 1) % 100 == 0:
            progress(100)
    rows.append(_record(state, torch.full_like(rows[-1][1], torch.nan)))
    x, u, actor, critic, spent, known = (torch.stack(column, dim=1) for column in zip(*rows, strict=True))
    time = torch.arange(0, steps + 1, every, dtype=torch.float64) * loop.dt
    frozen_at = torch.where(state.alive, torch.inf, state.lived * loop.dt)
    return LoopResult(time, x, u, actor, critic, spent, known, frozen_at)


def _record(state: LoopState, u: Tensor) -> tuple[Tensor, ...]:
    memory = state.memory
    return state.x, u, memory.actor, memory.critic, state.cost, memory.identifier


def _seeds(seed: int | Sequence[int], batch: int) -> Sequence[int]:
    """The seed of every row."""
    if isinstance(seed, Sequence):
        seeds = [integer("simulate", "seed", each, least=0) for each in seed]
        if len(seeds) != batch:
            raise fail("simulate", "seed", f"must be one a row, {batch}", len(seeds))
        return seeds
    first = integer("simulate", "seed", seed, least=0)
    return range(first, first + batch)


def _uniform(x0: Tensor, draws: int, seeds: Sequence[int]) -> Iterator[Tensor]:
    """Uniform numbers of [-1, 1], (B, draws, n) a step, one generator a row."""
    batch, dim = x0.shape
    generators = [torch.Generator().manual_seed(seed) for seed in (seeds if draws else ())]
    while True:
        if not draws:
            yield x0.new_zeros(batch, 0, dim)
            continue
        ahead = [
            torch.rand(_DRAWN_AHEAD, draws, dim, dtype=torch.float64, generator=generator)
            for generator in generators
        ]
        yield from (2 * torch.stack(ahead, dim=1) - 1).to(x0).unbind(0)


def _check(system: ControlAffineSystem, cost: Cost, x0: Tensor) -> None:
    trailing("simulate", "x0", x0, dims=2, last=system.dim)
    if x0.dim() != 2 or x0.shape[0] == 0:
        raise ValueError(f"`simulate(x0=...)` must have the shape (B, n); got {tuple(x0.shape)}.")
    name, size, inputs = type(system).__name__, x0.shape[1], cost.r.shape[0]
    if cost.q.shape[0] != size:
        raise fail("simulate", "cost", f"must be for the plant's {size} states", cost.q.shape[0])
    for method, shape in (("drift", x0.shape), ("effectiveness", (*x0.shape, inputs))):
        returned = getattr(system, method)(x0)
        if not isinstance(returned, Tensor) or returned.shape != shape:
            got = tuple(returned.shape) if isinstance(returned, Tensor) else returned
            raise ValueError(
                f"`{name}.{method}` must map {tuple(x0.shape)} to {tuple(shape)} "
                f"(the cost is for {inputs} inputs); got {got}."
            )
    check_equilibrium(system)
