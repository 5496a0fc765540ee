"""Sets that must not be entered, in the cost: the penalty of the avoidance papers and a log barrier."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from ...lanes.per_row.objects import made_by_rows
from ...lanes.row_numbers import all_rows, over_rows, points_of_rows
from ...numerics.checks import choice, fail, hold, integer, object_of, positive_real
from ...numerics.linalg import Matrix
from ...numerics.rows import check_rows
from ...signs import Sign
from ...systems import Plant
from ..problem.cost import QuadraticCost
from ..problem.rules import check_objects, state_of
from ..problem.sampled import SampledProblem
from .ddp import BoxDDP
from .trajectories import Reference, Trajectories, chosen, rows_of

Obstacle = Callable[[Tensor], Tensor]
"""h(x), at least 0 outside: (..., n) -> (...)."""
_EDGE = 0.01  # of the reach, below which the rate goes on as its second-order expansion: finite inside too;
# times the root of the share to which a weight shrinks, so that the slope there stays steep


class AvoidanceCost(QuadraticCost):
    """x'Qx + u'Ru + weight sum_i P(h_i(x) / reach), with P(q) = 0 for q >= 1 and else

        P(q) = (1/q - 1)^2 (``penalty``)  or  P(q) = log(q)^2 (``log``).

    With h = |x - z|^2 - r_a^2 and reach = r_d^2 - r_a^2 the first is the penalty of the avoidance papers,
    ( min{0, (|x - z|^2 - r_d^2) / (|x - z|^2 - r_a^2)} )^2, r_a and r_d the radii of avoidance and
    detection. Both grow beyond all bounds towards the edge, up to 1 % of the reach, from where they go on as
    a parabola: a search may begin with a collision. Nothing keeps a policy out but what it costs.

    Example:
        >>> cost = adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, obstacles=lambda x: x[..., 0] + 1, reach=0.5)
        >>> cost.state_rate(torch.tensor([[0.0, 0.0], [-0.75, 0.0]]).double())  # (2 - 1)^2 at half the reach
        tensor([0.0000, 1.5625], dtype=torch.float64)

        Shown by `staf_torch/adp/README.md`.

    Args:
        obstacles: h, or a list of them.
        reach: in units of h, positive: nothing is paid from there on. The set-point must be that far away.
        weight: positive.
        kind: ``penalty`` or ``log``.
        state, control, dim, inputs: as in `QuadraticCost`, and so is what else is given by name.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Deptula, Chen, Licitra, Rosenfeld, Dixon, IEEE T-RO 36 (2020).
    """

    rowwise: ClassVar = {"penalty": (0,), "outside": (1,)}

    def __init__(
        self,
        state: Matrix,
        control: Matrix,
        dim: int,
        inputs: int,
        *,
        obstacles: Obstacle | Sequence[Obstacle],
        reach: float,
        weight: float = 1.0,
        kind: str = "penalty",
        **more: object,
    ) -> None:
        super().__init__(state, control, dim, inputs, **more)  # type: ignore[arg-type]
        self.obstacles = [obstacles] if callable(obstacles) else list(obstacles)
        if not self.obstacles or not all(map(callable, self.obstacles)):
            raise fail("AvoidanceCost", "obstacles", "must be h(x) or a list of them", obstacles)
        for k, h in enumerate(self.obstacles):
            what = f"AvoidanceCost(obstacles=...)` number {k} `h(x)"
            check_rows(what, h, [state_of(self)], sizes=(inputs, len(self.obstacles)))
        self.reach = positive_real("AvoidanceCost", "reach", reach)
        self.kind = choice("AvoidanceCost", "kind", kind, ("penalty", "log"))
        heavy = positive_real("AvoidanceCost", "weight", weight)
        self.weight = hold(self, "weight", self.q.new_tensor(heavy))
        self.edge = hold(self, "edge", self.q.new_tensor(_EDGE))

    def state_rate(self, x: Tensor) -> Tensor:
        """e'Qe and what the obstacles add: (..., n) -> (...)."""
        paid = super().state_rate(x)
        for h in self.obstacles:
            paid = paid + self.weight.to(x) * self.penalty(h(x))
        return paid

    def penalty(self, h: Tensor) -> Tensor:
        """P(h / reach)."""
        q = h / self.reach
        edge = self.edge.to(h)
        near = torch.where(q < edge, edge, torch.where(q > 1, 1.0, q))
        if self.kind == "log":
            log = near.log()
            value, slope, bend = log.square(), 2 * log / near, 2 * (1 - log) / near.square()
        else:
            value, slope = (1 / near - 1).square(), 2 * (near - 1) / near**3
            bend = (6 - 4 * near) / near**4
        beyond = q - edge
        return torch.where(q < edge, value + slope * beyond + 0.5 * bend * beyond.square(), value)

    def outside(self, x: Tensor) -> Tensor:
        """The smallest h over the obstacles: (..., n) -> (...)."""
        return torch.stack([h(x) for h in self.obstacles], dim=-1).amin(-1)


