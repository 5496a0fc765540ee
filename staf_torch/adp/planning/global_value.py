"""A value and a policy for a whole box of states: a memory of local models along optimal trajectories."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from ...lanes import Program, scan
from ...lanes.gradients import without_gradient
from ...numerics.checks import fail, hold, integer, positive, positive_real, trailing, vector
from ...numerics.default_device import KeptPrecision, where_held
from ..problem.rules import check_endless, check_regulator
from ..problem.sampled import SampledProblem
from .trajectories import LocalModel, Reference, Trajectories, around, packed, resting, unpacked

_log = logging.getLogger(__name__)
_TOGETHER = 4096  # candidates rolled out at once
_ROUND = 0.01  # share of the metric that counts every coordinate, also one of which no cost depends
_REACH = 0.3  # of the region: a rollout that ends further from what it follows has lost it
_ARRIVED = 0.01  # share of a trajectory's cost that may be the terminal value: else it did not reach the goal


def half_widths(call: str, region: Sequence[float] | Tensor, dim: int) -> Tensor:
    """Return half the width of a box of states, (n,) float64, positive."""
    given = vector(call, "region", region if isinstance(region, Tensor) else list(region), dim)
    return positive(call, "region", torch.tensor(given, dtype=torch.float64, device="cpu"))


def check_memorable(call: str, problem: SampledProblem) -> None:
    """Refuse a problem without a goal at which trajectories arrive and stay."""
    if problem.path is not None:
        raise fail(call, "problem", "must have a goal that stays where it is", problem.path)
    check_regulator(call, "problem", problem.unregulated)
    end = None if problem.endless else problem.end
    check_endless(call, "problem", end, "a memory of plans has no final time")


def _held(memory: GlobalValue) -> Tensor:
    return memory.plans


class Choice(NamedTuple):
    """Best candidates at states x."""

    control: Tensor  # u, (B, m)
    value: Tensor  # cost of the best candidate, (B,)
    entry: Tensor  # its row in the memory, (B,) int64
    covered: Tensor  # whether it ends near what it follows, (B,) bool


class GlobalValue(KeptPrecision):
    """V(x) = min_j [cost of following trajectory j from its state nearest to x, for ``lookahead`` steps,
    + V_j at the end],  V_j(y) = v_j + g_j'd + d'H_j d / 2,  d = y - x_j.

    The memory keeps a model at every state of a library of optimal trajectories: value v, gradient g,
    curvature H, control and feedback. The nearest of them to x are candidates, and so is the linear feedback
    of the goal. Each is followed from x by its own feedback, within the bounds, and pays what the plant then
    costs; the model where it ends adds the rest. The control is the first one of the best candidate: nothing
    is optimised at run time. One that ends further than 0.3 of the region from what it follows is worth the
    largest remembered value more.

    The nearest have the least d'Gd, d the shorter way around, G the mean of |H_j|: far is what costs. By
    distances in units of the region a cart-pole needs a thousand candidates in place of 64.

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> x0 = torch.tensor([[1.0, 0.0], [-1.0, 0.0]]).double()
        >>> library = adp.BoxDDP(problem, steps=80, compile=False).solve(x0)
        >>> memory = adp.GlobalValue(problem, library, region=[1.5, 1.0])
        >>> memory(torch.tensor([[0.9, 0.0]]).double()).shape  # u, (B, m)
        torch.Size([1, 1])

        Shown by `staf_torch/adp/README.md`.

    Args:
        problem: plant, cost and bounds in steps.
        library: trajectories with their models, as `BoxDDP.solve` returns them. Those that do not arrive at
            the goal are left out.
        region: half the width of the box of states, (n,), positive.
        candidates: followed from every state, at least 1.
        lookahead: steps, at least 1.
        spacing: least distance between two models of one trajectory that are searched, positive.

    Raises:
        ValueError: if an argument breaks its rule, or no trajectory arrives.

    Source: Atkeson, "Using local trajectory optimizers to speed up global optimization in dynamic
    programming", NIPS 6 (1993), for libraries of trajectories with local models; the memory as the paper's
    conclusion names it. `staf_torch.online.ExperienceMemory` blends models; here a minimum is wanted, as
    two ways around an obstacle of the value must not be averaged.
    """

    def __init__(
        self,
        problem: SampledProblem,
        library: Trajectories,
        region: Sequence[float] | Tensor,
        *,
        candidates: int = 48,
        lookahead: int = 60,
        spacing: float = 0.02,
    ) -> None:
        super().__init__()
        check_memorable("GlobalValue", problem)
        self.problem, self.library = problem, library
        width = half_widths("GlobalValue", region, problem.dim)
        self.lookahead = integer("GlobalValue", "lookahead", lookahead, least=1)
        self.spacing = positive_real("GlobalValue", "spacing", spacing)
        self.region = hold(self, "region", width)
        arrives = library.value[:, -1] <= _ARRIVED * library.cost + 1e-9
        self.arrives = arrives & torch.isfinite(library.cost)
        if not bool(self.arrives.any()):
            raise fail("GlobalValue", "library", "must have a trajectory that arrives at the goal", None)
        self.length = library.control.shape[1] + lookahead + 1  # rows of a trajectory in the tables
        self.plans = hold(self, "plans", self._plans())  # (state, control, feedback), (N length, n + m + m n)
        self.models = hold(self, "models", self._models())  # (state, v, g, H), (N length, n + 1 + n + n n)
        self.entries = hold(self, "entries", self._searched())  # rows that are searched, (J,)
        self.candidates = min(integer("GlobalValue", "candidates", candidates, least=1), len(self.entries))
        self.frame = hold(self, "frame", self._frame())  # F with F F' = G, (n, n)
        self._said = False  # that states are not covered
        self._judge = Program(self._judged, name="a global value", copies=1)
        self._ready()

    def _ready(self) -> None:
        """Make what is not a tensor: the search tree."""
        from scipy.spatial import cKDTree  # a third of a second that no other import need pay

        n, h = self.problem.dim, self.lookahead
        images = self.images()
        self._rows = self.entries.cpu().repeat(len(images) // len(self.entries))
        self._tree = cKDTree(images.cpu().numpy())
        self._windows = self._seen_windows()
        # Where every trajectory rests at the goal, under the linear feedback.
        self.resting = int(self.arrives.nonzero()[0]) * self.length + self.length - h - 1
        self.worst = float(self.models[self.entries, n].max())

    def _seen_windows(self) -> Tensor:
        """A window of plans from every row on, (N length - h + 1, h, w), a view."""
        return self.plans.unfold(0, self.lookahead, 1).mT

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the windows, too."""
        moved: Self = super()._apply(fn, recurse)
        moved._windows = moved._seen_windows()
        return moved

    def __getstate__(self) -> dict[str, Any]:
        dropped = dict.fromkeys(("_tree", "_windows", "_rows"))
        return {**vars(self), **dropped}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._ready()

    @where_held("GlobalValue", _held)
    @without_gradient("GlobalValue", "x")
    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        trailing("GlobalValue", "x", x, 1, self.problem.dim, meta=False)
        if x.dtype != self.plans.dtype:
            return self.forward(x.to(self.plans.dtype)).to(x.dtype)
        rows = x if x.dim() == 2 else x.reshape(-1, x.shape[-1])
        if len(rows) == 1:
            entries = self.nearest(rows)[0]
            cost, control, covered = self._followed(rows.expand(self.candidates + 1, -1), entries)
            best = int(cost.cpu().numpy().argmin())
            u, known = control[best], covered[best]
        else:
            found = self.choose(rows)
            u, known = found.control, found.covered
        if not self._said and not bool(known.all()):
            self._said = True
            _log.warning(
                "GlobalValue: from %d of %d states no remembered plan leads to where it is known; the "
                "control is that of the one that comes nearest, `value` is inf there. This is said once.",
                *(int((~known).sum()), len(rows)),
            )
        return u if x.dim() == 2 else u.reshape(*x.shape[:-1], u.shape[-1])

    @where_held("GlobalValue", _held)
    def value(self, x: Tensor) -> Tensor:
        """V(x), inf where no plan covers x: (..., n) -> (...)."""
        trailing("GlobalValue.value", "x", x, 1, self.problem.dim, meta=False)
        found = self.choose(x.reshape(-1, x.shape[-1]).to(self.plans.dtype))
        return torch.where(found.covered, found.value, torch.inf).reshape(x.shape[:-1]).to(x.dtype)

    @where_held("GlobalValue", _held)
    def gradient(self, x: Tensor) -> Tensor:
        """g_j + H_j d of the model that the best candidate starts at: (..., n) -> (..., n)."""
        trailing("GlobalValue.gradient", "x", x, 1, self.problem.dim, meta=False)
        rows = x.reshape(-1, x.shape[-1]).to(self.plans.dtype)
        return self.model(rows).slope(self.problem, rows).reshape(x.shape).to(x.dtype)

    @where_held("GlobalValue", _held)
    def model(self, x: Tensor) -> LocalModel:
        """The remembered model that the best candidate starts from, at every state: (B, n)."""
        entry, n = self.choose(x).entry, self.problem.dim
        state, value, gradient, curvature = self.models[entry].split((n, 1, n, n * n), dim=-1)
        return LocalModel(state, value.squeeze(-1), gradient, curvature.unflatten(-1, (n, n)))

    @where_held("GlobalValue", _held)
    def bellman_residual(self, x: Tensor) -> Tensor:
        """(min_u [l(x, u) + V(F(x, u))] - V(x)) / V(x) over the policy's u and the corners of the bounds, x
        (B, n), not the goal.

        Near 0 where the memory knows the optimum; negative where one step of dynamic programming would
        improve V, and so V is too high at x or too low after it.
        """
        found = self.choose(x)
        best = torch.full_like(found.value, torch.inf)
        for u in (found.control, *self.problem.levels().unsqueeze(1)):
            after, paid = self.problem.advance(x, u.expand(len(x), -1))
            best = torch.minimum(best, paid + self.value(after))
        return (best - found.value) / found.value

    @where_held("GlobalValue", _held)
    @without_gradient("GlobalValue", "x")
    def choose(self, x: Tensor, without: Tensor | None = None) -> Choice:
        """Return the best candidate at every state x (B, n); models of the trajectory ``without`` (B,)
        int64 are none."""
        entries = self.nearest(x, without)
        cost, control, covered = self.follow(x, entries)
        value, at = cost.min(1, keepdim=True)
        u = control.gather(1, at.unsqueeze(-1).expand(-1, -1, control.shape[-1])).squeeze(1)
        return Choice(u, value.squeeze(1), entries.gather(1, at).squeeze(1), covered.gather(1, at).squeeze(1))

    def nearest(self, x: Tensor, without: Tensor | None = None) -> Tensor:
        """Rows of the memory nearest to x (B, n), and last the resting one: (B, K + 1) int64."""
        count = self.candidates if without is None else min(4 * self.candidates, len(self._rows))
        seen = self.seen(x).cpu().numpy()  # the tree is the processor's
        if not np.isfinite(seen).all():
            seen = np.where(np.isfinite(seen), seen, 0.0)  # such a row finds no value, the others theirs
        at = self._tree.query(seen, count)[1].reshape(len(x), count)
        rows = self._rows.numpy()[at]
        if without is not None:
            own = rows // self.length == without.cpu().numpy()[:, None]
            rows = np.take_along_axis(rows, own.argsort(axis=1, kind="stable"), axis=1)[:, : self.candidates]
        whole = np.empty((len(rows), rows.shape[1] + 1), dtype=np.int64)
        whole[:, :-1], whole[:, -1] = rows, self.resting
        return torch.from_numpy(whole).to(x.device)

    def follow(self, x: Tensor, entries: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (B, K), first control (B, K, m) and arrival (B, K) of candidates (B, K) at x (B, n)."""
        step = max(1, _TOGETHER // (count := entries.shape[1]))
        parts = [
            self._followed(rows.repeat_interleave(count, 0), which.reshape(-1))
            for rows, which in zip(x.split(step), entries.split(step), strict=True)
        ]
        cost, control, covered = (torch.cat(part) for part in zip(*parts, strict=True))
        shape = entries.shape
        return cost.view(shape), control.view(*shape, control.shape[-1]), covered.view(shape)

    def _followed(self, x: Tensor, entries: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (C, 1), first control (C, 1, m) and arrival (C, 1) of one candidate a row: (C, n), (C,)."""
        ends = self.models.index_select(0, entries + self.lookahead)
        found: tuple[Tensor, Tensor, Tensor]
        _, found = self._judge((), (), (x, self._windows.index_select(0, entries), ends), steps=1)
        return found

    def _judged(
        self, carry: tuple[()], now: tuple[()], row: tuple[Tensor, Tensor, Tensor]
    ) -> tuple[tuple[()], tuple[Tensor, Tensor, Tensor]]:
        """Follow candidates, as a step of a program."""
        return carry, follow_plan(self.problem, self.region, self.worst, *row)

    @where_held("GlobalValue", _held)
    def replay(self, x: Tensor, entries: Tensor, steps: int) -> tuple[Tensor, Reference]:
        """Return the stored control (B, T, m) to follow from x (B, n), of rows of the memory (B,), and
        what it is a feedback around, turned by whole periods to where x is."""
        time = entries % self.length
        ahead = (time.unsqueeze(1) + torch.arange(steps, device=x.device)).clamp(max=self.length - 1)
        state, control, feedback = unpacked(self.problem, self.plans[(entries - time).unsqueeze(1) + ahead])
        shift = x - self.problem.offset(x, state[:, 0]) - state[:, 0]
        return control, Reference(state + shift.unsqueeze(1), feedback)

    def seen(self, x: Tensor) -> Tensor:
        """Coordinates F'(x - goal) of the search, whose squares add up to d'Gd: (..., n) -> (..., n)."""
        return self.problem.offset(x, self.problem.goal) @ self.frame

    def images(self) -> Tensor:
        """The J states that are searched, as `seen`, and for p periodic coordinates their images a turn away,
        which are near to what is near across half a turn: (2^p J, n)."""
        offset = self.problem.offset(self.plans[self.entries, : self.problem.dim], self.problem.goal)
        for i in self.problem.periodic:
            image = offset.clone()
            image[:, i] += torch.where(offset[:, i] > 0, -2 * torch.pi, 2 * torch.pi)
            offset = torch.cat((offset, image))
        return offset @ self.frame

    def _frame(self) -> Tensor:
        """F of the metric G = F F', (n, n)."""
        n = self.problem.dim
        curvature = self.models[self.entries, 1 + n + n :].unflatten(-1, (n, n))
        along, axes = torch.linalg.eigh(self.region.unsqueeze(-1) * curvature * self.region)
        metric = ((axes * along.abs().unsqueeze(-2)) @ axes.mT).mean(0)
        metric = metric + _ROUND * metric.diagonal().mean() * torch.eye(
            n, dtype=torch.float64, device=metric.device
        )
        frame: Tensor = torch.linalg.cholesky(metric / self.region / self.region.unsqueeze(-1))
        return frame

    def _plans(self) -> Tensor:
        """Table of plans: the library, and then the goal under its linear feedback."""
        library, hold = self.library, resting(self.problem, self._goals()).unsqueeze(1)
        steps = packed(library.state[:, :-1], library.control, library.feedback)
        return torch.cat((steps, hold.expand(-1, self.lookahead + 1, -1)), dim=1).flatten(0, 1)

    def _models(self) -> Tensor:
        """Table of values: along the library, and then at the goal."""
        library, count, n = self.library, len(self.library.state), self.problem.dim
        parts = library.state, library.value.unsqueeze(-1), library.gradient, library.curvature.flatten(2)
        linear = torch.cat((self.problem.p.new_zeros(1 + n), 2 * self.problem.p.flatten()))
        ends = torch.cat((self._goals(), linear.expand(count, -1)), dim=-1).unsqueeze(1)
        ends = ends.expand(-1, self.lookahead + 1, -1)
        return torch.cat((torch.cat(parts, dim=-1)[:, :-1], ends), dim=1).flatten(0, 1)

    def _goals(self) -> Tensor:
        """The goal nearest to the end of each trajectory, (N, n)."""
        last = self.library.state[:, -1]
        return last - self.problem.offset(last, self.problem.goal)

    def _searched(self) -> Tensor:
        """Rows that are candidates: those of trajectories that arrive, ``spacing`` apart along each."""
        state = self.library.state[:, :-1]
        last, keep = state[:, 0], [self.arrives]
        for now in state.unbind(1)[1:]:
            far = (self.problem.offset(now, last) / self.region).square().sum(-1) >= self.spacing**2
            last = torch.where(far.unsqueeze(-1), now, last)
            keep.append(far & self.arrives)
        which, time = torch.stack(keep, dim=1).nonzero(as_tuple=True)
        return which * self.length + time


def follow_plan(
    problem: SampledProblem,
    region: Tensor,  # half the width of the box of states, (n,)
    worst: float,  # the largest value that is remembered, added where the plan is lost
    x: Tensor,
    window: Tensor,  # state, control and feedback of H steps, (B, H, n + m + m n)
    end: Tensor,  # state, value, gradient and curvature after them, (B, n + 1 + n + n n)
) -> tuple[Tensor, Tensor, Tensor]:
    """Return cost (B,), first control (B, m) and arrival (B,) bool of following a plan from x (B, n), a
    row each."""
    n = problem.dim

    def step(now: tuple[Tensor, Tensor], plan: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[()]]:
        after, paid = problem.advance(now[0], around(problem, now[0], plan))
        return (after, now[1] + paid), ()

    first = window[:, 0]
    x = first[:, :n] + problem.offset(x, first[:, :n])
    (last, paid), _ = scan(step, (x, torch.zeros_like(x[:, 0])), window)
    state, value, gradient, curvature = end.split((n, 1, n, n * n), dim=-1)
    d = problem.offset(last, state)
    bent = (curvature.unflatten(-1, (n, n)) * d.unsqueeze(-2)).sum(-1)
    rest = value.squeeze(-1) + ((gradient + 0.5 * bent) * d).sum(-1)
    far = (d / region).square().sum(-1)
    covered = (far < _REACH**2) & torch.isfinite(paid)
    lost = paid + value.squeeze(-1) + worst * (1 + far)
    cost = torch.where(covered, paid + rest, lost)
    return torch.where(torch.isfinite(cost), cost, torch.inf), around(problem, x, first), covered
