"""Which of several starts are improved, and the best of what they lead to, row by row."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .newton import MeshPlan
from .optimum import Optimum

ROWS = 256  # states solved from at once: a graph of second derivatives is kept for each
_SAME = 1e-4  # relative, of the values of two starts that found the same
_MIRRORED = 1e-9  # relative difference of cost below which two guesses are one and its mirror image
_ROUGH = 1e-3  # relative: what a mesh may add to the value of the base's own control
_LONE = "local: one start alone"


def cheapest(plans: list[MeshPlan], count: int, used: Tensor) -> list[MeshPlan]:
    """The ``count`` cheapest of several plans that differ from each other and from one used, row by row.

    Two that cost the same are mirror images, or one and the same: they would find the same, and agree with
    nobody but themselves. All but the first of them come last, as plans that cost inf.

    Args:
        plans: of the rows.
        count: at most.
        used: cost of the plan that was improved already, (B,).
    """
    costs = torch.stack([used, *(plan.cost for plan in plans)])  # (1 + S, B)
    apart = (costs.unsqueeze(1) - costs).abs() > _MIRRORED * costs.abs()
    same = ~apart & torch.isfinite(costs)
    earlier = torch.ones_like(same[..., 0]).tril(-1).unsqueeze(-1)  # plan i after plan j
    costs = torch.where((same & earlier).any(1), torch.inf, costs)[1:]
    order = costs.argsort(dim=0, stable=True)[: min(count, len(plans))]
    rows = torch.arange(costs.shape[1], device="cpu")
    state, control = (torch.stack([getattr(p, name) for p in plans]) for name in ("state", "control"))
    return [MeshPlan(state[k, rows], control[k, rows], costs[k, rows]) for k in order]


def selected(optimum: Optimum, rows: Tensor) -> Optimum:
    """Some rows of a result."""
    parts = {name: part[rows] for name, part in _tensors(optimum).items()}
    reason = tuple(optimum.reason[row] for row in rows.tolist())
    return optimum._replace(**parts, reason=reason)


def _tensors(optimum: Optimum) -> dict[str, Tensor]:
    """Return the tensors with a row a state."""
    return {name: part for name, part in optimum._asdict().items() if name not in ("time", "reason")}


def merged(found: Optimum, rows: Tensor, several: list[Optimum]) -> Optimum:
    """The best of several starts in some rows, and the others as they were."""
    every = [selected(found, rows), *several]
    values = torch.stack([each.value.nan_to_num(nan=torch.inf) for each in every])  # (S, B')
    best = values.argmin(0)
    same = values <= values.amin(0) + _SAME * values.amin(0).abs()
    known = torch.stack([_stationary(each) for each in every])
    count = (same & known).sum(0)  # starts that found the lowest value
    places = torch.arange(len(rows), device=rows.device)
    columns = {}
    for name, whole in _tensors(found).items():
        chosen = torch.stack([getattr(each, name) for each in every])[best, places]
        columns[name] = whole.index_copy(0, rows, chosen)
    spent = torch.stack([each.iterations for each in every]).sum(0)
    columns["iterations"] = found.iterations.index_copy(0, rows, spent)
    reasons, converged = list(found.reason), found.converged.clone()
    for place, row in enumerate(rows.tolist()):
        finite = [float(v) for v in values[:, place] if math.isfinite(v)]
        converged[row] = int(count[place]) > 1 and bool(finite)
        if not finite:
            reasons[row] = found.reason[row]
        else:
            most, least = max(finite), min(finite)
            others = f"up to {most / least:.7g} times as much" if least > 0 else f"{least:.4g} to {most:.4g}"
            alike = least > 0 and most <= least * (
                1 + _SAME
            )  # no number: others ended in the same, unfinished
            local = f"{_LONE} found it" + ("" if alike else f", others {others}")
            own = every[int(best[place])].reason[place]
            lone = not own or own.startswith(_LONE)
            reasons[row] = "" if bool(converged[row]) else local if lone else f"local: {own}"
    columns["converged"] = converged
    return found._replace(**columns, reason=tuple(reasons))


def dearer(value: Tensor, followed: Tensor) -> Tensor:
    """Rows whose value is more than following the base costs on the same mesh, (B,) bool."""
    return value > followed + _ROUGH * followed.abs()


def replaced(found: Optimum, rows: Tensor, again: Optimum, believed: Tensor, followed: Tensor) -> Optimum:
    """Join what was found with what was found from the base in some rows, or NaN where that costs more too.

    Args:
        found: B rows.
        rows: in it, (B',).
        again: from the base in these rows.
        believed: rows of these where one start is enough, (B',) bool.
        followed: cost of following the base there, (B',).
    """
    lost = ~torch.isfinite(again.value) | dearer(again.value, followed)
    columns, reasons = {}, list(found.reason)
    for name, whole in _tensors(found).items():
        part = getattr(again, name)
        if name == "iterations":
            part = part + whole[rows]
        elif name == "converged":
            part = part & believed & ~lost
        elif name != "optimality":
            none = lost.reshape(-1, *[1] * (part.dim() - 1))
            part = torch.where(none, torch.nan, part)
        columns[name] = whole.index_copy(0, rows, part)
    for place, row in enumerate(rows.tolist()):
        if bool(lost[place]):
            reasons[row] = (
                f"what was found costs {float(found.value[row]):.4g}, more than following the base "
                f"({float(followed[place]):.4g}): state more `intervals`, or another `base`"
            )
        else:
            reasons[row] = "" if bool(believed[place]) else f"{_LONE}, the base, found it"
    return found._replace(**columns, reason=tuple(reasons))


def _stationary(optimum: Optimum) -> Tensor:
    """Rows of a start that it ended well in, also those that no other start agreed with, (B,) bool."""
    lone = [reason.startswith(_LONE) for reason in optimum.reason]
    return optimum.converged | torch.tensor(lone, dtype=torch.bool, device="cpu")


def joined(parts: list[Optimum]) -> Optimum:
    """Results of pieces of a batch.

    Raises:
        ValueError: if a piece needed a longer horizon than another.
    """
    longest = max(parts, key=lambda part: float(part.time[-1])).time
    if any(not torch.equal(part.time, longest) for part in parts):
        raise ValueError(
            "`DirectShooting.solve` needed different horizons for different states: state a `horizon` of "
            f"{float(longest[-1]):.4g} s, or solve at most {ROWS} states at once."
        )
    columns = {name: torch.cat([_tensors(part)[name] for part in parts]) for name in _tensors(parts[0])}
    reason = tuple(one for part in parts for one in part.reason)
    return parts[0]._replace(**columns, reason=reason)
