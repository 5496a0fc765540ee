"""Result of a closed loop at the recorded times: five lines, and a picture with the LQR's run beside."""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...lanes.row_numbers import all_rows, some_rows
from ...lanes.tree import flatten, unflatten
from ...numerics.angles import wrap
from ...numerics.checks import fail
from ...results import pictures
from ...results.pictures import LoopPicture
from ...systems import Bounds, Clocked, Plant, Units
from ..problem.cost import Cost
from .controller import LQR, Carried, Controller, Feedback

OF_ROWS = ("state", "control", "running_cost", "recorded", "frozen_at", "carried")
"""Fields of a result that have the rows first."""
_log = logging.getLogger(__name__)
_DRAWN = 8  # rows
_NAMED = 6  # entries of a vector in a line
_ZERO = 1e-9  # of the largest state: a set-point that is not drawn


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
        leaves, structure = flatten([getattr(self, name) for name in OF_ROWS])
        parts = zip(*(leaf.split(rows) for leaf in leaves), strict=True)
        found = (LoopResult(self.time, *unflatten(structure, iter(part))) for part in parts)
        return [dataclasses.replace(part, about=self.about) for part in found]


class Limits(NamedTuple):
    """The widest bounds of the inputs of all rows."""

    low: Tensor | None  # (m,); None for none at all
    high: Tensor | None
    alike: bool  # whether all rows have these


@dataclasses.dataclass(frozen=True)
class LoopAbout:
    """The loop in words, units and bounds; what its picture computes with stays out of a pickle."""

    plant: str
    controller: str
    units: Units
    periodic: tuple[int, ...]
    clock: bool  # whether the last state is the time
    limits: Callable[[], Limits]  # of the inputs; looked for where somebody wants to see them
    cost: Cost | None = None  # around the plant
    beside: Callable[[Tensor, Tensor], LoopResult | None] | None = None  # the LQR's from (R, n), of rows (R,)

    @classmethod
    def of(
        cls,
        controller: Controller,
        system: Plant,
        cost: Cost,  # around the plant; its bounds are drawn where the controller was made with none
        period: float | None,  # for which a control is held, s; None where it follows the state
        run: Callable[[Controller, Tensor], LoopResult],  # the loop of another controller, from other states
    ) -> LoopAbout:
        """Return it of a loop, with arguments as in `simulate`."""
        clock = isinstance(system, Clocked)
        itself = isinstance(controller, Feedback) and isinstance(controller.policy, LQR)
        plant = type(system.plant if isinstance(system, Clocked) else system).__name__

        def found() -> list[Bounds]:
            return _bounds(controller) or ([] if cost.bounds is None else [cost.bounds])

        def of_rows(x0: Tensor, rows: Tensor) -> LoopResult | None:
            bounds = found()
            if len(bounds) > 1:
                return None  # rows of several kinds
            within = cost.bounded(bounds[0].low, bounds[0].high) if bounds else cost
            lqr = Feedback(LQR(system, within, period))  # of all rows, where they have plants of their own
            with some_rows(rows):
                return run(lqr, x0)

        facts = plant, controller.label, system.units, system.periodic, clock
        return cls(*facts, lambda: _widest(found()), cost, None if itself else of_rows)

    def __getstate__(self) -> dict[str, Any]:
        limits = functools.partial(Limits, *self.limits())
        return {**self.__dict__, "limits": limits, "cost": None, "beside": None}


def _bounds(holder: object, depth: int = 3) -> list[Bounds]:
    """Return the bounds of the inputs that a controller, or what is inside, was made with: of every kind of
    rows, where there are several; empty for none."""
    bounds = getattr(holder, "bounds", None)
    kinds = [_bounds(kind, depth) for kind in getattr(holder, "kinds", ())]
    if kinds:
        return [each for found in kinds for each in found]
    if isinstance(bounds, Bounds) and bounds.present:
        return [bounds]
    parts = (getattr(holder, name, None) for name in ("policy", "controller", "problem", "cost") if depth)
    within = (_bounds(part, depth - 1) for part in parts if part is not None)
    return next((each for each in within if each), [])


