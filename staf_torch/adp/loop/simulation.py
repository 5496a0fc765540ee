"""Closed loops over time: their steps, what is recorded of them, and how accurate they were.

A loop records how much the rate bends within a step, which costs no call of the plant. Where that is much,
the holds in which it bent most are repeated with twice the steps, and so on: a row's own number of steps
follows, from nothing but what the row itself did.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from ...lanes import Program
from ...lanes.calls.choice import DIFFERENTIATED, undecided, worth
from ...lanes.compiled_methods import LoopProgram
from ...lanes.device.kernel import beside_history, joined, rows_of, with_rows
from ...lanes.gradients import wants_gradient
from ...lanes.row_numbers import over_rows, over_some_rows, some_rows
from ...lanes.torch_compile.operators import opaque
from ...lanes.trace.philox import seed_parts
from ...lanes.tree import flatten, unflatten
from ...numerics.angles import wrap
from ...numerics.checks import choice, copied, fail, integer
from ...numerics.default_device import beside
from ...numerics.runge_kutta import BENT, GRACE, MOST, TOLERANCE, TRIED, StepsNeeded, needed_steps
from ...signs import Sign
from ...systems import Plant
from ..problem.cost import Cost
from ..problem.held_plant import Holding, Substeps
from ..problem.rules import check_objects
from .controller import Controller, Feedback, Policy
from .result import OF_ROWS, LoopAbout, LoopResult
from .step import (
    ClosedLoop,
    LoopSettings,
    LoopState,
    LoopTraits,
    PreparedLoop,
    generated,
    key_of,
    known,
    prepared,
    program,
    record,
    remember,
)

_log = logging.getLogger(__name__)
_MODELS = 100.0  # times the tolerance, before a controller's model is a warning
_MOST_FROZEN = 64  # times the steps of a row that left the finite numbers
_TOGETHER = 1 << 16  # holds that are repeated at once
_DRAWN_AHEAD = 1024  # steps whose random numbers are drawn at once
_NUMBERS = 1 << 24  # at most, of all rows together
_SEEN = 32  # times at which the size of a row's states is looked at
_EULER = 64  # rows of the published integrator that are checked
_DT = 0.001  # s, where neither controller nor plant has a period
_PAYS = (
    3000  # integration steps of a small batch in plain torch (some 1 ms each) that take as long as to compile
)


@torch.no_grad()
def needed(holding: Holding, x: Tensor, u: Tensor, frozen: Tensor, most: int = MOST) -> StepsNeeded:
    """Return by how much rows must multiply their steps, ``most`` of a hold at most, for 1e-6 in all of
    their holds: x (R, K, n), u (R, K, m), NaN where there was none; ``frozen`` (R,) left the finite
    numbers."""
    known = torch.isfinite(u).all(-1) & torch.isfinite(x).all(-1)
    limit = torch.where(frozen.cpu(), min(most, _MOST_FROZEN), most) // holding.steps

    def errors(rows: Tensor, times: int) -> Tensor:
        finer = holding if times == 1 else holding.finer(times)
        some = rows.split(max(1, _TOGETHER // x.shape[1]))
        return torch.cat(
            [_errors(finer, part, x[part], u[part].nan_to_num(0.0), known[part]) for part in some]
        )

    return needed_steps(errors, limit, TOLERANCE, GRACE * TOLERANCE)


def _errors(holding: Holding, rows: Tensor, x: Tensor, u: Tensor, known: Tensor) -> Tensor:
    """Return the largest error of a row's holds, relative to its largest state and cost: (R,)."""
    worst = torch.zeros(len(x), dtype=torch.float64, device=x.device)
    for wrong, size in over_some_rows(holding.doubled, rows, x, u):
        off, large = (torch.where(known, part.view(known.shape), 0.0) for part in (wrong, size))
        large = torch.where(torch.isfinite(large), large, 0.0).amax(1)
        worst = torch.maximum(worst, (off.amax(1) / large).nan_to_num(math.inf, math.inf).double())
    return worst


