"""A memory of plans as a device reads it: tables, a search through all of them, and rollouts in loops."""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn

from ..adp import GlobalValue
from ..adp.planning.global_value import follow_plan
from ..lanes.trace.step import Step
from ..lanes.tree import Tree
from ..numerics.checks import hold
from .data_sheet import Source


class RememberedPolicy(nn.Module):
    """u of a `GlobalValue`: the first control of the cheapest of the K remembered plans nearest to x and of
    the goal's feedback, each followed from x. All S states that are searched are compared with x, one after
    the other, so that a call takes the same work at every state.

    Attributes:
        plans: state, control and feedback of every step and at last of the goal, (P, n + m + m n).
        models: state, value, gradient and curvature where candidates end, (E, n + 1 + n + n n).
        searched: the J states that are searched, in `GlobalValue.seen`'s coordinates, and their images a turn
            away where a coordinate is periodic, (S, n).
        first: the row of ``plans`` of every candidate, (J + 1,); the last one is the goal's feedback.
        last: the row of the end of its trajectory, (J + 1,).
        end: the row of ``models``, (J + 1,).
    """

    def __init__(self, memory: GlobalValue) -> None:
        super().__init__()
        problem, length = memory.problem, memory.length
        self.problem = copy.deepcopy(problem)
        self.candidates, self.lookahead, self.worst = memory.candidates, memory.lookahead, memory.worst
        steps = length - self.lookahead - 1  # of a trajectory; all later rows are the goal
        rows = torch.cat((memory.entries, torch.tensor([memory.resting], dtype=torch.int64, device="cpu")))
        which, time = rows // length, rows % length
        used, place = which.unique(return_inverse=True)
        kept = used.unsqueeze(1) * length + torch.arange(steps + 1, device="cpu")
        ends = which * length + (time + self.lookahead).clamp(max=steps)
        models, end = ends.unique(return_inverse=True)
        self.region = hold(self, "region", memory.region.clone())
        self.frame = hold(self, "frame", memory.frame.clone())
        self.searched = hold(self, "searched", memory.images())
        self.plans = hold(self, "plans", memory.plans[kept.flatten()])
        self.models = hold(self, "models", memory.models[models])
        self.first = hold(self, "first", place * (steps + 1) + time)
        self.last = hold(self, "last", place * (steps + 1) + steps)
        self.end = hold(self, "end", end)

    def forward(self, x: Tensor) -> Tensor:
        """u: (B, n) -> (B, m)."""
        count, states = self.candidates + 1, len(self.first) - 1
        apart = (self.seen(x).unsqueeze(1) - self.searched).square().sum(-1)  # (B, S)
        near = apart.topk(self.candidates, largest=False).indices % states
        at = torch.cat((near, torch.full_like(near[:, :1], states)), dim=1).flatten()
        ahead = self.first[at].unsqueeze(1) + torch.arange(self.lookahead, device="cpu")
        window = self.plans[torch.minimum(ahead, self.last[at].unsqueeze(1))]
        rows = x.unsqueeze(1).expand(-1, count, -1).flatten(0, 1)
        end = self.models[self.end[at]]
        cost, control, _ = follow_plan(self.problem, self.region, self.worst, rows, window, end)
        best = cost.unflatten(0, (-1, count)).argmin(1, keepdim=True)
        u = control.unflatten(0, (-1, count)).gather(1, best[..., None].expand(-1, -1, control.shape[-1]))
        chosen: Tensor = u.squeeze(1)
        return chosen

    def seen(self, x: Tensor) -> Tensor:
        """Return states in the coordinates of the search, (B, n)."""
        offset: Tensor = self.problem.offset(x, self.problem.goal.to(x)) @ self.frame
        return offset

    def source(self, one: Source) -> Source:
        """Return the cost of a call, where following a candidate costs ``one``."""
        plans, (searched, n) = self.candidates + 1, self.searched.shape
        compared = searched * (3 * n + 1) + n * (2 * n + 4)
        tables = sum(getattr(self, name).numel() for name in ("plans", "models", "searched"))
        return Source(tables + one.constants, plans * one.flops + compared, plans * one.functions)

    def step(self) -> Step:
        """Return what evaluates a candidate from a state, (1, n), as the step of a row program."""

        def step(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
            given = row["x"], row["window"], row["end"]
            return carry, follow_plan(self.problem, self.region, self.worst, *given)[:2]

        return step

    def row(self, x: Tensor) -> dict[str, Tensor]:
        """Return the inputs of `step` for the first candidate and a state (1, n)."""
        window = self.plans[self.first[:1].expand(self.lookahead)].unsqueeze(0)
        return {"x": x, "window": window, "end": self.models[:1]}

    def c_text(self, name: str, follow: str, output: str) -> str:
        """Return a header's text: tables, ``follow`` of `step` as ``NAME_follow``, and the search."""
        real = "float" if self.plans.dtype == torch.float32 else "double"
        n, m = self.problem.dim, self.problem.inputs
        floats = ("plans", "models", "searched", "frame")
        tables = [_table(real, f"{name}_{each}", getattr(self, each), real == "float") for each in floats]
        whole = ("first", "last", "end")
        tables += [_table("int", f"{name}_{each}", getattr(self, each), False) for each in whole]
        sizes: dict[str, object] = {"NAME": name, "REAL": real, "CONTROL": output, "N": n, "M": m}
        sizes |= {"WIDTH": self.plans.shape[1], "MODEL": self.models.shape[1], "S": len(self.searched)}
        sizes |= {"J": len(self.first) - 1, "K": self.candidates, "H": self.lookahead}
        sizes["ROUND"] = "rintf" if real == "float" else "rint"
        sizes["GOAL"] = ", ".join(repr(float(g)) for g in self.problem.goal)
        turns = (repr(2 * math.pi) if i in self.problem.periodic else "0" for i in range(n))
        sizes["PERIOD"] = ", ".join(turns)
        text = _SEARCH
        for each, value in sizes.items():
            text = text.replace(f"@{each}@", str(value))
        return "\n".join([follow.strip(), "", *tables, text])


def _table(kind: str, name: str, table: Tensor, single: bool) -> str:
    digits = [f"{x:.9g}" if single else repr(x) for x in table.flatten().tolist()]
    lines = ",\n".join(", ".join(digits[k : k + 8]) for k in range(0, len(digits), 8))
    return f"static const {kind} {name}[{table.numel()}] = {{\n{lines}\n}};\n"


_SEARCH = """static inline void @NAME@(const @REAL@ state[@N@], @REAL@ @CONTROL@[@M@])
{
    static const @REAL@ own_goal[@N@] = { @GOAL@ }, own_period[@N@] = { @PERIOD@ }; /* 0: no angle */
    @REAL@ own_at[@N@] = { 0 }, own_far[@K@], own_least = (@REAL@)INFINITY;
    int own_near[@K@ + 1];
    for (int i0 = 0; i0 < @N@; ++i0) {
        @REAL@ own_away = state[i0] - own_goal[i0];
        if (own_period[i0] > 0) own_away -= @ROUND@(own_away / own_period[i0]) * own_period[i0];
        for (int i2 = 0; i2 < @N@; ++i2) own_at[i2] += own_away * @NAME@_frame[i0 * @N@ + i2];
    }
    for (int i2 = 0; i2 < @K@; ++i2) own_far[i2] = (@REAL@)INFINITY, own_near[i2] = i2;
    own_near[@K@] = @J@; /* the goal's own feedback */
    for (int i1 = 0; i1 < @S@; ++i1) { /* the @K@ nearest, the nearest first */
        @REAL@ own_square = 0;
        for (int i0 = 0; i0 < @N@; ++i0) {
            const @REAL@ own_apart = own_at[i0] - @NAME@_searched[i1 * @N@ + i0];
            own_square += own_apart * own_apart;
        }
        if (!(own_square < own_far[@K@ - 1])) continue;
        int i2 = @K@ - 1;
        for (; i2 > 0 && own_square < own_far[i2 - 1]; --i2) {
            own_far[i2] = own_far[i2 - 1];
            own_near[i2] = own_near[i2 - 1];
        }
        own_far[i2] = own_square, own_near[i2] = i1 % @J@; /* an image stands for its state */
    }
    for (int i2 = 0; i2 <= @K@; ++i2) {
        @REAL@ own_window[@H@ * @WIDTH@], own_cost[1], own_control[@M@];
        const int i1 = own_near[i2];
        for (int t0 = 0; t0 < @H@; ++t0) {
            const int own_end = @NAME@_last[i1], own_next = @NAME@_first[i1] + t0;
            const @REAL@ *own_plan = @NAME@_plans + (own_next < own_end ? own_next : own_end) * @WIDTH@;
            for (int i0 = 0; i0 < @WIDTH@; ++i0) own_window[t0 * @WIDTH@ + i0] = own_plan[i0];
        }
        @NAME@_follow(state, own_window, @NAME@_models + @NAME@_end[i1] * @MODEL@, own_cost, own_control);
        if (i2 > 0 && !(own_cost[0] < own_least)) continue;
        own_least = own_cost[0];
        for (int i0 = 0; i0 < @M@; ++i0) @CONTROL@[i0] = own_control[i0];
    }
}
"""