def _widest(found: Sequence[Bounds]) -> Limits:
    """Return the widest bounds of all rows."""
    if not found:
        return Limits(None, None, True)
    limits = [(each.low, each.high) for each in found]
    low, high = (
        torch.cat([all_rows(limit).reshape(-1, limit.shape[-1]) for limit in sides])
        for sides in zip(*limits, strict=True)
    )
    alike = bool((low == low[:1]).all() and (high == high[:1]).all())
    return Limits(low.amin(0), high.amax(0), alike)


def summary(result: LoopResult) -> str:
    """Return five lines: what ran, states, inputs, costs, how it ended."""
    parts = {name: getattr(result, name).detach() for name in ("state", "control", "running_cost")}
    result = dataclasses.replace(result, **parts)
    about = result.about
    rows, n, m = len(result.state), result.state.shape[-1], result.control.shape[-1]
    who = "" if about is None else f"{about.plant} with {about.controller}, "
    states = Units().of_states(n) if about is None else about.units.of_states(n)
    inputs = Units().of_inputs(m) if about is None else about.units.of_inputs(m)
    size = f"LoopResult: {who}{rows} {'row' if rows == 1 else 'rows'}, {len(result.time)} times, "
    if result.state.is_meta:
        return f"{size}{n} states, {m} inputs, on the meta device"
    bounded = ""
    limits = None if about is None else about.limits()
    if limits is not None and limits.low is not None and limits.high is not None:
        own = "" if limits.alike else ", or less in some rows"
        bounded = f"; bounds {_numbers(limits.low)} to {_numbers(limits.high)}{own}"
    far = _far(result)
    end = "" if far is None or not len(far) else f"|x - wanted| up to {float(far.max()):.3g}, "
    kept = f"; recorded: {', '.join(result.recorded)}" if result.recorded else ""
    cost = result.cost
    spread = (
        f"{float(cost.min()):.4g} to {float(cost.max()):.4g}, median {float(cost.double().quantile(0.5)):.4g}"
    )
    return "\n".join(
        [
            f"{size}0 to {float(result.time[-1]):g} s",
            f"  state    {_ranges('x', result.state, states)}",
            f"  control  {_ranges('u', result.control, inputs)}{bounded}",
            f"  cost     {f'{float(cost[0]):.4g}' if rows == 1 else spread}",
            f"  end      {end}{int(result.diverged.sum())} of {rows} diverged{kept}",
        ]
    )


def _numbers(values: Tensor) -> str:
    numbers = [f"{value:g}" for value in values.tolist()]
    return numbers[0] if len(set(numbers)) == 1 else f"({', '.join(numbers[:_NAMED])})"


def _ranges(letter: str, values: Tensor, units: Sequence[str]) -> str:
    """Return the least and the largest number of each entry, (..., k)."""
    flat = values.reshape(-1, values.shape[-1]).cpu()
    flat = torch.where(flat == 0, 0.0, flat)  # not -0
    low = torch.where(flat.isnan(), torch.inf, flat).amin(0).tolist()
    high = torch.where(flat.isnan(), -torch.inf, flat).amax(0).tolist()
    words = [
        f"{letter}{i + 1} {a:.3g} to {b:.3g} {unit}".rstrip() if a <= b else f"{letter}{i + 1} nowhere"
        for i, (a, b, unit) in enumerate(zip(low, high, units, strict=True))
    ]
    more = f", ... {letter}{len(words)}" if len(words) > _NAMED else ""
    return ", ".join(words[:_NAMED]) + more


