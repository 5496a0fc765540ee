"""Concurrent learning: parameters of the drift from what is measured now and from what was remembered."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._checks import integer, positive_real


class Identified(NamedTuple):
    """The state of an identifier, a row a trajectory."""

    theta: Tensor  # estimate, (..., p, n)
    regressors: Tensor  # s_j of the history stack, (..., N, p); zero rows are empty
    rates: Tensor  # y_j = x'_j - g_j u_j, (..., N, n)


class ConcurrentLearning:
    """theta' = gain (s (y - theta's)' + sum_j s_j (y_j - theta's_j)'), with y = x' - g u measured.

    The stack of N remembered pairs (s_j, y_j) makes theta converge without persistent excitation once
    sum_j s_j s_j' has full rank. It is kept by singular-value maximisation: empty places are filled with
    pairs that differ enough from the last; after that a new pair takes the place with which the least
    eigenvalue of sum_j s_j s_j' grows most, if it grows.

    Args:
        parameters: p, rows of theta.
        outputs: n, columns of theta.
        size: N, at least p.
        gain: positive, 1/s. The step is implicit, so no gain is too large for it.
        novelty: relative change of s that fills an empty place.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Chowdhary and Johnson, "Concurrent learning for convergence in adaptive control without
    persistency of excitation", CDC 2010, and its singular-value maximising algorithm (ACC 2011).
    """

    def __init__(
        self, parameters: int, outputs: int, size: int = 10, gain: float = 1.0, novelty: float = 0.05
    ) -> None:
        self.parameters = integer("ConcurrentLearning", "parameters", parameters, least=1)
        self.outputs = integer("ConcurrentLearning", "outputs", outputs, least=1)
        self.size = integer("ConcurrentLearning", "size", size, least=parameters)
        self.gain = positive_real("ConcurrentLearning", "gain", gain)
        self.novelty = positive_real("ConcurrentLearning", "novelty", novelty)

    def init(self, theta: Tensor) -> Identified:
        """An empty stack with the first estimate theta (..., p, n)."""
        lead = theta.shape[:-2]
        return Identified(
            theta,
            theta.new_zeros(*lead, self.size, self.parameters),
            theta.new_zeros(*lead, self.size, self.outputs),
        )

    def step(self, state: Identified, s: Tensor, y: Tensor, dt: float) -> Identified:
        """The estimate after ``dt`` seconds of the measurement y (..., n) at the regressor s (..., p)."""
        stack = self.remember(state, s, y)
        regressors = torch.cat((stack.regressors, s.unsqueeze(-2)), dim=-2)
        rates = torch.cat((stack.rates, y.unsqueeze(-2)), dim=-2)
        information = (regressors.unsqueeze(-1) * regressors.unsqueeze(-2)).sum(-3)  # (..., p, p)
        moment = (regressors.unsqueeze(-1) * rates.unsqueeze(-2)).sum(-3)  # (..., p, n)
        step = self.gain * dt
        identity = torch.eye(self.parameters, dtype=s.dtype, device=s.device)
        theta = torch.linalg.solve_ex(identity + step * information, state.theta + step * moment)[0]
        return Identified(theta, stack.regressors, stack.rates)

    def remember(self, state: Identified, s: Tensor, y: Tensor) -> Identified:
        """The stack with the pair in it, where that is worth it."""
        place = torch.where(
            self._empty(state) < self.size, self._filling(state, s), self._replacing(state, s)
        )
        slots = torch.arange(self.size, device=s.device)
        chosen = (slots == place.unsqueeze(-1)).unsqueeze(-1)  # (..., N, 1); nowhere for place -1
        return Identified(
            state.theta,
            torch.where(chosen, s.unsqueeze(-2), state.regressors),
            torch.where(chosen, y.unsqueeze(-2), state.rates),
        )

    def _empty(self, state: Identified) -> Tensor:
        """The first empty place, N if there is none: (...)."""
        return (state.regressors.square().sum(-1) > 0).sum(-1)

    def _filling(self, state: Identified, s: Tensor) -> Tensor:
        """The place of a pair that differs enough from the last one, else -1: (...)."""
        empty = self._empty(state)
        last = (empty - 1).clamp(min=0)[..., None, None].expand(*empty.shape, 1, self.parameters)
        before = state.regressors.gather(-2, last).squeeze(-2)
        change = (s - before).square().sum(-1)
        return torch.where(change > self.novelty**2 * s.square().sum(-1), empty, -1)

    def _replacing(self, state: Identified, s: Tensor) -> Tensor:
        """The place whose pair is worth less than the new one, else -1: (...)."""
        kept = state.regressors.unsqueeze(-1) * state.regressors.unsqueeze(-2)  # (..., N, p, p)
        whole = kept.sum(-3)
        trial = whole.unsqueeze(-3) - kept + (s.unsqueeze(-1) * s.unsqueeze(-2)).unsqueeze(-3)
        least = torch.linalg.eigvalsh(torch.where(torch.isfinite(trial), trial, 0.0))[..., 0]  # (..., N)
        now = torch.linalg.eigvalsh(torch.where(torch.isfinite(whole), whole, 0.0))[..., 0]
        best, place = least.max(dim=-1)
        return torch.where(best > 1.001 * now, place, -1)
