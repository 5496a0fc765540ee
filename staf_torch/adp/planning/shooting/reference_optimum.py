"""The optimum that a closed loop is measured against: by formula, or by direct shooting."""

from __future__ import annotations

import copy
import logging
from typing import NamedTuple

import torch
from torch import Tensor

from ....systems import ControlAffineSystem
from ...critic.laws import value_gradient
from ...loop.result import LoopResult
from ...loop.simulation import AdpProblem
from ...problem.cost import QuadraticCost
from .direct import DirectShooting

_log = logging.getLogger(__name__)
_AT_ONCE = 4096  # states whose V^ is asked for at once


class LoopOptimum(NamedTuple):
    """Optimum along a closed loop; None where it is not known."""

    cost: Tensor | None  # V*(x(0)), (B,)
    control_error: Tensor | None  # |u - u*|, (B, T); NaN at times at which it was not computed
    value_error: Tensor | None  # |V* - V^|, (B, T), likewise


class Optima(NamedTuple):
    """V* and u* of some states; NaN where they could not be found."""

    value: Tensor  # (...,)
    control: Tensor  # (..., m)


def optimal_cost(problem: AdpProblem) -> Tensor | None:
    """V*(x(0)), (B,); None where neither formula nor shooting finds it."""
    found = optima(problem, problem.initial_states)
    return None if found is None else found.value


def compare(problem: AdpProblem, result: LoopResult) -> LoopOptimum:
    """A closed loop against the optimum, at all recorded times where a formula knows it, else at some."""
    start = result.state[:, 0]
    batch, times = result.state.shape[:2]
    formula = known_value(problem, start) is not None
    at = torch.arange(times, device="cpu") if formula else _chosen(times, problem.optimum.states // batch)
    found = optima(problem, result.state[:, at])
    if found is None:
        return LoopOptimum(None, None, None)
    cost = found.value[:, 0]
    if len(at) < 2:
        return LoopOptimum(cost, None, None)
    off = (result.control[:, at] - found.control).norm(dim=-1)
    estimate = _estimates(problem, result, at)
    wrong = None if estimate is None else (found.value - estimate).abs()
    return LoopOptimum(cost, _spread(off, at, times), None if wrong is None else _spread(wrong, at, times))


def optima(problem: AdpProblem, x: Tensor) -> Optima | None:
    """V* and u* at the states x (..., n); None where neither formula nor shooting finds them."""
    known, system = known_value(problem, x), problem.system
    if known is not None and isinstance(system, ControlAffineSystem):
        gradient = value_gradient(lambda y: known_value(problem, y), x)  # type: ignore[arg-type, return-value]
        return Optima(known, problem.cost.policy(system.effectiveness(x), gradient))
    if not problem.optimum.shooting:
        return None
    try:
        shooting = DirectShooting(
            copy.deepcopy(problem.system).double(),
            copy.deepcopy(problem.cost).double(),
            horizon=problem.optimum.horizon,
            intervals=problem.optimum.intervals,
        )
        if shooting.lqr is None and shooting.stage.cost.ending is None:
            raise ValueError(
                "without an LQR at its end, the optimum over a finite horizon is that of another problem"
            )
        found = shooting.solve(x.flatten(0, -2).double())
    except (ValueError, RuntimeError) as error:  # the closed loop was run: it is worth keeping
        _log.warning("the optimum is not known: %s", str(error).splitlines()[0])
        return None
    lost = int(found.value.isnan().sum())
    local = int((~found.converged & ~found.value.isnan()).sum())
    if lost:
        _log.warning("direct shooting found no optimum from %d of %d states", lost, len(found.value))
    if local:
        _log.warning("V* of %d of %d states may be a local minimum only", local, len(found.value))
    mesh, horizon = (
        float(error.nan_to_num(posinf=torch.inf).max()) for error in (found.mesh_error, found.horizon_error)
    )
    _log.info(
        "V* by direct shooting from %d states, %d intervals over %.3g s: mesh error <= %.1e, horizon <= %.1e",
        *(len(found.value), shooting.intervals, shooting.horizon, mesh, horizon),
    )
    return Optima(found.value.reshape(x.shape[:-1]).to(x), found.control.reshape(*x.shape[:-1], -1).to(x))


def known_value(problem: AdpProblem, x: Tensor) -> Tensor | None:
    """V*(x) by a formula, (..., n) -> (...); None where the plant knows none for the cost."""
    if not isinstance(problem.cost, QuadraticCost) or not problem.cost.around(problem.system).plain:
        return None
    return problem.system.optimal_value(x, problem.cost.q, problem.cost.r)


def _chosen(times: int, count: int) -> Tensor:
    """``count`` of the recorded times, evenly, from the first; at least the first."""
    count = max(1, min(count, times - 1))
    return torch.arange(count, device="cpu") * (times - 1) // count


def _spread(values: Tensor, at: Tensor, times: int) -> Tensor:
    whole = values.new_full((len(values), times), torch.nan)
    whole[:, at] = values
    return whole


def _estimates(problem: AdpProblem, result: LoopResult, at: Tensor) -> Tensor | None:
    """V^ at the recorded states of the times ``at`` with the weights of then, (B, len(at))."""
    pieces, x = [], result.state[:, at].flatten(0, 1)
    known = {name: part[:, at].flatten(0, 1) for name, part in result.recorded.items()}
    for some in torch.arange(len(x), device="cpu").split(_AT_ONCE):
        with torch.no_grad():
            value = problem.controller.value(x[some], {name: part[some] for name, part in known.items()})
        if value is None:
            return None
        pieces.append(value)
    return torch.cat(pieces).reshape(len(result.state), len(at))
