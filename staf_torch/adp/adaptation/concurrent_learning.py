"""Concurrent learning: the history stack whose equations determine parameters best, and tracking by it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes import repeat
from ...lanes.per_row.objects import OfRows
from ...numerics.angles import wrap
from ...numerics.checks import (
    choice,
    fail,
    integer,
    non_negative,
    positive,
    positive_real,
    real,
    trailing,
    vector,
)
from ..loop.controller import Controller
from ..problem.cost import matvec
from .identification import Equation, IntegralWindows, SlopeWindows, Window, Windows
from .parametric import ParametricPlant

_BETTER = 1.001  # factor by which a change must raise the least eigenvalue


class Stack(NamedTuple):
    """The equations that are remembered, and the one that is being tried."""

    s: Tensor  # (..., N, r, p), zero where empty
    z: Tensor  # (..., N, r), with several right-hand sides (..., N, r, n)
    gram: Tensor  # (..., p, p) the sum of S'S
    moment: Tensor  # (..., p) the sum of S'z, or (..., p, n)
    filled: Tensor  # (...) places
    tried_s: Tensor  # (..., r, p) the equation that looks for a place, or found the last empty one
    tried_z: Tensor  # (..., r), or (..., r, n)
    turn: Tensor  # (...) the place that is tried next; 0: none, k: place k - 1; -1: nothing is tried
    best: Tensor  # (...) the largest least eigenvalue so far
    place: Tensor  # (...) where; -1: as it is
    missed: Tensor  # (...) equations with a row that was not finite


class HistoryStack(metaclass=OfRows):
    """Keep the N equations S theta = z whose sum of S'S has the largest least eigenvalue.

    Empty places are filled with what differs enough from the equation before. Then an equation takes the
    place with which the least eigenvalue grows most, if it grows. One place is tried a step: an equation is
    in after N + 1 steps, and those that come meanwhile are not looked at. A step costs one eigenvalue
    problem, not N. Rows of an equation that are not finite are left out and counted: `Stack.missed`.

    Example:
        >>> from staf_torch.adp.adaptation.identification import Equation
        >>> stack = adp.HistoryStack(rows=1, parameters=2, size=2)
        >>> now = stack.init(torch.zeros(1, 1).double())
        >>> for s in ([1.0, 0.0], [1.0, 0.1], [0.0, 1.0]):
        ...     one = torch.tensor([[s]]).double()
        ...     equation = Equation(one, one.sum(-1), torch.zeros(1), torch.tensor([True]))
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
        outputs: n, right-hand sides of an equation, z (..., r, n); None for one, z (..., r).

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Chowdhary and Johnson, "A singular value maximizing data recording algorithm for concurrent
    learning", ACC 2011; the search over several steps is our own.
    """

    def __init__(
        self, rows: int, parameters: int, size: int = 20, novelty: float = 0.05, outputs: int | None = None
    ) -> None:
        self.rows = integer("HistoryStack", "rows", rows, least=1)
        self.parameters = integer("HistoryStack", "parameters", parameters, least=1)
        self.size = integer("HistoryStack", "size", size, least=1)
        non_negative("HistoryStack", "novelty", novelty)
        self.novelty = real("HistoryStack", "novelty", novelty)
        sides = () if outputs is None else (integer("HistoryStack", "outputs", outputs, least=1),)
        self._sides: tuple[int, ...] = sides

    def init(self, x: Tensor) -> Stack:
        """An empty stack, a row each of (..., n)."""
        lead, (r, p) = x.shape[:-1], (self.rows, self.parameters)
        zero = x.new_zeros(lead)
        s, z = x.new_zeros(*lead, self.size, r, p), x.new_zeros(*lead, self.size, r, *self._sides)
        gram, moment = x.new_zeros(*lead, p, p), x.new_zeros(*lead, p, *self._sides)
        tried_s, tried_z = x.new_zeros(*lead, r, p), x.new_zeros(*lead, r, *self._sides)
        return Stack(s, z, gram, moment, zero, tried_s, tried_z, zero - 1, zero, zero - 1, zero)

    def step(self, state: Stack, equation: Equation) -> Stack:
        """The stack after one more trial, with the equation where it is ready and fits."""
        state, equation = _seen(state, equation)

        def busy(now: tuple[Stack, Equation]) -> Tensor:
            return now[1].ready | (now[0].turn >= 0)

        def trial(now: tuple[Stack, Equation]) -> tuple[Stack, Equation]:
            return self._trial(*now), now[1]

        # Most of the time there is nothing to try: a compiled program then computes no eigenvalue.
        after: Stack = repeat(1, trial, (state, equation), where=busy)[0]
        return after

    def take(self, state: Stack, equation: Equation) -> Stack:
        """The stack with the equation in it, where it is ready and fits: all places are tried at once."""
        state, equation = _seen(state, equation)
        fills = self._fills(state, equation)
        trials = state.gram.unsqueeze(-3) + (_gram(equation.s).unsqueeze(-3) - _gram(state.s))
        best, place = torch.linalg.eigvalsh(_finite(trials))[..., 0].max(dim=-1)
        enough = best > _BETTER * torch.linalg.eigvalsh(_finite(state.gram))[..., 0]
        replaces = equation.ready & (state.filled >= self.size) & enough
        goes = torch.where(fills, state.filled, torch.where(replaces, place, -1))
        return self._placed(_tried(state, equation, goes >= 0), goes, fills)

    def _fills(self, state: Stack, equation: Equation) -> Tensor:
        """Return where the equation takes an empty place: it differs enough from the one before."""
        change = (equation.s - state.tried_s).square().sum((-2, -1))
        new = change > self.novelty**2 * equation.s.square().sum((-2, -1))
        return equation.ready & (state.filled < self.size) & (new | (state.filled == 0))

    def _trial(self, state: Stack, equation: Equation) -> Stack:
        fills = self._fills(state, equation)
        begins = equation.ready & (state.filled >= self.size) & (state.turn < 0)
        state = _tried(state, equation, fills | begins)
        turn = torch.where(begins, 0.0, state.turn)
        # One trial: the sums with the equation in place turn - 1, or as they are.
        slots = torch.arange(self.size, device=state.s.device)
        out = (slots == (turn - 1).unsqueeze(-1)).to(state.s)  # (..., N)
        trying = _beside(turn > 0, state.gram)
        added = torch.where(
            trying, _gram(state.tried_s) - _gram((_beside(out, state.s) * state.s).sum(out.dim() - 1)), 0.0
        )
        least = torch.linalg.eigvalsh(_finite(state.gram + added))[..., 0]
        # The first place must beat the stack by a factor, every later one the best so far.
        needed = torch.where(state.place >= 0, state.best, _BETTER * state.best)
        better = (turn > 0) & (least > needed)
        best = torch.where((turn == 0) | better, least, state.best)
        place = torch.where(turn == 0, -1.0, torch.where(better, turn - 1, state.place))
        done = turn >= self.size
        # The equation goes to an empty place, or to the best one once all have been tried.
        goes = torch.where(fills, state.filled, torch.where(done, place, -1.0))
        turn = torch.where(done | (turn < 0), -1.0, turn + 1)
        return self._placed(state, goes, fills)._replace(turn=turn, best=best, place=place)

    def _placed(self, state: Stack, goes: Tensor, fills: Tensor) -> Stack:
        """The stack with the equation that was tried in a place, -1 for none; empty places hold zeros."""
        chosen = torch.arange(self.size, device=state.s.device) == goes.unsqueeze(-1)
        places = chosen.dim() - 1
        s = torch.where(_beside(chosen, state.s), state.tried_s.unsqueeze(places), state.s)
        z = torch.where(_beside(chosen, state.z), state.tried_z.unsqueeze(places), state.z)
        # Anew and not by a difference: what rounding leaves of a large equation would stay when it is gone.
        gram, moment = _gram(s).sum(places), _moment(s, z).sum(places)
        return state._replace(
            s=s,
            z=z,
            gram=torch.where(_beside(goes >= 0, gram), gram, state.gram),
            moment=torch.where(_beside(goes >= 0, moment), moment, state.moment),
            filled=state.filled + fills.to(state.filled),
        )


def _seen(state: Stack, equation: Equation) -> tuple[Stack, Equation]:
    """The equation without rows that are not finite, none where no row is, and the stack that counts them."""
    lost, (equation, fine) = equation.ready, equation.finite()
    lost = lost & ~fine.all(-1)
    ready = equation.ready & fine.any(-1)
    return state._replace(missed=state.missed + lost.to(state.missed)), equation._replace(ready=ready)


def _tried(state: Stack, equation: Equation, where: Tensor) -> Stack:
    """The stack that tries the equation from now on, in the rows where it is taken."""
    s = torch.where(_beside(where, state.tried_s), equation.s, state.tried_s)
    return state._replace(
        tried_s=s, tried_z=torch.where(_beside(where, state.tried_z), equation.z, state.tried_z)
    )


def _beside(flags: Tensor, of: Tensor) -> Tensor:
    """Flags with as many dimensions as what they choose from."""
    return flags[(..., *[None] * (of.dim() - flags.dim()))]


def _gram(s: Tensor) -> Tensor:
    """S'S: (..., r, p) -> (..., p, p)."""
    return (s.unsqueeze(-1) * s.unsqueeze(-2)).sum(-3)


