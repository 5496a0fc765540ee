"""A history stack that is worth most, and concurrent learning from it."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes import repeat
from ...numerics.checks import integer, non_negative, positive_real, real
from ..cost import matvec
from .windows import Equation

_BETTER = 1.001  # factor by which a change must raise the least eigenvalue


class Stack(NamedTuple):
    """The equations that are remembered, and the one that is being tried.

    Example:
        >>> adp.HistoryStack(rows=2, parameters=3, size=10).init(torch.zeros(1, 2).double()).s.shape
        torch.Size([1, 10, 2, 3])

        Shown by `staf experiment=icl`.
    """

    s: Tensor  # (..., N, r, p), zero where empty
    z: Tensor  # (..., N, r)
    gram: Tensor  # (..., p, p) the sum of S'S
    moment: Tensor  # (..., p) the sum of S'z
    filled: Tensor  # (...) places
    tried_s: Tensor  # (..., r, p) the equation that looks for a place, or found the last empty one
    tried_z: Tensor  # (..., r)
    turn: Tensor  # (...) the place that is tried next; 0: none, k: place k - 1; -1: nothing is tried
    best: Tensor  # (...) the largest least eigenvalue so far
    place: Tensor  # (...) where; -1: as it is


class HistoryStack:
    """Of the equations S theta = z that come, the N whose sum of S'S has the largest least eigenvalue.

    Empty places are filled with what differs enough from the equation before. Then an equation takes the
    place with which the least eigenvalue grows most, if it grows. One place is tried a step: an equation is
    in after N + 1 steps, and those that come meanwhile are not looked at. A step costs one eigenvalue
    problem, not N.

    Example:
        >>> stack = adp.HistoryStack(rows=1, parameters=2, size=2)
        >>> now = stack.init(torch.zeros(1, 1).double())
        >>> for s in ([1.0, 0.0], [1.0, 0.1], [0.0, 1.0]):
        ...     one = torch.tensor([[s]]).double()
        ...     equation = adp.Equation(one, one.sum(-1), torch.zeros(1), torch.tensor([True]))
        ...     for _ in range(4):
        ...         now = stack.step(now, equation)
        ...         equation = equation._replace(ready=torch.tensor([False]))
        >>> now.s[0, :, 0]
        tensor([[1., 0.],
                [0., 1.]], dtype=torch.float64)

        Shown by `staf experiment=icl`.

    Args:
        rows: r, of an equation.
        parameters: p.
        size: N, at least 1.
        novelty: relative change of S that fills an empty place, not negative.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Chowdhary and Johnson, "A singular value maximizing data recording algorithm for concurrent
    learning", ACC 2011; the search over several steps is our own.
    """

    def __init__(self, rows: int, parameters: int, size: int = 20, novelty: float = 0.05) -> None:
        self.rows = integer("HistoryStack", "rows", rows, least=1)
        self.parameters = integer("HistoryStack", "parameters", parameters, least=1)
        self.size = integer("HistoryStack", "size", size, least=1)
        non_negative("HistoryStack", "novelty", novelty)
        self.novelty = real("HistoryStack", "novelty", novelty)

    def init(self, x: Tensor) -> Stack:
        """An empty stack, a row each of (..., n)."""
        lead, (r, p) = x.shape[:-1], (self.rows, self.parameters)
        zero = x.new_zeros(lead)
        s, z = x.new_zeros(*lead, self.size, r, p), x.new_zeros(*lead, self.size, r)
        gram, moment = x.new_zeros(*lead, p, p), x.new_zeros(*lead, p)
        return Stack(s, z, gram, moment, zero, s[..., 0, :, :], z[..., 0, :], zero - 1, zero, zero - 1)

    def step(self, state: Stack, equation: Equation) -> Stack:
        """The stack after one more trial, with the equation where it is ready and fits."""

        def busy(now: tuple[Stack, Equation]) -> Tensor:
            return now[1].ready | (now[0].turn >= 0)

        def trial(now: tuple[Stack, Equation]) -> tuple[Stack, Equation]:
            return self._trial(*now), now[1]

        # Most of the time there is nothing to try: a compiled program then computes no eigenvalue.
        after: Stack = repeat(1, trial, (state, equation), where=busy)[0]
        return after

    def _trial(self, state: Stack, equation: Equation) -> Stack:
        slots, full = torch.arange(self.size, device=state.s.device), state.filled >= self.size
        change = (equation.s - state.tried_s).square().sum((-2, -1))
        new = change > self.novelty**2 * equation.s.square().sum((-2, -1))
        fills = equation.ready & ~full & (new | (state.filled == 0))
        begins = equation.ready & full & (state.turn < 0)
        taken = fills | begins
        tried_s = torch.where(taken[..., None, None], equation.s, state.tried_s)
        tried_z = torch.where(taken.unsqueeze(-1), equation.z, state.tried_z)
        turn = torch.where(begins, 0.0, state.turn)
        # One trial: the sums with the equation in place turn - 1, or as they are.
        out = (slots == (turn - 1).unsqueeze(-1)).to(state.s).unsqueeze(-1)  # (..., N, 1)
        out_s = (out.unsqueeze(-1) * state.s).sum(-3)
        trying = (turn > 0).unsqueeze(-1)
        added = torch.where(trying.unsqueeze(-1), _gram(tried_s) - _gram(out_s), 0.0)
        least = torch.linalg.eigvalsh(_finite(state.gram + added))[..., 0]
        # The first place must beat the stack by a factor, every later one the best so far.
        needed = torch.where(state.place >= 0, state.best, _BETTER * state.best)
        better = (turn > 0) & (least > needed)
        best = torch.where((turn == 0) | better, least, state.best)
        place = torch.where(turn == 0, -1.0, torch.where(better, turn - 1, state.place))
        done = turn >= self.size
        # The equation goes to an empty place, or to the best one once all have been tried.
        goes = torch.where(fills, state.filled, torch.where(done, place, -1.0)).unsqueeze(-1)
        chosen = slots == goes
        left = (done & (place >= 0)).unsqueeze(-1)
        again = (slots == place.unsqueeze(-1)).to(state.s).unsqueeze(-1) * left.to(state.s).unsqueeze(-1)
        gone_s, gone_z = (again.unsqueeze(-1) * state.s).sum(-3), (again * state.z).sum(-2)
        moves = goes >= 0
        gram = state.gram + torch.where(moves.unsqueeze(-1), _gram(tried_s) - _gram(gone_s), 0.0)
        moment = state.moment + torch.where(moves, _moment(tried_s, tried_z) - _moment(gone_s, gone_z), 0.0)
        return Stack(
            torch.where(chosen[..., None, None], tried_s.unsqueeze(-3), state.s),
            torch.where(chosen.unsqueeze(-1), tried_z.unsqueeze(-2), state.z),
            gram,
            moment,
            state.filled + fills.to(state.filled),
            tried_s,
            tried_z,
            torch.where(done | (turn < 0), -1.0, turn + 1),
            best,
            place,
        )


def _gram(s: Tensor) -> Tensor:
    """S'S: (..., r, p) -> (..., p, p)."""
    return (s.unsqueeze(-1) * s.unsqueeze(-2)).sum(-3)