@torch.no_grad()
def hardest(
    holding: Holding, state: Tensor, control: Tensor, rest: Tensor, frozen: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the holds of every row in which the rate bends most, the first one, and where it froze:
    states (R, T, n) and controls (R, T, m), NaN where none was held, -> (R, K, n), (R, K, m). ``rest``
    (m,), which holds the set-point, stands for a row ``frozen`` (R,) in its first hold."""
    held = torch.isfinite(control[:, :-1]).all(-1)
    some = torch.arange(len(state), device=state.device).split(max(1, _TOGETHER // held.shape[1]))
    moves = state[:, :-1], control[:, :-1].nan_to_num(0.0)
    bent = torch.cat([over_some_rows(holding.watched, part, *(m[part] for m in moves))[2] for part in some])
    bent = torch.where(held, bent.nan_to_num(math.inf, math.inf), -1.0)
    bent[:, 0] = math.inf
    at = bent.topk(min(TRIED, bent.shape[1]), dim=1).indices.unsqueeze(-1)
    x = state.gather(1, at.expand(-1, -1, state.shape[-1]))
    u = control.gather(1, at.expand(-1, -1, control.shape[-1]))
    last = (held.sum(1) - 1).clamp(min=0)[:, None, None].expand(-1, -1, control.shape[-1])
    before = control.gather(1, last)
    before = torch.where(torch.isfinite(before), before, rest.to(before))
    before = torch.where(frozen[:, None, None], before, torch.nan)
    return torch.cat((x, state[:, -1:]), dim=1), torch.cat((u, before), dim=1)


def warn_of_models(controller: nn.Module, x: Tensor, u: Tensor) -> None:
    """Say in the log which models of a controller are wrong in holds (R, K, n), (R, K, m) of the plant."""
    known = torch.isfinite(u).all(-1) & torch.isfinite(x).all(-1)
    for part in controller.modules():
        holding = getattr(part, "holding", None)
        if not isinstance(holding, Holding) or holding.plant.period is not None:
            continue
        if holding.plant.dim != x.shape[-1] or not bool(known.any()):
            continue
        found = torch.where(known, over_rows(holding.errors, x, u.nan_to_num(0.0)), 0.0)
        if float(found.max()) > _MODELS * TOLERANCE:
            _log.warning(
                "`simulate`: the model of %s, %d integration steps in %.4g s, is wrong by up to %.2g of the "
                "state where the plant went, and so are its plans there. More `substeps` would do.",
                *(type(part).__name__, holding.steps, holding.dt, float(found.max())),
            )


def warn_of_errors(holding: Holding, rows: Tensor, found: StepsNeeded, remedy: str) -> None:
    """Say in the log which rows were integrated with errors that matter."""
    wrong = found.error > GRACE * TOLERANCE
    if not bool(wrong.any()):
        return
    worst, steps = int(found.error.argmax()), holding.steps * int(found.factor[wrong].max())
    _log.warning(
        "`simulate`: with up to %d integration steps a period of %.4g s the next state is wrong by more than "
        "%.0e of its size in %d rows, by %.2g in row %d. %s",
        *(steps, holding.dt, GRACE * TOLERANCE, int(wrong.sum()), float(found.error[worst])),
        *(int(rows[worst]), remedy),
    )


@opaque
@beside
def simulate(
    controller: Controller | Policy,
    system: Plant,
    cost: Cost,
    x0: Tensor,
    *,
    dt: float | None = None,
    steps: int,
    every: int = 1,
    seed: int | Sequence[int] = 0,
    integrator: str = "runge_kutta",
    substeps: Substeps = None,
    renew: bool = False,
    limit: float = 1e6,
    compile: bool | str = "auto",
    progress: Callable[[int], None] | None = None,
) -> LoopResult:
    """The closed loop of a controller and a plant from the initial states x0.

    Random numbers of row b are a function of its seed, ``seed + b``, and of the step (Philox 4x32-10): what
    it does depends on no other row, and is the same on every device.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> lqr = adp.Feedback(adp.LQR(plant, cost))
        >>> x0 = torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
        >>> adp.simulate(lqr, plant, cost, x0, dt=0.01, steps=100).cost.shape
        torch.Size([1])

        Shown by `staf experiment=adp`.

    Args:
        controller: the controller, or u from x, (..., n) -> (..., m), as `Feedback` takes it.
        system: the plant.
        cost: the cost rate that is integrated along.
        x0: (B, n).
        dt: s; the control is held that long. By default the period of the controller or of the plant, where
            one has any, else 1 ms. A period at which the linearised loop is unstable is a warning in the log.
        steps: at least 1.
        every: steps from one recorded time to the next; divides ``steps``.
        seed: of the first row, the next row having the next; or one a row.
        integrator: as in `ClosedLoop`, and so are ``substeps`` and ``renew``. By default a row whose plant
            turns out to be too fast for its steps runs again with as many as it needs; what is left of errors
            above 1e-5 of the state within a period, by this or by your own choice, is a warning in the log.
        limit: as in `ClosedLoop`.
        compile: whether the loop is compiled by `lanes`: True, False, or ``auto`` (where the run is long
            enough to pay for it by the operations of its first step, so that the choice is always the same;
            never with a controller that improves plans: some seconds, once). What cannot be compiled runs in
            plain torch, which is the definition, with one line in the log, and a loop in plain torch that
            takes more than some seconds says how far it is. Both agree to 1e-12; True or False fix the bits.
        progress: called with the number of steps done since its last call.

    What has ``requires_grad``, x0, numbers of the plant, of the cost and of the controller, parameters of
    networks, gets its gradient, compiled where the loop is (`staf_torch/lanes/GRADIENTS.md`).

    Raises:
        ValueError: if an argument breaks its rule, or the plant returns another shape; if a gradient is
            wanted by a design (an LQR, a filter, a plan), or by a plant that needs an exact step without
            ``substeps``. A set-point at which no input within the bounds holds the plant is a warning in the
            log.
    """
    if not isinstance(controller, Controller):
        if not callable(controller) or isinstance(controller, type):
            raise fail("simulate", "controller", "must be a Controller or a function of x", controller)
        controller = Feedback(controller)
    check_objects("simulate", system=system, cost=cost)
    settings = LoopSettings(
        controller.period or system.period or _DT if dt is None else dt, integrator, substeps, renew, limit
    )
    key = key_of(controller, system, cost, x0, settings)
    ready, learned = known(key), False
    if ready is None:
        learned = wants_gradient(controller, system, cost, x0)
        ready = prepared(controller, system, cost, x0, settings, learned=learned)
        remember(key, ready, controller, system, cost)
    _check_times(steps, every, compile)
    if compile is True and not system.traceable:
        _log.warning(
            "the closed loop runs in plain torch, slower: its plant is no torch (NumPy, a simulator)"
        )
    whole = _LoopRun(x0, steps, every, _seeds(seed, len(x0)), compile, progress)
    result = whole.accurate(ready, learned)

    def again(other: Controller, start: Tensor) -> LoopResult:
        return simulate(other, system, cost, start, steps=steps, every=every, **settings._asdict())

    period = None if renew else settings.dt
    return dataclasses.replace(result, about=LoopAbout.of(controller, system, ready.loop.cost, period, again))


def _check_times(steps: int, every: int, compile: bool | str) -> None:
    """Refuse times and a choice of `simulate` that break their rules."""
    integer("simulate", "steps", steps, least=1)
    integer("simulate", "every", every, least=1)
    if steps % every:
        raise fail("simulate", "every", f"must divide the {steps} steps", every)
    choice("simulate", "compile", compile, (True, False, "auto"))


def _beginning(loop: ClosedLoop, plain: Program, steps: int) -> LoopProgram:
    """Return the program of a loop that few and cheap steps would not repay to compile."""
    parts, compiled, remedy = list(loop.modules()), None, "a plant that is no torch is called at every step"
    if loop.system.traceable:
        remedy = "`compile=True` compiles this controller, too, which takes up to a minute, once"
    if loop.system.traceable and not any(getattr(part, "costly", False) for part in parts):
        remedy = "`compile=True` compiles it, where it is torch all through"
        compiled = functools.partial(program, loop, True)
    return LoopProgram(plain, compiled, steps, remedy=f": {remedy}", parts=parts)


@dataclasses.dataclass(frozen=True)
class _LoopRun:
    """The loop of `simulate`, run again for some rows with other steps."""

    x0: Tensor
    steps: int
    every: int
    seeds: Sequence[int]
    compile: bool | str
    progress: Callable[[int], None] | None

    def accurate(self, ready: PreparedLoop, learned: bool) -> LoopResult:
        """Return the result, in which rows that are too fast for their steps took more, if they may;
        ``learned`` where a gradient is wanted."""
        loop, settings = ready.loop, ready.settings
        with torch.set_grad_enabled(learned):
            result, last = self.of(loop, ready.traits, ready.program)
        if self.x0.is_meta:  # nobody can tell whether a row needs more steps
            return result
        with torch.no_grad():
            seen = result.state[:, :: max(1, result.state.shape[1] // _SEEN)]
            reach = beside_history(wrap(seen, loop.system.periodic).abs().amax(-1).amax(-1), last.bent)
            strained = ~(last.bent <= BENT * reach) & (reach < torch.inf)
            if loop.euler:
                strained[:_EULER] = True
        if bool(strained.any()):
            again = settings.substeps is None and settings.integrator != "euler"
            with torch.set_grad_enabled(learned):
                return self.checked(loop, result, strained, again)
        return result

    def of(
        self, loop: ClosedLoop, traits: LoopTraits, make: Callable[[bool], Program] | None = None
    ) -> tuple[LoopResult, LoopState]:
        """Return the result of a loop and its last state; ``make`` is its program, compiled or not, by
        default `program`."""
        costly, work = traits.costly, self.steps * (loop.holding.steps + traits.work - 1)
        often = DIFFERENTIATED if torch.is_grad_enabled() else 1  # as `simulate` found out
        pays = not costly and often * work * (1 + len(self.x0) / 200) >= _PAYS
        chosen = worth(pays, None if costly else self.x0) if self.compile == "auto" else bool(self.compile)
        compiled = chosen and loop.system.traceable
        found = program(loop, compiled) if make is None else make(compiled)
        begins = not compiled and undecided(self.compile, self.x0)
        ran = _beginning(loop, found, self.steps) if begins else found
        counted = self.progress is None and ran is found  # a `LoopProgram` counts its steps itself
        with Sign("adp.simulate", self.steps if counted else 0) as sign:
            tell = self.progress or sign.advance
            return _run(loop, ran, self, traits.generated, tell)

    def checked(self, loop: ClosedLoop, result: LoopResult, rows: Tensor, again: bool) -> LoopResult:
        """Return the result in which the rows of a mask (B,) that need more steps took them, if they may run
        ``again``; warn of those that are wrong by more than a little."""
        at = rows.nonzero().squeeze(1)
        with torch.no_grad(), some_rows(at):
            frozen = rows_of(result.diverged, at)
            rest = loop.system.resting_input()
            states, controls = rows_of(result.state, at), rows_of(result.control, at)
            moves = hardest(loop.holding, states, controls, rest, frozen)
            found = needed(loop.holding, *moves, frozen)
            warn_of_models(loop.controller, *moves)
        if not again:
            with torch.no_grad(), some_rows(at):
                one = needed(loop.holding, *moves, torch.ones_like(frozen), most=1)
            warn_of_errors(loop.holding, at, one, "Leave `substeps` and `integrator` as they are by default.")
            return result
        for factor in found.factor.unique().tolist():
            if factor == 1:
                continue
            finer = copied(loop)
            finer.holding = loop.holding.finer(factor)
            chosen = at[(found.factor == factor).to(at.device)]
            result = self._replaced(result, finer, chosen)
        warn_of_errors(loop.holding, at, found, "A shorter dt would do.")
        return result

    def _replaced(self, result: LoopResult, loop: ClosedLoop, rows: Tensor) -> LoopResult:
        """Return the result with these rows (R,) of another loop."""
        whole = dataclasses.replace(self, progress=None)
        some = dataclasses.replace(whole, x0=self.x0[rows], seeds=[self.seeds[row] for row in rows.tolist()])
        try:
            with some_rows(rows):
                other, _ = some.of(loop, LoopTraits.of(loop))
            alone = len(other.state) == len(rows)
        except (RuntimeError, ValueError):
            alone = False
        if not alone:  # the controller has first weights of all rows
            other, _ = whole.of(loop, LoopTraits.of(loop))
        kept, structure = flatten([getattr(result, name) for name in OF_ROWS])
        new = flatten([getattr(other, name) for name in OF_ROWS])[0]
        pairs = zip(kept, new, strict=True)
        mixed = [with_rows(old, rows, fresh if alone else rows_of(fresh, rows)) for old, fresh in pairs]
        return LoopResult(result.time, *unflatten(structure, iter(mixed)))


def _run(
    loop: ClosedLoop,
    steps_of: Program | LoopProgram,
    asked: _LoopRun,
    old: bool,
    progress: Callable[[int], None],
) -> tuple[LoopResult, LoopState]:
    """Return the result and the last state; ``old`` says that random numbers come from a generator a row."""
    x0, steps, every, seeds = asked.x0, asked.steps, asked.every, asked.seeds
    state: LoopState = over_rows(loop.init, x0)
    pieces: list[list[Tensor]] = []
    draws, done = loop.controller.draws, 0
    old = bool(draws) and old
    row = {"seed": seed_parts(seeds, x0)} if draws and not old else {}
    generators = [torch.Generator().manual_seed(seed) for seed in (seeds if old else ())]
    draws = draws if old else 0  # ahead of the loop; others are drawn in it
    ahead = steps if x0.is_meta else _DRAWN_AHEAD
    if not x0.is_meta and (draws or x0.is_cpu):  # elsewhere a piece is a kernel, which nobody waits for
        ahead = max(1, min(ahead, _NUMBERS // (x0.numel() * max(draws, 1))))
    while done < steps:
        # A piece ends at a recorded time, or there is none inside.
        count = ahead // every * every if every <= ahead else min(ahead, every - done % every)
        count = min(count, steps - done)
        uniform = generated(x0, count, draws, generators)
        state, out = steps_of(state, uniform, row, every=min(every, count))
        if done % every == 0:
            pieces.append(flatten(out)[0])
        done += count
        progress(count)
    none = torch.full_like(pieces[-1][1][:, -1], torch.nan, device=x0.device)
    last, structure = flatten(record(loop, state, none))
    pieces.append([part.unsqueeze(1) for part in last])
    here = x0.is_cpu
    columns = [torch.cat(each, dim=1) if here else joined(each) for each in zip(*pieces, strict=True)]
    where = x0.device
    if not here and any(column.is_cpu for column in columns):  # a device without room for them all
        columns, where = [column.cpu() for column in columns], torch.device("cpu")
    kept = unflatten(structure, iter(columns))
    time = torch.arange(0, steps + 1, every, dtype=torch.float64, device="cpu") * loop.dt
    frozen_at = torch.where(state.alive, torch.inf, state.lived * loop.dt)
    frozen_at = frozen_at if here else frozen_at.to(where)
    result = LoopResult(time, kept.x, kept.u, kept.cost, kept.recorded, frozen_at, state.carried)
    return result, state


def _seeds(seed: int | Sequence[int], batch: int) -> Sequence[int]:
    """The seed of every row."""
    if isinstance(seed, Sequence):
        seeds = [integer("simulate", "seed", each, least=0) for each in seed]
        if len(seeds) != batch:
            raise fail("simulate", "seed", f"must be one a row, {batch}", len(seeds))
        return seeds
    first = integer("simulate", "seed", seed, least=0)
    return range(first, first + batch)


@dataclasses.dataclass(frozen=True)
class OptimumSettings:
    """Settings of the search for the optimum where no formula knows it."""

    shooting: bool
    states: int  # recorded states, of all trajectories together, whose V* and u* are wanted
    horizon: float | None  # s
    intervals: int | None


@dataclasses.dataclass(frozen=True)
class AdpProblem:
    """A closed loop, checked."""

    system: Plant
    cost: Cost
    controller: Controller
    initial_states: Tensor  # (B, n)
    dt: float  # s
    steps: int
    every: int  # steps between recorded times
    seed: int
    integrator: str
    compile: bool | str
    optimum: OptimumSettings

    def with_states(self, states: Tensor) -> AdpProblem:
        """Return the problem with other initial states (B, n)."""
        return dataclasses.replace(self, initial_states=states)
