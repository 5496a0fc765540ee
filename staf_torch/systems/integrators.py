"""Uncontrolled trajectories, in pieces of time so that memory does not grow with the horizon."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ..lanes import Program, shared_program
from ..lanes.compiled_methods import undecided, worth
from ..lanes.loop_program import LoopProgram
from ..lanes.tree import Tree
from ..numerics.checks import integer, positive_real, trailing
from ..numerics.runge_kutta import runge_kutta_step
from .base import ControlAffineSystem

_PAYS = 10_000  # steps of a small batch in plain torch (some .1 ms each) that take as long as to compile


def trajectory(
    system: ControlAffineSystem, x0: Tensor, *, dt: float, steps: int, chunk: int | None = None
) -> Iterator[Tensor]:
    """x(0), x(dt), ..., x(steps dt) without control, in pieces of at most ``chunk`` times.

    The exact flow where the system has one, else Runge-Kutta steps of length dt. A trajectory that
    escapes to infinity is non-finite from there on; the others do not notice.

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
    trailing("trajectory", "x0", x0, dims=2, last=getattr(system, "dim", None))
    positive_real("trajectory", "dt", dt)
    total = integer("trajectory", "steps", steps, least=0) + 1
    size = total if chunk is None else integer("trajectory", "chunk", chunk, least=1)
    flow = getattr(system, "flow", None)  # a user's module need not have one

    def step(x: Tensor, now: Tree, row: Tree) -> tuple[Tensor, Tensor]:
        return runge_kutta_step(lambda at: _drift(system, at), x, dt), x  # the state before every step

    def compiled() -> Program:
        return shared_program("a trajectory", step, system, dt)

    pays, x = worth(total * (1 + len(x0) / 200) >= _PAYS), x0
    program: Program | LoopProgram = compiled() if pays else Program(step, name="a trajectory", compile=False)
    if isinstance(program, Program) and not pays and undecided():
        program = LoopProgram(program, compiled, total)
    for start in range(0, total, size):
        stop = min(start + size, total)
        time = torch.arange(start, stop, dtype=torch.float64) * dt
        exact = flow(x0, time) if flow is not None else None
        if exact is not None:
            yield exact
            continue
        x, piece = program(x, steps=stop - start)
        yield piece


def simulate(system: ControlAffineSystem, x0: Tensor, *, dt: float, steps: int) -> Tensor:
    """The whole of `trajectory` at once: (B, n) -> (B, steps + 1, n).

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