def _moment(s: Tensor, z: Tensor) -> Tensor:
    """S'z: (..., r, p), (..., r) -> (..., p)."""
    return (s * z.unsqueeze(-1)).sum(-2)


def _finite(gram: Tensor) -> Tensor:
    """Zeros where a row went wrong: eigenvalues of NaN raise for all rows."""
    return torch.where(torch.isfinite(gram), gram, 0.0)


class ConcurrentGradient:
    """theta' = Gam (push + gain sum_j S_j' (z_j - S_j theta)) over a history stack, the step implicit:

        theta+ = (I + h Gam gain sum_j S_j'S_j)^-1 (theta + h Gam (push + gain sum_j S_j'z_j)).

    It converges without persistent excitation once sum_j S_j'S_j has full rank. ``push`` is what the control
    adds, Y'e of an adaptive tracking law for one.

    Example:
        >>> law = adp.ConcurrentGradient(gain=1.0, rate=1.0)
        >>> gram, moment = torch.eye(2).double(), torch.tensor([2.0, 3.0]).double()  # of a stack
        >>> theta = torch.zeros(1, 2).double()
        >>> for _ in range(200):
        ...     theta = law.step(theta, gram, moment, 0.1)
        >>> theta.round(decimals=4)
        tensor([[2., 3.]], dtype=torch.float64)

        Shown by `staf experiment=icl`.

    Args:
        gain: k_CL, positive, a number or one a row, (...).
        rate: Gam, positive, likewise: a multiple of the identity.

    Raises:
        ValueError: if a number is not positive.
    """

    def __init__(self, gain: float | Tensor = 1.0, rate: float | Tensor = 1.0) -> None:
        for name, value in (("gain", gain), ("rate", rate)):
            if not isinstance(value, Tensor):
                positive_real("ConcurrentGradient", name, value)
        self.gain, self.rate = gain, rate

    def step(
        self, theta: Tensor, gram: Tensor, moment: Tensor, dt: float, push: Tensor | None = None
    ) -> Tensor:
        """theta after ``dt`` seconds: (..., p).

        Args:
            theta: (..., p).
            gram: sum of S'S over the stack, (..., p, p).
            moment: sum of S'z, (..., p).
            dt: s.
            push: (..., p).
        """
        lead = theta.new_zeros(theta.shape[:-1])
        rate, gain = dt * (lead + self.rate).unsqueeze(-1), (lead + self.gain).unsqueeze(-1)
        identity = torch.eye(theta.shape[-1], dtype=theta.dtype, device=theta.device)
        inverse = torch.linalg.inv_ex(identity + (rate * gain).unsqueeze(-1) * gram)[0]
        pull = gain * moment if push is None else gain * moment + push
        return matvec(inverse, theta + rate * pull)