def _far(result: LoopResult) -> Tensor | None:
    """Return the distance of the last states that are numbers from where they should be, (R,)."""
    about = result.about
    if about is None or about.cost is None:
        return None
    far: Tensor = about.cost.deviation(result.state[:, -1]).norm(dim=-1)
    return far[far.isfinite()]


def picture(result: LoopResult, rows: Sequence[int] | None, lqr: bool) -> LoopPicture:
    """Return what `LoopResult.figure` draws; a row that is not there is refused."""
    about, count = result.about, len(result.state)
    chosen = list(range(min(count, _DRAWN))) if rows is None else [int(row) for row in rows]
    if not chosen or not all(-count <= row < count for row in chosen):
        raise fail("LoopResult.figure", "rows", f"must be some of the {count} rows, from 0 on", rows)
    chosen = [row % count for row in chosen]
    dim, inputs = result.state.shape[-1], result.control.shape[-1]
    units, words, clock, low, high = Units(), "", False, None, None
    if about is not None:
        units, clock, (low, high, _) = about.units, about.clock, about.limits()
        words = f"{about.plant}, {about.controller}"
    if len(chosen) < count:
        words += f", {len(chosen)} of {count} rows"
    none = torch.full((inputs,), math.inf, dtype=torch.float64, device="cpu")
    return LoopPicture(
        *(words, result.time.cpu().numpy(), *_arrays(result, chosen)),
        *(units.of_states(dim)[: dim - clock], units.of_inputs(inputs)),
        (-none if low is None else low).cpu().numpy(),
        (none if high is None else high).cpu().numpy(),
        _wanted(result, chosen[0]),
        _beside(result, chosen[0]) if lqr else None,
    )


def _arrays(result: LoopResult, rows: Sequence[int]) -> tuple[Any, Any, Any]:
    """State, control and cost of some rows, with gaps where an angle jumps and once a row is frozen."""
    at = torch.tensor(rows, dtype=torch.int64, device=result.state.device)
    state, control, cost = (
        part.index_select(0, at).detach().cpu().double().clone()
        for part in (result.state, result.control, result.running_cost)
    )
    periodic = () if result.about is None else result.about.periodic
    state = _without_jumps(state, periodic)
    if control.shape[1] > 1:  # the last control is held to the end
        control[:, -1] = control[:, -2]
    frozen = result.time > result.frozen_at[at].cpu()[:, None]  # (R, T)
    cost[frozen] = torch.nan
    state[frozen], control[frozen] = torch.nan, torch.nan
    return state.numpy(), control.numpy(), cost.numpy()


def _beside(result: LoopResult, row: int) -> tuple[Any, Any, Any] | None:
    """The LQR's run from the same state; a line in the log where there is none."""
    about = result.about
    if about is None or about.beside is None:
        return None
    try:
        at = torch.tensor([row], dtype=torch.int64, device="cpu")
        with torch.no_grad():
            found = about.beside(result.state[[row], 0], at)
        return None if found is None else _arrays(found, [0])
    except (ValueError, RuntimeError) as error:
        _log.warning("no LQR beside this loop: %s", str(error).partition("\n")[0])
        return None


def _wanted(result: LoopResult, row: int) -> Any | None:
    """The set-point or the path at all times, (T, n); None where it is 0 or not known."""
    about = result.about
    if about is None or about.cost is None:
        return None
    x = result.state[row].detach()
    wanted = _without_jumps((x - about.cost.deviation(x)).cpu().double(), about.periodic)
    states = wanted[:, : wanted.shape[-1] - about.clock]
    return wanted.numpy() if bool((states.abs() > _ZERO * x.abs().max().cpu()).any()) else None


def _without_jumps(x: Tensor, periodic: Sequence[int]) -> Tensor:
    """Return states (..., T, n) with angles in [-pi, pi], and a gap in a line where one jumps by a turn."""
    x = wrap(x, periodic)
    for k in periodic:
        x[..., 1:, k][x[..., k].diff(dim=-1).abs() > math.pi] = torch.nan
    return x
