"""Box-constrained differential dynamic programming: optimal trajectories of many initial states at once."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes import Program
from ..numerics.box import minimum_and_slopes
from ..numerics.checks import fail, integer, positive_real, trailing
from ..numerics.riccati import riccati_step
from .plans import LocalModel, Plan, Reference, Trajectories
from .sampled_problem import Derivatives, SampledProblem

LENGTHS = (1.0, 0.5, 0.2, 0.07, 0.02)  # shares of a step that are tried side by side
EASIER, HARDER = 0.4, 8.0  # what success and failure do to the regularisation of a row
# Of the regularisation, in units of the cost's curvature in u:
LEAST, FIRST, TRUSTED, MOST = 1e-9, 1e-3, 1.0, 1e9
_NUMBERS = 2**25  # second derivatives that are held at once


class BoxDDP:
    """min sum_{k<T} l(x_k, u_k) + V_T(x_T) over bounded controls, from every state of a batch.

    Backward in time, the quadratic model of l + V(F) around the trajectory is minimised over the box of
    controls, which gives a change of the control and a feedback (0 at a bound); forward, five lengths of the
    change are tried, each with the feedback, and a row takes the best that lowers its cost. A row that finds
    none is regularised more, and changes between the full second derivatives and those of Gauss and Newton.

    The minimum is a local one. No row sees another.

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> found = adp.BoxDDP(problem, steps=20, compile=False).solve(torch.tensor([[1.0, 0.0]]).double())
        >>> bool(found.converged.all()), float(found.control.abs().max()) <= 1
        (True, True)

        Shown by `staf_torch/adp/README.md`.

    Args:
        problem: plant, cost and bounds in steps.
        steps: T.
        iterations: at most.
        tolerance: relative change of the cost at which a row has converged, positive.
        compile: whether `lanes` compiles the passes: some seconds of a C++ compiler for a plant that is new
            to its cache, and a hundred times faster then.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA (2014).
    """

    def __init__(
        self,
        problem: SampledProblem,
        *,
        steps: int,
        iterations: int = 60,
        tolerance: float = 1e-7,
        compile: bool = True,
    ) -> None:
        self.problem = problem
        self.steps = integer("BoxDDP", "steps", steps, least=1)
        self.iterations = integer("BoxDDP", "iterations", iterations, least=1)
        self.tolerance = positive_real("BoxDDP", "tolerance", tolerance)
        self._expand = Program(
            lambda carry, now, row: (carry, tuple(problem.derivatives(*row))),
            name="derivatives of a step",
            compile=compile,
        )
        self._back = Program(self.backward, name="a backward pass", compile=compile)
        self._forth = Program(self.forward, name="a forward pass", compile=compile)

    def solve(
        self,
        x0: Tensor,
        control: Tensor | None = None,
        reference: Reference | None = None,
        terminal: LocalModel | None = None,
    ) -> Trajectories:
        """The trajectories from x0 that the search reaches from a first control.

        Args:
            x0: (B, n).
            control: (B, T, m), used as it is, or around ``reference``; None for the goal's linear feedback.
            reference: states and feedback that the first control goes with; none for open loop.
            terminal: V_T, a model a row; None for the value of the goal's linear feedback.

        Raises:
            ValueError: if a shape is wrong.
        """
        n, m = self.problem.dim, self.problem.inputs
        if trailing("BoxDDP.solve", "x0", x0, 2, n).dim() != 2:
            raise fail("BoxDDP.solve", "x0", f"must have the shape (B, {n})", tuple(x0.shape))
        expected = (len(x0), self.steps, m)
        if control is None:
            gains = (-self.problem.k).expand(*expected, n)
            reference = Reference(self.problem.goals(x0, self.steps)[:, :-1], gains)
            control = self.problem.rest.expand(expected)
        if control.shape != expected:
            raise ValueError(
                f"`BoxDDP.solve(control=...)` must have the shape {expected}; got {tuple(control.shape)}."
            )
        if reference is None:
            still = x0.unsqueeze(1).expand(-1, self.steps, -1)
            reference = Reference(still, x0.new_zeros(*expected, n))
        if terminal is None:
            terminal = self.ends(x0)
        together = max(1, _NUMBERS // (self.steps * (n + 1) * (n + m) ** 2))
        with torch.no_grad():
            whole = x0, self.problem.admissible(control), *reference, *terminal
            parts = [
                self._solve(x, u, Reference(*around[:2]), LocalModel(*around[2:]))
                for x, u, *around in zip(*(part.split(together) for part in whole), strict=True)
            ]
        return Trajectories(*(torch.cat(column) for column in zip(*parts, strict=True)))

    def ends(self, x0: Tensor) -> LocalModel:
        """V_T of plans from x0 (B, n): the value of the goal's linear feedback, or what the problem pays."""
        none, bent = torch.zeros_like(x0), (2 * self.problem.end).expand(*x0.shape, x0.shape[-1])
        goal = self.problem.goal.expand_as(x0)
        if self.problem.path is not None:
            goal = self.problem.goals(x0, self.steps)[:, -1]
        return LocalModel(goal, none[:, 0], none, bent)

    def _solve(self, x0: Tensor, control: Tensor, reference: Reference, terminal: LocalModel) -> Trajectories:
        none, lengths = torch.zeros_like(control), x0.new_ones(1)
        whole = self._rollouts(x0, reference.state, control, none, reference.feedback, lengths, terminal)
        mu, full = torch.full_like(whole.cost, FIRST), torch.ones_like(whole.cost)
        converged = torch.zeros(len(x0), dtype=torch.bool)
        active = torch.isfinite(whole.cost).nonzero().squeeze(1)
        now, known, ends = whole.rows(active), None, terminal.rows(active)
        for _ in range(self.iterations):
            if not len(active):
                break
            known = self._derivatives(now) if known is None else known
            found = self._search(now, known, mu[active], full[active], ends)
            better = found.cost < now.cost
            gain = (now.cost - found.cost) / now.cost.abs().clamp(min=1e-300)
            now = _chosen(better, found.plan, now)
            for part, current in zip(whole, now, strict=True):
                part[active] = current
            small = found.promised.abs() <= self.tolerance * now.cost.abs()
            done = (better & (gain <= self.tolerance)) | (found.definite & small)
            done = done & (mu[active] <= TRUSTED)
            converged[active] = done
            easier = (mu[active] * EASIER).clamp(min=LEAST)
            mu[active] = torch.where(better, easier, mu[active] * HARDER)
            full[active] = torch.where(better, full[active], 1 - full[active])
            on = ~done & (mu[active] <= MOST)
            kept = active[on]
            known = Derivatives(*(part[on] for part in known))
            fresh = better[on]
            now, ends = now.rows(on), ends.rows(on)
            if bool(fresh.any()):  # saves work: rows that did not move keep their derivatives
                new = self._derivatives(now.rows(fresh))
                for old, fresher in zip(known, new, strict=True):
                    old[fresh] = fresher
            active = kept
        return self._models(whole, converged, terminal)

    def _rollouts(
        self,
        x0: Tensor,
        state: Tensor,
        control: Tensor,
        change: Tensor,
        feedback: Tensor,
        lengths: Tensor,
        terminal: LocalModel,
    ) -> Plan:
        """The best of u = control + length change + feedback (x - state) within the bounds."""
        shares = lengths.expand(len(x0), -1).contiguous()
        start = x0.unsqueeze(1).expand(-1, len(lengths), -1).contiguous()
        end, (x, u, paid) = self._forth(start, (state, control, change, feedback), shares)
        last = terminal.at(self.problem, end)  # (B, L)
        cost = paid.sum(1) + last
        cost = torch.where(torch.isfinite(cost), cost, torch.inf)
        best, at = cost.min(1)
        pick = at[:, None, None, None]
        states = torch.cat((x, end.unsqueeze(1)), dim=1)
        return Plan(
            states.gather(2, pick.expand(-1, self.steps + 1, 1, x.shape[-1])).squeeze(2),
            u.gather(2, pick.expand(-1, self.steps, 1, u.shape[-1])).squeeze(2),
            best,
            torch.cat((paid, last.unsqueeze(1)), dim=1)
            .gather(2, at[:, None, None].expand(-1, self.steps + 1, 1))
            .squeeze(2),
        )

    def forward(
        self, x: Tensor, now: tuple[Tensor, ...], lengths: Tensor
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """One step of all lengths: x (B, L, n), (B, n), (B, m), (B, m), (B, m, n), (B, L)."""
        state, control, change, feedback = now
        apart = x - state.unsqueeze(1)
        u = control.unsqueeze(1) + lengths.unsqueeze(-1) * change.unsqueeze(1)
        u = u + (feedback.unsqueeze(1) * apart.unsqueeze(-2)).sum(-1)
        u = self.problem.admissible(u)
        after, paid = self.problem.advance(x, u)
        return after, (x, u, paid)

    def _derivatives(self, plan: Plan) -> Derivatives:
        """Along the trajectories: (B, T, ...)."""
        x, u = plan.state[:, :-1].flatten(0, 1), plan.control.flatten(0, 1)
        _, found = self._expand((), (), (x, u), steps=1)
        shape = plan.control.shape[:2]
        return Derivatives(*(part[:, 0].unflatten(0, shape) for part in found))

    def _search(
        self, plan: Plan, known: Derivatives, mu: Tensor, full: Tensor, terminal: LocalModel
    ) -> Found:
        """A backward pass and the best of the five lengths forward."""
        end, (change, feedback, _, _) = self._backwards(plan, known, mu, full, terminal)
        definite = end.definite > 0
        lengths = plan.cost.new_tensor(LENGTHS)
        x, u = plan.state, plan.control
        tried = self._rollouts(x[:, 0], x[:, :-1], u, change, feedback, lengths, terminal)
        cost = torch.where(definite, tried.cost, torch.inf)
        return Found(tried, cost, end.promised, definite)

    def _backwards(
        self, plan: Plan, known: Derivatives, mu: Tensor, full: Tensor, terminal: LocalModel
    ) -> tuple[Model, tuple[Tensor, ...]]:
        slope, bent = terminal.slope(self.problem, plan.state[:, -1]), terminal.curvature.contiguous()
        last = Model(slope, bent, torch.zeros_like(mu), torch.ones_like(mu))
        reverse = tuple(part.flip(1) for part in (*known, plan.control))
        end, out = self._back(last, reverse, (mu, full))
        return end, tuple(part.flip(1) for part in out)

    def backward(
        self, after: Model, now: tuple[Tensor, ...], row: tuple[Tensor, Tensor]
    ) -> tuple[Model, tuple[Tensor, ...]]:
        """One step of the recursion, backward in time."""
        (first, second, cost_first, cost_second, control), (mu, full) = now, row
        n = self.problem.dim
        bent = (after.gradient[..., None, None] * second).sum(-3)
        scale = cost_second[:, n:, n:].diagonal(dim1=-2, dim2=-1).abs().mean(-1)
        firmness = (mu * scale)[:, None, None] * torch.eye(control.shape[-1], dtype=control.dtype)
        low, high = self.problem.bounds.low - control, self.problem.bounds.high - control
        definite = after.definite

        def minimum(slope: Tensor, cross: Tensor, hessian: Tensor) -> tuple[Tensor, Tensor]:
            nonlocal definite
            firm = hessian + firmness
            definite = definite * _definite(firm)
            return minimum_and_slopes(firm, slope, cross, low, high)

        curved = cost_second + full[:, None, None] * bent
        found = riccati_step(after.gradient, after.curvature, first, cost_first, curved, minimum)
        gradient, curvature, promised, change, feedback = found
        model = Model(gradient, curvature, after.promised + promised, definite)
        return model, (change, feedback, gradient, curvature)

    def _models(self, plan: Plan, converged: Tensor, terminal: LocalModel) -> Trajectories:
        """The local models along finished trajectories, with as little regularisation as they bear."""
        known = self._derivatives(plan)
        small = torch.full_like(plan.cost, LEAST)
        end, out = self._backwards(plan, known, small, torch.ones_like(small), terminal)
        _, gauss = self._backwards(plan, known, small, torch.zeros_like(small), terminal)
        fine = (end.definite > 0) & torch.isfinite(end.curvature).flatten(1).all(-1)
        _, feedback, gradient, curvature = (
            torch.where(fine[(..., *([None] * (a.dim() - 1)))], a, b) for a, b in zip(out, gauss, strict=True)
        )
        last = terminal.slope(self.problem, plan.state[:, -1])
        return Trajectories(
            plan.state,
            plan.control,
            feedback,
            plan.paid.flip(1).cumsum(1).flip(1),
            torch.cat((gradient, last.unsqueeze(1)), dim=1),
            torch.cat((curvature, terminal.curvature.unsqueeze(1)), dim=1),
            converged & torch.isfinite(plan.cost),
        )


Known = tuple[Tensor, ...]
"""The fields of `Derivatives`, (B, T, ...)."""


class Found(NamedTuple):
    """What one iteration found."""

    plan: Plan
    cost: Tensor  # (B,); inf where the model was not definite
    promised: Tensor  # change of the cost by the model, (B,), negative
    definite: Tensor  # (B,) bool


class Model(NamedTuple):
    """Local model of the value at one time, and what the recursion adds up."""

    gradient: Tensor  # (B, n)
    curvature: Tensor  # (B, n, n)
    promised: Tensor  # (B,)
    definite: Tensor  # (B,) 1 or 0


def _definite(a: Tensor) -> Tensor:
    """1 where all pivots of (B, m, m) are positive, else 0."""
    fine = torch.ones_like(a[..., 0, 0])
    for _ in range(a.shape[-1]):
        pivot = a[..., 0, 0]
        fine = fine * (pivot > 0)
        a = a[..., 1:, 1:] - a[..., 1:, :1] * a[..., :1, 1:] / pivot[..., None, None]
    return fine


def _chosen(better: Tensor, new: Plan, old: Plan) -> Plan:
    return Plan(
        *(torch.where(better[(..., *([None] * (a.dim() - 1)))], a, b) for a, b in zip(new, old, strict=True))
    )
