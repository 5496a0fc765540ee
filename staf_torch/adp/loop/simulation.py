"""Closed loops over time: the steps, their random numbers, what is recorded of them."""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ...approximation.basis import StaFBasis
from ...lanes import Program
from ...lanes.compiled_methods import undecided, worth
from ...lanes.gradients import wants_gradient
from ...lanes.loop_program import LoopProgram
from ...lanes.opaque import opaque
from ...lanes.philox import seed_parts
from ...lanes.plain_time import DIFFERENTIATED
from ...lanes.row_decisions import decided
from ...lanes.row_numbers import over_rows, some_rows
from ...lanes.tree import flatten, unflatten
from ...numerics.angles import wrap
from ...numerics.checks import choice, copied, fail, integer, positive_real, trailing
from ...numerics.default_device import beside
from ...numerics.exponential_step import BENT
from ...numerics.row_checks import is_ours
from ...results import pictures
from ...signs import Sign
from ...systems import ControlAffineSystem, Plant
from ..problem.cost import Cost
from ..problem.held_plant import RESOLVED, Holding, Substeps, fewest_and_most
from ..problem.rules import warn_if_restless, warn_if_unstable
from ..problem.shapes import check_problem
from .accuracy import hardest, needed, warn_of_errors, warn_of_models
from .controller import Carried, Controller, Feedback, Policy
from .drawing import by_generator, generated
from .picture import LoopAbout, picture, summary
from .step import ClosedLoop, LoopState, program, record

_log = logging.getLogger(__name__)
_DRAWN_AHEAD = 1024  # steps whose random numbers are drawn at once
_NUMBERS = 1 << 24  # at most, of all rows together
_ROWS = 16  # with numbers of their own, that are looked at
_SEEN = 32  # times at which the size of a row's states is looked at
_EULER = 64  # rows of the published integrator that are checked
_DT = 0.001  # s, where neither controller nor plant has a period
_PAYS = (
    3000  # integration steps of a small batch in plain torch (some 1 ms each) that take as long as to compile
)


@dataclasses.dataclass(frozen=True, repr=False)
class LoopResult:
    """A closed loop at the recorded times 0, every dt, 2 every dt, ...

    A row whose plant, control or weights became non-finite, or whose state left the ``limit``, is frozen at
    its last good values from there on: `frozen_at` says when, and it counts as diverged.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> x0 = torch.tensor([[0.5, 0.5]]).double()
        >>> lqr = adp.Feedback(adp.LQR(plant, cost))
        >>> result = adp.simulate(lqr, plant, cost, x0, dt=0.01, steps=50, every=10)
        >>> result.state.shape, bool(result.diverged.any()), bool(result.cost > 0)
        (torch.Size([1, 6, 2]), False, True)
        >>> list(result.recorded)  # an actor-critic records its weights: result["critic_weights"]
        []
        >>> result.figure(width=3.4).savefig("loop.pdf")

        Shown by `staf experiment=adp`.
    """

    time: Tensor  # (T,) seconds
    state: Tensor  # (B, T, n)
    control: Tensor  # (B, T, m) held from that time on; NaN at the end, where none is, and once frozen
    running_cost: Tensor  # (B, T) the cost from 0 to that time
    recorded: dict[str, Tensor]  # (B, T, ...) by name, of `Controller.recorded`: result["name"]
    frozen_at: Tensor  # (B,) seconds, inf for rows that never froze
    carried: Carried = ()  # by the controller at the end, (B, ...)
    about: LoopAbout | None = dataclasses.field(default=None, compare=False)  # what ran

    def __repr__(self) -> str:
        """Return five lines: what ran, states, controls, cost, how it ended."""
        return summary(self)

    def figure(
        self,
        *,
        rows: Sequence[int] | None = None,
        lqr: bool = True,
        width: float | None = None,
        font: float | str | None = None,
    ) -> Any:
        """Draw states and controls with their units and bounds, and the cost so far.

        The first of the rows has strong lines, the others thin ones; a row ends where it diverged. The LQR,
        which runs now from the first of them, is a broad grey line, the set-point or path is dotted where it
        is not 0. Angles are in [-pi, pi]. Where there is no LQR a line in the log says why; a result from a
        pickle has none.

        Args:
            rows: which; None for the first eight.
            lqr: whether to draw the LQR's run.
            width: inches, 7.2 by default; a column of a paper is 3.4.
            font: of all text: size in pt, family, or both, as ``"9 serif"``; 8 pt by default.

        Returns:
            A `matplotlib.figure.Figure`.

        Raises:
            ValueError: if an argument breaks its rule.
        """
        return pictures.draw(picture(self, rows, lqr), width, font)

    def __getitem__(self, name: str) -> Tensor:
        """(B, T, ...) of what the controller recorded.

        Raises:
            KeyError: if it records nothing of that name.
        """
        if name not in self.recorded:
            raise KeyError(f"the controller records {', '.join(self.recorded) or 'nothing'}; got {name!r}")
        return self.recorded[name]

    @property
    def actor_weights(self) -> Tensor:
        """(B, T, M) of an actor-critic; M = 0 where nothing learns."""
        return self._weights("actor_weights")

    @property
    def critic_weights(self) -> Tensor:
        """(B, T, M), likewise."""
        return self._weights("critic_weights")

    def _weights(self, name: str) -> Tensor:
        return self.recorded.get(name, self.state[..., :0])

    @property
    def cost(self) -> Tensor:
        """(B,) the cost of the whole run; of a frozen row, until it froze."""
        return self.running_cost[:, -1]

    @property
    def diverged(self) -> Tensor:
        """(B,) bool."""
        return torch.isfinite(self.frozen_at)

    def split(self, rows: Sequence[int]) -> list[LoopResult]:
        """The results of so many rows each, in their order."""
        leaves, structure = flatten([getattr(self, name) for name in _OF_ROWS])
        parts = zip(*(leaf.split(rows) for leaf in leaves), strict=True)
        found = (LoopResult(self.time, *unflatten(structure, iter(part))) for part in parts)
        return [dataclasses.replace(part, about=self.about) for part in found]