class AvoidancePlans(NamedTuple):
    """Plans around obstacles."""

    trajectories: Trajectories  # a row a start
    cost: Tensor  # (B,) of x'Qx + u'Ru alone; inf where every plan touches an obstacle
    margin: Tensor  # (B,) the smallest h at the times of the plan

    def or_cheaper(self, other: AvoidancePlans) -> AvoidancePlans:
        """The cheaper plan of every row; of two that touch an obstacle the other one."""
        kept = self.cost < other.cost
        trajectories = chosen(kept, self.trajectories, other.trajectories)
        return AvoidancePlans(trajectories, *chosen(kept, self[1:], other[1:]))


@Sign("plan_around")
def plan_around(
    plant: Plant,
    cost: AvoidanceCost,
    x0: Tensor,
    *,
    dt: float,
    steps: int,
    shrink: Sequence[float] = (1.0, 0.1, 0.01, 1e-3, 1e-4),
    iterations: int = 40,
    compile: bool = True,
) -> AvoidancePlans:
    """Optimal plans that keep out of the obstacles, by an interior path: `BoxDDP` with weights that shrink.

    Each start is tried from the goal's linear feedback with every combination of bounds held for a quarter of
    the time, so that both ways around an obstacle are among the guesses; the cheapest plan of any guess and
    weight that keeps h >= 0 at all of its times is the result: with a small weight a plan may dip into an
    obstacle by a hair. Nothing is chosen by the start.

    Example:
        >>> plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> slow = {"obstacles": lambda x: x[..., 1] + 0.4, "reach": 0.3, "kind": "log"}
        >>> cost = adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, low=-1.0, high=1.0, **slow)
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> few = {"steps": 6, "shrink": [1.0], "iterations": 3, "compile": False}
        >>> found = adp.plan_around(plant, cost, x0, dt=0.3, **few)
        >>> found.trajectories.state.shape, bool(found.margin > 0)
        (torch.Size([1, 7, 2]), True)

        Shown by `staf_torch/adp/README.md`.

    Args:
        plant: as in `SampledProblem.of`.
        cost: with the obstacles, its weight the first one; bounds in the cost or the plant.
        x0: (B, n).
        dt: s.
        steps: of the plan; the value of the goal's linear feedback stands at its end.
        shrink: shares of the weight, one after the other.
        iterations: of each, at most.
        compile: as in `BoxDDP`.

    Raises:
        ValueError: if an argument breaks its rule.
    """
    check_objects("plan_around", plant=plant, cost=cost)
    object_of("plan_around", AvoidanceCost, cost=cost)
    integer("plan_around", "steps", steps, least=4)
    if not len(shrink):
        raise fail("plan_around", "shrink", "must have at least one share", shrink)
    cost = copy.deepcopy(cost)  # its weight is going to change
    weight = all_rows(cost.weight)
    first = weight.clone()
    free = QuadraticCost(cost.q, cost.r, cost.dim, cost.inputs)
    problem = SampledProblem.of(plant, cost, dt=dt)
    ways = made_by_rows(problem.levels)
    count, pushed = len(ways), torch.arange(steps, device=x0.device) < steps // 4

    def guesses(x: Tensor) -> tuple[Tensor, ...]:
        away = torch.where(pushed[:, None], (ways - problem.rest).unsqueeze(1), 0.0)
        many = len(x), count, steps
        goal, gains = problem.goal.expand(*many, -1), (-problem.k).expand(*many, -1, -1)
        return (problem.rest + away).expand(*many, -1), goal, gains

    rows = x0.repeat_interleave(count, dim=0)
    control, *along = (part.flatten(0, 1) for part in over_rows(guesses, x0))
    around = Reference(*along)
    bare = SampledProblem.of(plant, free, dt=dt, low=problem.bounds.low, high=problem.bounds.high)
    best: AvoidancePlans | None = None
    with points_of_rows(len(x0), count):
        for share in shrink:
            weight.copy_(first * positive_real("plan_around", "shrink", share))
            cost.edge.fill_(_EDGE * math.sqrt(share))
            search = BoxDDP(problem, steps=steps, iterations=iterations, compile=compile)
            found = search.solve(rows, control, around)
            control, around = found.control, Reference(found.state[:, :-1], found.feedback)
            _, paid = bare.advance(found.state[:, :-1], found.control)
            total = paid.sum(1) + bare.terminal(found.state[:, -1])
            margin = cost.outside(found.state).amin(-1)
            total = torch.where((margin >= 0) & torch.isfinite(total), total, torch.inf)
            now = AvoidancePlans(found, total, margin)
            best = now if best is None else best.or_cheaper(now)
    assert best is not None
    chosen = best.cost.reshape(len(x0), -1).argmin(-1) + torch.arange(len(x0), device=x0.device) * count
    return AvoidancePlans(rows_of(best.trajectories, chosen), best.cost[chosen], best.margin[chosen])