def _moment(s: Tensor, z: Tensor) -> Tensor:
    """S'z: (..., r, p), (..., r) -> (..., p), or with (..., r, n) -> (..., p, n)."""
    if z.dim() < s.dim():
        return (s * z.unsqueeze(-1)).sum(-2)
    return (s.unsqueeze(-1) * z.unsqueeze(-2)).sum(-3)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """ab': (..., p), (..., n) -> (..., p, n)."""
    return a.unsqueeze(-1) * b.unsqueeze(-2)


def _finite(gram: Tensor) -> Tensor:
    """Zeros where a row went wrong: eigenvalues of NaN raise for all rows."""
    return torch.where(torch.isfinite(gram), gram, 0.0)


class ConcurrentGradient(metaclass=OfRows):
    """theta' = Gam (push + gain sum_j S_j' (z_j - S_j theta)) over a history stack, the step implicit:

        theta+ = (I + h Gam gain sum_j S_j'S_j)^-1 (theta + h Gam (push + gain sum_j S_j'z_j)).

    It converges without persistent excitation once sum_j S_j'S_j has full rank. ``push`` is what the control
    adds, Y'e of an adaptive tracking law for one. k_CL and Gam, a multiple of the identity, are positive
    numbers, or one a row, (...).
    """

    def __init__(self, gain: float | Tensor = 1.0, rate: float | Tensor = 1.0) -> None:
        for name, value in (("gain", gain), ("rate", rate)):
            if not isinstance(value, Tensor):
                positive_real("ConcurrentGradient", name, value)
        self.gain, self.rate = gain, rate

    def step(
        self, theta: Tensor, gram: Tensor, moment: Tensor, dt: float, push: Tensor | None = None
    ) -> Tensor:
        """Return theta (..., p) after ``dt`` seconds, with the sums of S'S (..., p, p) and S'z (..., p)
        over the stack."""
        lead = gram.new_zeros(gram.shape[:-2])
        rate, gain = dt * (lead + self.rate).unsqueeze(-1), (lead + self.gain).unsqueeze(-1)
        identity = torch.eye(theta.shape[-1], dtype=theta.dtype, device=theta.device)
        inverse = torch.linalg.inv_ex(identity + (rate * gain).unsqueeze(-1) * gram)[0]
        pull = gain * moment if push is None else gain * moment + push
        return matvec(inverse, theta + rate * pull)