_OF_ROWS = ("state", "control", "running_cost", "recorded", "frozen_at", "carried")


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
        if not callable(controller):
            raise fail("simulate", "controller", "must be a Controller or a function of x", controller)
        controller = Feedback(controller)
    learned = wants_gradient(controller, system, cost, x0)
    with torch.no_grad():
        cost = _check(system, cost, x0)
    integer("simulate", "steps", steps, least=1)
    integer("simulate", "every", every, least=1)
    if steps % every:
        raise fail("simulate", "every", f"must divide the {steps} steps", every)
    choice("simulate", "compile", compile, (True, False, "auto"))
    if substeps is not None:
        fewest_and_most("simulate", substeps)
    if dt is None:
        dt = controller.period or system.period or _DT
    fastest = math.inf
    if isinstance(controller, Feedback) and x0.device.type == "cpu":
        with torch.no_grad():
            controller.check(x0)
            _check_control(controller, x0, cost.inputs)
            fastest = warn_if_unstable(controller.policy, system, cost, positive_real("simulate", "dt", dt))
    # Of slow plants one step is tried, as rows that are fast elsewhere run again.
    tried = 1 if substeps is None and fastest * dt <= RESOLVED else substeps
    holding = None
    if tried is not substeps:
        holding = Holding("simulate", system, cost, dt, 1)
    more = {
        "integrator": integrator,
        "substeps": substeps,
        "renew": renew,
        "limit": limit,
        "holding": holding,
    }
    loop = ClosedLoop(controller, system, cost, dt=dt, **more)  # type: ignore[arg-type]
    if learned and loop.holding.table is not None and wants_gradient(system, cost):
        rule = "must be given where the plant or its cost requires a gradient: its exact step is a number"
        raise fail("simulate", "substeps", rule, substeps)
    loop.to(x0.device)
    for basis in (part for part in loop.modules() if isinstance(part, StaFBasis)):
        basis.check_learned()
    if isinstance(controller, Feedback) and x0.device.type != "cpu":
        controller.check(x0)
    if compile is True and not system.traceable:
        _log.warning(
            "the closed loop runs in plain torch, slower: its plant is no torch (NumPy, a simulator)"
        )
    whole = _LoopRun(x0, steps, every, _seeds(seed, len(x0)), compile, progress)
    with torch.set_grad_enabled(learned):
        result, last = whole.of(loop)
    with torch.no_grad():
        seen = result.state[:, :: max(1, result.state.shape[1] // _SEEN)]
        reach = wrap(seen, system.periodic).abs().amax(-1).amax(-1)
        strained = ~(last.bent <= BENT * reach) & torch.isfinite(reach)
        if integrator == "euler" and system.period is None:
            strained[:_EULER] = True
    if bool(strained.any()):
        with torch.set_grad_enabled(learned):
            result = whole.checked(loop, result, strained, substeps is None and integrator != "euler")

    def again(other: Controller, start: Tensor) -> LoopResult:
        same = {"integrator": integrator, "substeps": substeps, "renew": renew, "limit": limit}
        return simulate(other, system, cost, start, dt=dt, steps=steps, every=every, **same)  # type: ignore[arg-type]

    about = LoopAbout.of(controller, system, loop.cost, None if renew else dt, again)
    return dataclasses.replace(result, about=about)


def _check_control(controller: Feedback, x0: Tensor, inputs: int) -> None:
    """Refuse a policy that is not one control a row; numbers of a row's own are its matter."""
    if is_ours(controller.policy):
        return
    with torch.no_grad():
        u = controller.policy(x0)
    whole = (len(x0), inputs)
    fits = isinstance(u, Tensor) and u.is_floating_point() and u.dim() in (1, 2)
    if not fits or any(size not in (1, w) for size, w in zip(u.shape, whole[-u.dim() :], strict=True)):
        got = f"{tuple(u.shape)} of {u.dtype}" if isinstance(u, Tensor) else type(u).__name__
        rule = f"must map states {tuple(x0.shape)} to controls {(len(x0), inputs)} of floating point"
        raise ValueError(f"`simulate(controller=...)` {rule}; got {got}.")


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
    """What `simulate` runs, again for some rows with other steps."""

    x0: Tensor
    steps: int
    every: int
    seeds: Sequence[int]
    compile: bool | str
    progress: Callable[[int], None] | None

    def of(self, loop: ClosedLoop) -> tuple[LoopResult, LoopState]:
        """The result of a loop and its last state."""
        parts = list(loop.controller.modules())
        work = self.steps * (loop.holding.steps + max(getattr(part, "work", 1.0) for part in parts) - 1)
        often = DIFFERENTIATED if torch.is_grad_enabled() else 1  # as `simulate` found out
        pays = often * work * (1 + len(self.x0) / 200) >= _PAYS
        pays = pays and not any(getattr(part, "costly", False) for part in parts)
        compiled = (worth(pays) if self.compile == "auto" else bool(self.compile)) and loop.system.traceable
        found = program(loop, compiled)
        ran = _beginning(loop, found, self.steps) if not compiled and undecided(self.compile) else found
        counted = self.progress is None and ran is found  # a `LoopProgram` counts its steps itself
        with Sign("adp.simulate", self.steps if counted else 0) as sign:
            tell = self.progress or sign.advance
            return _run(loop, ran, self.x0, self.steps, self.every, self.seeds, tell)

    def checked(self, loop: ClosedLoop, result: LoopResult, rows: Tensor, again: bool) -> LoopResult:
        """Return the result in which the rows of a mask (B,) that need more steps took them, if they may run
        ``again``; warn of those that are wrong by more than a little."""
        at = rows.nonzero().squeeze(1)
        with torch.no_grad(), some_rows(at):
            frozen = result.diverged[at]
            rest, states, controls = loop.system.resting_input(), result.state[at], result.control[at]
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
                other, _ = some.of(loop)
            alone = len(other.state) == len(rows)
        except (RuntimeError, ValueError):
            alone = False
        if not alone:  # the controller has first weights of all rows
            other, _ = whole.of(loop)
        kept, structure = flatten([getattr(result, name) for name in _OF_ROWS])
        new = flatten([getattr(other, name) for name in _OF_ROWS])[0]
        pairs = zip(kept, new, strict=True)
        mixed = [old.index_copy(0, rows, fresh if alone else fresh[rows]) for old, fresh in pairs]
        return LoopResult(result.time, *unflatten(structure, iter(mixed)))


def _run(
    loop: ClosedLoop,
    steps_of: Program | LoopProgram,
    x0: Tensor,
    steps: int,
    every: int,
    seeds: Sequence[int],
    progress: Callable[[int], None],
) -> tuple[LoopResult, LoopState]:
    state: LoopState = over_rows(loop.init, x0)
    pieces: list[list[Tensor]] = []
    draws, done = loop.controller.draws, 0
    old = bool(draws) and by_generator(loop.controller)
    row = {"seed": seed_parts(seeds, x0)} if draws and not old else {}
    generators = [torch.Generator().manual_seed(seed) for seed in (seeds if old else ())]
    draws = draws if old else 0  # ahead of the loop; others are drawn in it
    ahead = max(1, min(_DRAWN_AHEAD, _NUMBERS // (x0.numel() * max(draws, 1))))
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
    last, structure = flatten(record(loop, state, torch.full_like(pieces[-1][1][:, -1], torch.nan)))
    pieces.append([part.unsqueeze(1) for part in last])
    kept = unflatten(structure, (torch.cat(column, dim=1) for column in zip(*pieces, strict=True)))
    time = torch.arange(0, steps + 1, every, dtype=torch.float64, device="cpu") * loop.dt
    frozen_at = torch.where(state.alive, torch.inf, state.lived * loop.dt)
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


def _check(system: Plant, cost: Cost, x0: Tensor) -> Cost:
    """Return the cost around the plant, once all shapes are right."""
    trailing("simulate", "x0", x0, dims=2, last=system.dim, meta=False, vmap=False)
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
    placed = cost.around(system)
    decided(lambda: warn_if_restless("simulate", system, placed), _ROWS)
    return placed
