"""Uncontrolled trajectories, in pieces of time so that memory does not grow with the horizon."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from ..lanes import Program, repeat
from ..lanes.calls.choice import DIFFERENTIATED, undecided, worth
from ..lanes.compiled_methods import LoopProgram
from ..lanes.device.host import capturing
from ..lanes.device.kernel import rows_of, with_rows
from ..lanes.gradients import wants_gradient
from ..lanes.row_numbers import over_rows, over_some_rows, some_rows
from ..lanes.shared_programs import SharedPrograms
from ..lanes.torch_compile.operators import one_operator
from ..lanes.trace.step import Step
from ..lanes.tree import Tree
from ..numerics.checks import fail, integer, positive_real, trailing
from ..numerics.default_device import beside
from ..numerics.runge_kutta import (
    BENT,
    GRACE,
    MOST,
    TOLERANCE,
    TRIED,
    needed_steps,
    runge_kutta_mean,
    runge_kutta_stages,
)
from ..signs import Sign
from .base import ControlAffineSystem

_kept = SharedPrograms("a trajectory")
_log = logging.getLogger(__name__)
_TOGETHER = 1 << 14  # states that are looked at together, which a cache holds
_PAYS = 10_000  # steps of a small batch in plain torch (some .1 ms each) that take as long as to compile


def trajectory(
    system: ControlAffineSystem, x0: Tensor, *, dt: float, steps: int, chunk: int | None = None
) -> Iterator[Tensor]:
    """x(0), x(dt), ..., x(steps dt) without control, in pieces of at most ``chunk`` times.

    The exact flow where the system has one, else Runge-Kutta steps of length dt; a trajectory whose rate is
    too fast for that takes as many a dt as leave an error of 1e-6 of its state, and where they are too many
    the log has a warning. A trajectory that escapes to infinity is non-finite from there on; the others do
    not notice. Within `torch.cuda.graph` nobody can take smaller steps: a row that needs them is NaN.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> [p.shape[1] for p in systems.trajectory(systems.Oscillator(), x0, dt=0.01, steps=10, chunk=4)]
        [4, 4, 3]

        Shown by `staf trajectories=100`.

    Args:
        system: the plant.
        x0: (B, n).
        dt: step, positive, in seconds.
        steps: number of steps, at least 0.
        chunk: times a piece, all by default.

    Yields:
        (B, C, n), together (B, steps + 1, n).

    Raises:
        ValueError: if an argument breaks its rule, or the plant returns another shape.
    """
    if isinstance(system, type) or not callable(getattr(system, "drift", None)):
        rule = "must be a plant with a `drift`: x' = f(x) + g(x) u, of which f is followed"
        rule = "must be an object, and is the class" if isinstance(system, type) else rule
        raise fail("trajectory", "system", rule, system)
    trailing("trajectory", "x0", x0, dims=2, last=getattr(system, "dim", None), vmap=False)
    positive_real("trajectory", "dt", dt)
    total = integer("trajectory", "steps", steps, least=0) + 1
    size = total if chunk is None else integer("trajectory", "chunk", chunk, least=1)
    flow = getattr(system, "flow", None)  # a user's module need not have one

    often = DIFFERENTIATED if wants_gradient(system, x0) else 1
    program, x = _stepped(system, dt, 1, often * total, x0), x0
    none = x0.detach().new_full((1,), torch.nan).expand(len(x0))
    for start in range(0, total, size):
        stop = min(start + size, total)
        if flow is not None:
            where = "meta" if x0.is_meta else "cpu"
            time = torch.arange(start, stop, dtype=torch.float64, device=where) * dt
            exact = over_rows(functools.partial(flow, time=time), x0)
            if exact is not None:
                yield exact
                continue
        (after, bent, reach), piece = program((x, none, none), steps=stop - start)
        if capturing(x):  # nothing can be read, nor done again
            strained = ~(bent <= BENT * reach) & torch.isfinite(reach)
            x = torch.where(strained.unsqueeze(-1), torch.nan, after)
            yield torch.where(strained[:, None, None], torch.nan, piece)
            continue
        # By one number no row is strained, surely; NaN in any says nothing.
        if len(bent) and bool(torch.add(bent, reach, alpha=-BENT).amax() <= 0):
            x = after
            yield piece
            continue
        if bool(bent.isnan().all()):  # by plain torch, which takes as long for all states at once as for one
            some = torch.arange(len(x0), device=x.device).split(max(1, _TOGETHER // piece.shape[1]))
            bent = torch.cat([_advanced_rows(system, k, rows_of(piece, k), dt, 1)[1].amax(1) for k in some])
            reach = piece.abs().amax(-1).amax(1).to(x.device)
        strained = ~(bent <= BENT * reach) & torch.isfinite(reach)
        if bool(strained.any()):
            after, piece = _refined(system, dt, x, after, piece, strained.nonzero().squeeze(1))
        x = after
        yield piece


Tracked = tuple[Tensor, Tensor, Tensor]
"""x (B, n), how much the rate bent within a step so far (B,), the largest coordinate so far (B,), or NaN."""


def _stepped(
    system: ControlAffineSystem, dt: float, count: int, times: int, x: Tensor
) -> Program | LoopProgram:
    """Steps of dt in so many Runge-Kutta steps, which record the state before every one.

    In plain torch they leave NaN where the rate's bend is asked for, which the states tell afterwards; not
    while a graph is recorded.
    """

    def tracked(system: ControlAffineSystem, dt: float, count: int) -> Step:
        def step(now: Tracked, given: Tree, row: Tree) -> tuple[Tracked, Tensor]:
            x, bent, reach = now
            after, more = _advanced(system, x, dt, count)
            bent, size = torch.where(more <= bent, bent, more), x.abs().amax(-1)
            return (after, bent, torch.where(size <= reach, reach, size)), x

        return step

    def untracked(now: Tracked, given: Tree, row: Tree) -> tuple[Tracked, Tensor]:
        x = now[0]
        after = _advanced(system, x, dt, count)[0] if count > 1 else _runge_kutta(system, x, dt)[0]
        return (after, *now[1:]), x

    def compiled() -> Program:
        parts = system, dt, count
        known = _kept.unchanged(*parts)
        return _kept.of(tracked(*parts), *parts, owners=parts, make=tracked) if known is None else known

    if worth(count * times * (1 + len(x) / 200) >= _PAYS, x):
        return compiled()
    if capturing(x):
        return Program(tracked(system, dt, count), name="a trajectory", compile=False)
    plain = Program(untracked, name="a trajectory", compile=False)
    return LoopProgram(plain, compiled, times, parts=(system,)) if undecided() else plain


def _advanced(system: ControlAffineSystem, x: Tensor, dt: float, count: int) -> tuple[Tensor, Tensor]:
    """x after dt, and how much the rate bent, h |k_3 - k_2|: (..., n) -> (..., n), (...)."""
    h = dt / count

    def advanced(x: Tensor) -> tuple[Tensor, Tensor]:
        after, slopes = _runge_kutta(system, x, h)
        return after, h * (slopes[2] - slopes[1]).abs().amax(-1)

    def substep(now: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        after, bent = advanced(now[0])
        return after, torch.where(bent <= now[1], now[1], bent)

    if count == 1:
        return advanced(x)
    found: tuple[Tensor, Tensor] = repeat(count, substep, (x, torch.zeros_like(x[..., 0])))
    return found


def _runge_kutta(system: ControlAffineSystem, x: Tensor, h: float) -> tuple[Tensor, Sequence[Tensor]]:
    """x after a step of h, and the rates at its four stages."""
    _, slopes = runge_kutta_stages(lambda at, share: _drift(system, at), x, h)
    return x + runge_kutta_mean(slopes, h), slopes


def _advanced_rows(
    system: ControlAffineSystem, rows: Tensor, x: Tensor, dt: float, count: int
) -> tuple[Tensor, Tensor]:
    """The result of `_advanced` at states (R, ..., n) of these rows (R,) of all."""
    return over_some_rows(lambda at: _advanced(system, at, dt, count), rows, x)


def _refined(
    system: ControlAffineSystem, dt: float, x: Tensor, after: Tensor, piece: Tensor, rows: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the end and the states of a piece in which these rows (R,) took the steps that they need."""
    states = rows_of(piece, rows)
    bent = _advanced_rows(system, rows, states, dt, 1)[1].nan_to_num(math.inf, math.inf)
    bent = torch.where(torch.isfinite(states).all(-1), bent, -1.0)
    at = bent.topk(min(TRIED, bent.shape[1]), dim=1).indices.unsqueeze(-1)
    tried = states.gather(1, at.expand(-1, -1, x.shape[-1]))
    known = torch.isfinite(tried).all(-1)

    def errors(some: Tensor, times: int) -> Tensor:
        now, better = (_advanced_rows(system, rows[some], tried[some], dt, k * times)[0] for k in (1, 2))
        size = torch.maximum(tried[some].abs(), better.abs().nan_to_num(0.0, 0.0)).amax(-1)
        wrong = torch.where(known[some], (now - better).abs().amax(-1), 0.0).amax(1)
        return (wrong / torch.where(known[some], size, 0.0).amax(1)).nan_to_num(math.inf, math.inf)

    most = torch.full((len(rows),), MOST, dtype=torch.int64, device=rows.device)
    found = needed_steps(errors, most, TOLERANCE, GRACE * TOLERANCE)
    for factor in found.factor.unique().tolist():
        chosen = rows[(found.factor == factor).to(rows.device)]
        if factor > 1:
            begun = x[chosen], torch.zeros_like(x[chosen, 0]), torch.zeros_like(x[chosen, 0])
            times = piece.shape[1]
            with some_rows(chosen):
                (end, _, _), again = _stepped(system, dt, factor, times, begun[0])(begun, steps=times)
            after, piece = after.index_copy(0, chosen, end), with_rows(piece, chosen, again)
    wrong = found.error > GRACE * TOLERANCE
    if bool(wrong.any()):
        _log.warning(
            "a trajectory of %s in steps of %.4g s is wrong by more than %.0e of its state a step in %d "
            "rows, by %.2g in row %d: its rate is too fast for this dt, or has corners.",
            *(type(system).__name__, dt, GRACE * TOLERANCE, int(wrong.sum()), float(found.error.max())),
            int(rows[int(found.error.argmax())]),
        )
    return after, piece


@one_operator
@Sign("systems.simulate")
@beside
def simulate(system: ControlAffineSystem, x0: Tensor, *, dt: float, steps: int) -> Tensor:
    """The whole of `trajectory` at once: (B, n) -> (B, steps + 1, n).

    Where a device has no room for the states they are on the processor, and the log has a line.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0], [0.5, 0.0]]).double()  # (B, n)
        >>> systems.simulate(systems.VanDerPol(), x0, dt=0.01, steps=100).shape  # (B, T, n)
        torch.Size([2, 101, 2])

        Shown by `staf system=van_der_pol`.
    """
    (states,) = trajectory(system, x0, dt=dt, steps=steps)
    return states


def _drift(system: ControlAffineSystem, x: Tensor) -> Tensor:
    rate = system.drift(x)
    if not isinstance(rate, Tensor) or rate.shape != x.shape:
        got = tuple(rate.shape) if isinstance(rate, Tensor) else rate
        raise ValueError(
            f"`{type(system).__name__}.drift` must map (..., n) to (..., n): "
            f"{tuple(x.shape)} must give the same; got {got}."
        )
    return rate
