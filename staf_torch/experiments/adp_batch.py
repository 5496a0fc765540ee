"""Closed loops of many problems as one tensor batch. No problem influences another."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ..adp import ActorCritic, Controller, Gains, LoopResult, Supervised, simulate
from .build_adp import AdpProblem


def simulate_together(
    problems: Sequence[AdpProblem], progress: Callable[[int], None] | None = None
) -> list[LoopResult]:
    """Run problems that differ in initial states, seeds, initial weights and gains alone.

    Args:
        problems: at least one, alike in everything else.
        progress: as in `simulate`.
    """
    first = problems[0]
    rows = [len(problem.initial_states) for problem in problems]
    together = simulate(
        _stacked([problem.controller for problem in problems], rows),
        first.system,
        first.cost,
        torch.cat([problem.initial_states for problem in problems]),
        dt=first.dt,
        steps=first.steps,
        every=first.every,
        seed=[
            problem.seed + row for problem, batch in zip(problems, rows, strict=True) for row in range(batch)
        ],
        integrator=first.integrator,
        compile=first.compile,
        progress=progress,
    )
    fields = [field.name for field in dataclasses.fields(together) if field.name != "time"]
    parts = zip(*(getattr(together, name).split(rows) for name in fields), strict=True)
    return [LoopResult(together.time, **dict(zip(fields, part, strict=True))) for part in parts]


def _stacked(controllers: Sequence[Controller], rows: Sequence[int]) -> Controller:
    """One controller in place of several whose initial weights and gains differ."""
    if len(controllers) == 1:
        return controllers[0]
    stacked = copy.deepcopy(controllers[0])
    target, learners = _learner(stacked), [_learner(each) for each in controllers]
    if target is None:
        return stacked
    given = [learner for learner in learners if learner is not None]
    counts = torch.tensor(rows)
    for name in ("critic", "actor", "gain"):
        values = torch.stack([getattr(learner, name) for learner in given])
        setattr(target, name, values.repeat_interleave(counts.to(values.device), dim=0))
    target.law.gains = _gains([learner.law.gains for learner in given], counts, target.critic)
    return stacked


def _gains(gains: Sequence[Gains], counts: Tensor, like: Tensor) -> Gains:
    """Numbers where all agree, else (B, 1) of the dtype and on the device of ``like``."""
    found: dict[str, float | Tensor] = {}
    for field in dataclasses.fields(Gains):
        values = [getattr(each, field.name) for each in gains]
        rows = torch.tensor(values, dtype=torch.float64).repeat_interleave(counts).to(like)
        found[field.name] = values[0] if len(set(values)) == 1 else rows.unsqueeze(-1)
    return Gains(**found)


def _learner(controller: Controller) -> ActorCritic | None:
    inner = controller.controller if isinstance(controller, Supervised) else controller
    return inner if isinstance(inner, ActorCritic) else None
