"""Adaptive tracking where the input pushes every state: the law of the papers on concurrent learning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...numerics.angles import wrap
from ...numerics.checks import choice, fail, positive, trailing, vector
from ..loop.controller import Controller
from .history_stack import ConcurrentGradient, HistoryStack, Stack
from .parametric import ParametricPlant
from .windows import IntegralWindows, SlopeWindows, Window, Windows

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
