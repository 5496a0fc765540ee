"""Tracking as regulation: the error and the desired state together as one plant."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import copied, fail, number, states
from .base import ControlAffineSystem
from .two_state import input_gain

_TRUE = ((-1.0, -0.5), (1.0, 0.0), (0.0, -0.5))


class TwoStateTracking(ControlAffineSystem):
    """The two-state plant made to follow xd = (sin t, cos t + sin t), in the state (e, xd), e = x - xd:

        e' = f(x) - hd(xd) + g(x) (mu + ud),   xd' = hd(xd) = (xd2 - xd1, xd2 - 2 xd1),
        ud = gd+ (hd - theta' s(xd)),  gd+ = (0, 1 / (cos 2 xd1 + 2)),
        f(x) = theta_true' s(x),  s = (x1, x2, x2 (1 - (cos 2 x1 + 2)^2)).

    The input is mu = u - ud, which vanishes where e does: the origin of e is an equilibrium for every xd, of
    the cost e'Qe + mu'R mu (`adp.tracking_cost`).

    Example:
        >>> plant = systems.TwoStateTracking()
        >>> plant.dim, plant.theta.shape
        (4, torch.Size([3, 2]))

        Shown by `staf experiment=adp_tracking`.

    Args:
        theta: parameters of the drift and of ud, (3, 2) or (..., 3, 2), one a row of states; the true ones by
            default, an estimate for a model.

    Raises:
        ValueError: if theta has another shape or is not finite.

    Source: MATH.md section 4, after Kamalapurkar, Dinh, Bhasin and Dixon.
    """

    dim = 4
    inputs = 1

    def __init__(self, theta: Tensor | list[list[float]] | None = None) -> None:
        super().__init__()
        chosen = (
            true_parameters()
            if theta is None
            else torch.as_tensor(theta, device=getattr(theta, "device", "cpu"))
        )
        number("TwoStateTracking", "theta", chosen)
        if chosen.shape[-2:] != (3, 2):
            raise fail("TwoStateTracking", "theta", "must be (..., 3, 2)", tuple(chosen.shape))
        self.register_buffer("theta", chosen)
        self.theta: Tensor

    def drift(self, x: Tensor) -> Tensor:
        e, desired = states(self, "x", x, 4)[..., :2], x[..., 2:]
        state, rate = e + desired, desired_rate(desired)
        pushed = input_gain(state[..., 0]) * feedforward(desired, self.theta)
        error_rate = parametric_drift(self.theta, state) - rate
        return torch.cat((error_rate[..., :1], error_rate[..., 1:] + pushed.unsqueeze(-1), rate), dim=-1)

    def believing(self, theta: Tensor) -> TwoStateTracking:
        """A copy with other parameters, (..., 3, 2); not checked, so that a row may go wrong alone."""
        return copied(self, theta=theta)

    def effectiveness(self, x: Tensor) -> Tensor:
        gain = input_gain(x[..., 0] + x[..., 2])
        zero = torch.zeros_like(gain)
        return torch.stack((zero, gain, zero, zero), dim=-1).unsqueeze(-1)


def true_parameters() -> Tensor:
    """theta of the two-state plant's drift, (3, 2), float64."""
    return torch.tensor(_TRUE, dtype=torch.float64, device="cpu")


def regressor(x: Tensor) -> Tensor:
    """s(x) = (x1, x2, x2 (1 - (cos 2 x1 + 2)^2)): (..., 2) -> (..., 3)."""
    x1, x2 = x.unbind(-1)
    return torch.stack((x1, x2, x2 * (1 - input_gain(x1).square())), dim=-1)


def parametric_drift(theta: Tensor, x: Tensor) -> Tensor:
    """theta's(x): (..., 3, 2), (..., 2) -> (..., 2)."""
    return (theta.to(x) * regressor(x).unsqueeze(-1)).sum(-2)


def desired_rate(desired: Tensor) -> Tensor:
    """hd(xd): (..., 2) -> (..., 2)."""
    d1, d2 = desired.unbind(-1)
    return torch.stack((d2 - d1, d2 - 2 * d1), dim=-1)


def feedforward(desired: Tensor, theta: Tensor) -> Tensor:
    """ud = gd+ (hd - theta' s(xd)): (..., 2), (..., 3, 2) -> (...)."""
    wanted = desired_rate(desired) - parametric_drift(theta, desired)
    return wanted[..., 1] / input_gain(desired[..., 0])


def desired_trajectory(time: Tensor) -> Tensor:
    """xd(t) = (sin t, cos t + sin t): (T,) -> (T, 2).

    Example:
        >>> systems.desired_trajectory(torch.zeros(1).double())
        tensor([[0., 1.]], dtype=torch.float64)

        Shown by `staf experiment=adp_tracking`.
    """
    return torch.stack((time.sin(), time.cos() + time.sin()), dim=-1)