class Identified(NamedTuple):
    """The state of `ConcurrentLearning`, a row a trajectory."""

    theta: Tensor  # estimate, (..., p, n)
    stack: Stack

    @property
    def regressors(self) -> Tensor:
        """s_j of the history stack, (..., N, p); zero rows are empty."""
        return self.stack.s.squeeze(-2)

    @property
    def rates(self) -> Tensor:
        """y_j = x'_j - g_j u_j, (..., N, n)."""
        return self.stack.z.squeeze(-2)


class ConcurrentLearning(metaclass=OfRows):
    """theta' = gain (s (y - theta's)' + sum_j s_j (y_j - theta's_j)'), with y = x' - g u measured.

    A `HistoryStack` of N pairs (s_j, y_j) makes theta converge without persistent excitation once
    sum_j s_j s_j' has full rank. All places are tried with every pair: a new pair takes the place with which
    the least eigenvalue of that sum grows most, if it grows.

    Example:
        >>> learning = adp.ConcurrentLearning(parameters=3, outputs=2, size=10)
        >>> known = learning.init(torch.zeros(1, 3, 2).double())
        >>> known.theta.shape, known.regressors.shape
        (torch.Size([1, 3, 2]), torch.Size([1, 10, 3]))

        Shown by `staf experiment=adp_tracking`.

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
        self.law = ConcurrentGradient(self.gain)
        self.stack = HistoryStack(1, parameters, size, novelty, outputs)

    def init(self, theta: Tensor) -> Identified:
        """An empty stack with the first estimate theta (..., p, n)."""
        return Identified(theta, self.stack.init(theta[..., 0]))

    def step(self, state: Identified, s: Tensor, y: Tensor, dt: float) -> Identified:
        """The estimate after ``dt`` seconds of the measurement y (..., n) at the regressor s (..., p). A pair
        with an entry that is not finite moves nothing, and counts in ``missed`` of the stack."""
        stack = self.remember(state, s, y).stack
        fine = (torch.isfinite(s).all(-1) & torch.isfinite(y).all(-1)).unsqueeze(-1)
        s, y = torch.where(fine, s, 0.0), torch.where(fine, y, 0.0)
        gram, moment = stack.gram + _outer(s, s), stack.moment + _outer(s, y)
        theta = self.law.step(state.theta.mT, gram.unsqueeze(-3), moment.mT, dt).mT  # column by column
        return Identified(theta, stack)

    def remember(self, state: Identified, s: Tensor, y: Tensor) -> Identified:
        """The stack with the pair in it, where that is worth it."""
        zero = torch.zeros_like(s[..., 0])
        pair = Equation(s.unsqueeze(-2), y.unsqueeze(-2), zero, torch.ones_like(zero).bool())
        return state._replace(stack=self.stack.take(state.stack, pair))


DesiredMotion = Callable[[Tensor], tuple[Tensor, Tensor]]
"""xd and its rate from the state, (..., N) -> (..., m) and (..., m)."""
GainOfRows = float | Sequence[float] | Tensor


class Tracking(NamedTuple):
    """Carried state of a `ConcurrentTracker`, a row a trajectory."""

    theta: Tensor  # (..., p)
    feedback: Tensor  # (...) K
    gain: Tensor  # (...) k_CL
    rate: Tensor  # (...) Gam
    window: Window
    stack: Stack


class ConcurrentTracker(Controller):
    """Follow xd with a plant whose first m states are pushed by the m inputs, x' = Y(z) theta + u:

        u = xd' - Y theta^ - K (x - xd),
        theta^' = Gam (Y'(x - xd) + k_CL sum_j S_j' (z_j - S_j theta^)),

    with equations S theta = z from windows of measured states, of which a `HistoryStack` keeps the best.
    Each row may have gains of its own. x - xd is in [-pi, pi] for angles of the plant. Where a measured state
    has a NaN the control is held, the stack alone is learned from, and the result records how often so far as
    ``missed``.

    Example:
        >>> def regressor(z, u):  # x' = theta sin x + u
        ...     return z.sin().unsqueeze(-1)
        >>> plant = adp.ParametricPlant(regressor, lambda z, u: u, dim=1, inputs=1, theta=[2.0])
        >>> def rest(z):
        ...     return torch.ones_like(z), torch.zeros_like(z)  # xd = 1
        >>> tracker = adp.ConcurrentTracker(plant, rest, length=0.05, feedback=4.0, gain=2000.0, size=5)
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
        >>> x0 = torch.tensor([[-1.0]]).double()
        >>> run = adp.simulate(tracker, plant, cost, x0, dt=0.01, steps=200)
        >>> run.state[0, -1].round(decimals=2)
        tensor([1.], dtype=torch.float64)
        >>> run["theta"][0, -1].round(decimals=2)
        tensor([2.], dtype=torch.float64)

        Shown by `staf experiment=icl`.

    Args:
        plant: its theta is not used.
        reference: xd and xd' from the state.
        length: of the windows, s, a number or one a row; so are the gains.
        feedback: K, 1/s.
        gain: k_CL.
        rate: Gam.
        source: of the equations: ``integral``, or ``slope``, x' from the difference over the window.
        size: N of the stack.
        first: theta^(0), p numbers; None for zeros.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Parikh, Kamalapurkar and Dixon, IJACSP 33 (2019); the implicit step of theta^ is our own.
    """

    def __init__(
        self,
        plant: ParametricPlant,
        reference: DesiredMotion,
        *,
        length: GainOfRows,
        feedback: GainOfRows,
        gain: GainOfRows,
        rate: GainOfRows = 1.0,
        source: str = "integral",
        size: int = 20,
        first: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        choice("ConcurrentTracker", "source", source, ("integral", "slope"))
        self.gains = []
        for name, value in (("feedback", feedback), ("gain", gain), ("rate", rate), ("length", length)):
            given = torch.as_tensor(value, dtype=torch.float64, device=getattr(value, "device", "cpu"))
            if given.dim() > 1:
                raise fail("ConcurrentTracker", name, "must be a number or one a row", value)
            self.gains.append(positive("ConcurrentTracker", name, given))
        self.plant, self.reference = plant, reference
        longest = float(self.gains[3].max())
        made = IntegralWindows if source == "integral" else SlopeWindows
        self.windows: Windows = made(plant, longest)
        p, n = plant.parameters_count, plant._size()
        self.angles = tuple(index % n for index in plant.periodic if index % n < plant.inputs)
        self.stack = HistoryStack(len(plant.rows), p, size)
        started = vector("ConcurrentTracker", "first", [0.0] * p if first is None else first, p)
        self.first = torch.tensor(started, dtype=torch.float64, device="cpu")

    def init(self, x0: Tensor) -> Tracking:
        trailing(type(self).__name__, "x0", x0, 2)
        feedback, gain, rate, length = (g.to(x0).expand(len(x0)).clone() for g in self.gains)
        theta = self.first.to(x0).expand(len(x0), -1).clone()
        return Tracking(theta, feedback, gain, rate, self.windows.init(x0, length), self.stack.init(x0))

    def recorded(self, carried: Tracking) -> dict[str, Tensor]:
        return {"theta": carried.theta, "missed": carried.window.missed}

    def step(self, x: Tensor, now: Tracking, uniform: Tensor, dt: float) -> tuple[Tensor, Tracking]:
        m = self.plant.inputs
        window, equation = self.windows.step(now.window, x, dt)
        stack = self.stack.step(now.stack, equation)
        wanted, wanted_rate = self.reference(x)
        missing = x.isnan().any(-1)
        error = wrap(x[..., :m] - wanted, self.angles)
        y = self.plant.regressor(x, torch.zeros_like(error))[..., :m, :]
        push = torch.where(missing.unsqueeze(-1), 0.0, (y * error.unsqueeze(-1)).sum(-2))
        theta = ConcurrentGradient(now.gain, now.rate).step(now.theta, stack.gram, stack.moment, dt, push)
        u = wanted_rate - (y * theta.unsqueeze(-2)).sum(-1) - now.feedback.unsqueeze(-1) * error
        u = torch.where(missing.unsqueeze(-1), now.window.u, u)
        window = self.windows.holding(window, u)
        return u, now._replace(theta=theta, window=window, stack=stack)
