"""The iterations of `BoxDDP` as a program of one row, without a Python branch: what a compiled loop or a C
header runs. The plan is the one that the search in plain torch finds in as many iterations."""

from __future__ import annotations

import torch
from torch import Tensor

from ..lanes import repeat, scan
from .plans import LocalModel, Reference
from .trajectory_optimisation import (
    EASIER,
    FIRST,
    HARDER,
    LEAST,
    LENGTHS,
    MOST,
    TRUSTED,
    BoxDDP,
    Known,
    Model,
)

_Found = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


class TracedSearch:
    """The plan that a search reaches, in operations that `lanes` writes down.

    Args:
        search: with the problem, the steps and the iterations.
    """

    def __init__(self, search: BoxDDP) -> None:
        self.search, self.problem = search, search.problem

    def __call__(self, x: Tensor, control: Tensor, reference: Reference) -> tuple[Tensor, Tensor, Tensor]:
        """The improved plan: states (B, T + 1, n), controls (B, T, m) and their feedback (B, T, m, n).

        Args:
            x: (B, n).
            control: (B, T, m), around ``reference``.
            reference: states and feedback that the first control goes with.
        """
        ends = self.search.ends(x)
        none = torch.zeros_like(control)
        around = reference.state, self.problem.admissible(control), none, reference.feedback
        whole = torch.ones_like(x[:, 0])
        state, u, cost = self._rolled(x, around, whole, ends)
        start = (state, u, cost, FIRST * whole, whole.clone(), torch.isfinite(cost).to(x))

        def iterate(now: _Found) -> _Found:
            return self._iterated(now, ends)

        state, u, *_ = repeat(self.search.iterations, iterate, start, where=lambda now: now[-1] > 0)
        known, least = self._derivatives(state, u), torch.full_like(cost, LEAST)

        def models(none: tuple[()], full: Tensor) -> tuple[tuple[()], tuple[Tensor, Tensor]]:
            end, (_, feedback, _, curvature) = self._backwards(state, u, known, least, full, ends)
            bent = torch.isfinite(end.curvature).all(-1).all(-1)
            bent = bent & torch.isfinite(curvature).all(-1).all(-1).all(-1)
            return none, (feedback, (end.definite > 0) & bent)

        both = torch.stack((whole, torch.zeros_like(whole)), dim=1)  # the second that of Gauss and Newton
        (feedback, gauss), fine = (part.unbind(1) for part in scan(models, (), both)[1])
        fine = fine[0][:, None, None, None]
        return state, u, torch.where(fine, feedback, gauss)

    def _iterated(self, now: _Found, ends: LocalModel) -> _Found:
        state, u, cost, mu, full, active = now
        known = self._derivatives(state, u)
        end, (change, feedback, _, _) = self._backwards(state, u, known, mu, full, ends)
        definite, on = end.definite > 0, active > 0
        x, around = state[:, 0], (state[:, :-1], u, change, feedback)

        def attempt(now: tuple[Tensor, Tensor], share: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[()]]:
            best, length = now
            tried = self._cost(x, around, share, ends)
            lower = torch.isfinite(tried) & (tried < best)
            return (torch.where(lower, tried, best), torch.where(lower, share, length)), ()

        nothing = torch.full_like(cost, torch.inf), torch.zeros_like(cost)
        shares = cost.new_tensor(LENGTHS).expand(len(cost), -1)
        (best, length), _ = scan(attempt, nothing, shares)
        better = on & definite & (best < cost)
        new, chosen, _ = self._rolled(x, around, length, ends)
        state = torch.where(better[:, None, None], new, state)
        u = torch.where(better[:, None, None], chosen, u)
        gain = (cost - best) / cost.abs().clamp(min=1e-300)
        cost = torch.where(better, best, cost)
        small = end.promised.abs() <= self.search.tolerance * cost.abs()
        done = ((better & (gain <= self.search.tolerance)) | (definite & small)) & (mu <= TRUSTED)
        mu = torch.where(on, torch.where(better, (mu * EASIER).clamp(min=LEAST), mu * HARDER), mu)
        full = torch.where(on & ~better, 1 - full, full)
        return state, u, cost, mu, full, (on & ~done & (mu <= MOST)).to(active)

    def _cost(self, x: Tensor, around: tuple[Tensor, ...], length: Tensor, ends: LocalModel) -> Tensor:
        """What a plan costs at a length of its change, (B,)."""

        def step(
            now: tuple[Tensor, Tensor], at: tuple[Tensor, ...]
        ) -> tuple[tuple[Tensor, Tensor], tuple[()]]:
            after, (_, _, paid) = self.search.forward(now[0], at, length.unsqueeze(1))
            return (after, now[1] + paid), ()

        start = x.unsqueeze(1), torch.zeros_like(x[:, :1])
        (last, spent), _ = scan(step, start, around)
        whole: Tensor = (spent + ends.at(self.problem, last)).squeeze(1)
        return whole

    def _rolled(
        self, x: Tensor, around: tuple[Tensor, ...], length: Tensor, ends: LocalModel
    ) -> tuple[Tensor, Tensor, Tensor]:
        """States (B, T + 1, n), controls (B, T, m) and cost (B,) at a length of the change."""

        def step(now: Tensor, at: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
            return self.search.forward(now, at, length.unsqueeze(1))

        last, (state, u, paid) = scan(step, x.unsqueeze(1), around)
        cost = paid.squeeze(2).sum(1) + ends.at(self.problem, last).squeeze(1)
        return torch.cat((state.squeeze(2), last), dim=1), u.squeeze(2), cost

    def _derivatives(self, state: Tensor, u: Tensor) -> Known:
        def at(none: tuple[()], now: tuple[Tensor, Tensor]) -> tuple[tuple[()], Known]:
            return none, tuple(self.problem.derivatives(*now))

        known: Known = scan(at, (), (state[:, :-1], u))[1]
        return known

    def _backwards(
        self, state: Tensor, u: Tensor, known: Known, mu: Tensor, full: Tensor, ends: LocalModel
    ) -> tuple[Model, tuple[Tensor, ...]]:
        slope, bent = ends.slope(self.problem, state[:, -1]), ends.curvature.expand(len(u), -1, -1)
        last = Model(slope, bent.clone(), torch.zeros_like(mu), torch.ones_like(mu))
        reverse = tuple(part.flip(1) for part in (*known, u))
        end, out = scan(lambda after, now: self.search.backward(after, now, (mu, full)), last, reverse)
        return end, tuple(part.flip(1) for part in out)
