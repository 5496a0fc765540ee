"""Accuracy of a simulated plant: which rows its integration steps were too long for, and how many they need.

A loop records how much the rate bends within a step, which costs no call of the plant. Where that is much,
the holds in which it bent most are repeated with twice the steps, and so on: a row's own number of steps
follows, from nothing but what the row itself did.
"""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor, nn

from ...lanes.row_numbers import over_rows, over_some_rows
from ...numerics.runge_kutta import GRACE, MOST, TOLERANCE, TRIED, StepsNeeded, needed_steps
from ..problem.held_plant import Holding

_log = logging.getLogger(__name__)
_MODELS = 100.0  # times the tolerance, before a controller's model is a warning
_MOST_FROZEN = 64  # times the steps of a row that left the finite numbers
_TOGETHER = 1 << 16  # holds that are repeated at once


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
