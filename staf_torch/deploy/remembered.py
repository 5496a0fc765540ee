"""A memory of plans as a device reads it: tables, a search through all of them, and rollouts in loops."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..adp import GlobalValue
from ..adp.planning.global_value import follow_plan
from ..lanes import Program
from ..lanes.emit.c import commented
from ..lanes.emit.identifiers import guarded
from ..lanes.tree import Tree
from ..numerics.checks import hold


class RememberedPolicy(nn.Module):
    """u of a `GlobalValue`: the first control of the cheapest of the K remembered plans nearest to x and of
    the goal's feedback, each followed from x. All S states that are searched are compared with x, one after
    the other, so that a call takes the same work at every state.

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> library = adp.BoxDDP(problem, steps=80, compile=False).solve(torch.tensor([[1.0, 0.0]]).double())
        >>> memory = adp.GlobalValue(problem, library, region=[1.5, 1.0], candidates=4, lookahead=10)
        >>> x = torch.tensor([[0.9, 0.0]]).double()
        >>> bool((deploy.RememberedPolicy(memory)(x) - memory(x)).abs().max() < 1e-12)
        True

        Shown by `staf_torch/deploy/README.md`.

    Args:
        memory: of which the tables are copied that a control needs.

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
        rows = torch.cat((memory.entries, torch.tensor([memory.resting], dtype=torch.int64)))
        which, time = rows // length, rows % length
        used, place = which.unique(return_inverse=True)
        kept = used.unsqueeze(1) * length + torch.arange(steps + 1)
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
        seen = self.problem.offset(x, self.problem.goal) @ self.frame
        apart = (seen.unsqueeze(1) - self.searched).square().sum(-1)  # (B, S)
        near = apart.topk(self.candidates, largest=False).indices % states
        at = torch.cat((near, torch.full_like(near[:, :1], states)), dim=1).flatten()
        ahead = self.first[at].unsqueeze(1) + torch.arange(self.lookahead)
        window = self.plans[torch.minimum(ahead, self.last[at].unsqueeze(1))]
        rows = x.unsqueeze(1).expand(-1, count, -1).flatten(0, 1)
        end = self.models[self.end[at]]
        cost, control, _ = follow_plan(self.problem, self.region, self.worst, rows, window, end)
        best = cost.unflatten(0, (-1, count)).argmin(1, keepdim=True)
        u = control.unflatten(0, (-1, count)).gather(1, best[..., None].expand(-1, -1, control.shape[-1]))
        chosen: Tensor = u.squeeze(1)
        return chosen

    def program(self) -> Program:
        """Evaluate a candidate from a state, (1, n), as a row program."""

        def step(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
            given = row["x"], row["window"], row["end"]
            return carry, follow_plan(self.problem, self.region, self.worst, *given)[:2]

        return Program(step, name="a plan that is followed")

    def row(self, x: Tensor) -> dict[str, Tensor]:
        """Return the inputs of `program` for the first candidate and a state (1, n)."""
        window = self.plans[self.first[:1].expand(self.lookahead)].unsqueeze(0)
        return {"x": x, "window": window, "end": self.models[:1]}

    def c_text(self, name: str, follow: str, outputs: Sequence[str], note: str) -> str:
        """The header: tables, the text ``follow`` of `program` as ``NAME_follow``, and the search."""
        real = "float" if self.plans.dtype == torch.float32 else "double"
        n, m = self.problem.dim, self.problem.inputs
        floats = ("plans", "models", "searched", "frame")
        tables = [_table(real, f"{name}_{each}", getattr(self, each), real == "float") for each in floats]
        whole = ("first", "last", "end")
        tables += [_table("int", f"{name}_{each}", getattr(self, each), False) for each in whole]
        sizes = {
            **{
                "NAME": name,
                "REAL": real,
                "N": n,
                "M": m,
                "WIDTH": self.plans.shape[1],
                "MODEL": self.models.shape[1],
            },
            **{"S": len(self.searched), "J": len(self.first) - 1, "K": self.candidates, "H": self.lookahead},
            **{"ROUND": "rintf" if real == "float" else "rint", "CONTROL": outputs[0]},
            "GOAL": ", ".join(repr(float(g)) for g in self.problem.goal),
            "PERIOD": ", ".join(repr(2 * math.pi) if i in self.problem.periodic else "0" for i in range(n)),
        }
        text = _SEARCH
        for each, value in sizes.items():
            text = text.replace(f"@{each}@", str(value))
        return commented(note) + guarded(name, "\n".join([follow.strip(), "", *tables, text]))


def _table(kind: str, name: str, table: Tensor, single: bool) -> str:
    digits = [f"{x:.9g}" if single else repr(x) for x in table.flatten().tolist()]
    lines = ",\n".join(", ".join(digits[k : k + 8]) for k in range(0, len(digits), 8))
    return f"static const {kind} {name}[{table.numel()}] = {{\n{lines}\n}};\n"


_SEARCH = """static inline void @NAME@(const @REAL@ state[@N@], @REAL@ @CONTROL@[@M@])
{
    static const @REAL@ goal[@N@] = { @GOAL@ }, period[@N@] = { @PERIOD@ }; /* 0: no angle */
    @REAL@ at[@N@] = { 0 }, far[@K@], least = (@REAL@)INFINITY;
    int near[@K@ + 1];
    for (int i = 0; i < @N@; ++i) {
        @REAL@ away = state[i] - goal[i];
        if (period[i] > 0) away -= @ROUND@(away / period[i]) * period[i];
        for (int k = 0; k < @N@; ++k) at[k] += away * @NAME@_frame[i * @N@ + k];
    }
    for (int k = 0; k < @K@; ++k) far[k] = (@REAL@)INFINITY, near[k] = k;
    near[@K@] = @J@; /* the goal's own feedback */
    for (int j = 0; j < @S@; ++j) { /* the @K@ nearest, the nearest first */
        @REAL@ square = 0;
        for (int i = 0; i < @N@; ++i) {
            const @REAL@ apart = at[i] - @NAME@_searched[j * @N@ + i];
            square += apart * apart;
        }
        if (!(square < far[@K@ - 1])) continue;
        int k = @K@ - 1;
        for (; k > 0 && square < far[k - 1]; --k) far[k] = far[k - 1], near[k] = near[k - 1];
        far[k] = square, near[k] = j % @J@; /* an image stands for its state */
    }
    for (int k = 0; k <= @K@; ++k) {
        @REAL@ window[@H@ * @WIDTH@], cost[1], control[@M@];
        const int j = near[k];
        for (int t = 0; t < @H@; ++t) {
            const int row = @NAME@_first[j] + t < @NAME@_last[j] ? @NAME@_first[j] + t : @NAME@_last[j];
            for (int i = 0; i < @WIDTH@; ++i) window[t * @WIDTH@ + i] = @NAME@_plans[row * @WIDTH@ + i];
        }
        @NAME@_follow(state, window, @NAME@_models + @NAME@_end[j] * @MODEL@, cost, control);
        if (k > 0 && !(cost[0] < least)) continue;
        least = cost[0];
        for (int i = 0; i < @M@; ++i) @CONTROL@[i] = control[i];
    }
}
"""
