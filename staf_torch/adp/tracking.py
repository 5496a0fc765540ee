"""Tracking as regulation: the error and the desired state together as one plant."""

from __future__ import annotations

import torch
from torch import Tensor

from .._checks import vector
from ..systems import ControlAffineSystem

_TRUE = ((-1.0, -0.5), (1.0, 0.0), (0.0, -0.5))


class TwoStateTracking(ControlAffineSystem):
    """The two-state plant made to follow xd = (sin t, cos t + sin t), in the state (e, xd), e = x - xd:

        e' = f(x) - hd(xd) + g(x) (mu + ud),   xd' = hd(xd) = (xd2 - xd1, xd2 - 2 xd1),
        ud = gd+ (hd - theta' s(xd)),  gd+ = (0, 1 / (cos 2 xd1 + 2)),
        f(x) = theta_true' s(x),  s = (x1, x2, x2 (1 - (cos 2 x1 + 2)^2)).

    The input is mu = u - ud, which vanishes where e does: the origin of e is an equilibrium for every xd, of
    the cost e'Qe + mu'R mu. With an estimate theta the model believes in f = theta's, and the plant (its
    ``feedforward``) applies the ud of the estimate.

    Args:
        drift_parameters: theta of this model's drift, (3, 2); the true one by default.
        feedforward: theta of ud, (3, 2); that of the drift by default.

    Raises:
        ValueError: if a theta has another shape or is not finite.

    Source: MATH.md section 4, after Kamalapurkar, Dinh, Bhasin and Dixon.
    """

    dim = 4
    inputs = 1

    def __init__(
        self,
        drift_parameters: Tensor | list[list[float]] | None = None,
        feedforward: Tensor | list[list[float]] | None = None,
    ) -> None:
        super().__init__()
        theta = true_parameters() if drift_parameters is None else _theta("drift_parameters", drift_parameters)
        self.register_buffer("theta", theta)
        self.register_buffer(
            "feedforward_theta", theta if feedforward is None else _theta("feedforward", feedforward)
        )
        self.theta: Tensor
        self.feedforward_theta: Tensor

    def drift(self, x: Tensor) -> Tensor:
        e, desired = x[..., :2], x[..., 2:]
        state, rate = e + desired, desired_rate(desired)
        pushed = input_gain(state[..., 0]) * feedforward(desired, self.feedforward_theta)
        known = apply(self.theta, regressor(state)) - rate
        return torch.cat((known[..., :1], known[..., 1:] + pushed.unsqueeze(-1), rate), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        gain = input_gain(x[..., 0] + x[..., 2])
        zero = torch.zeros_like(gain)
        return torch.stack((zero, gain, zero, zero), dim=-1).unsqueeze(-1)


def true_parameters() -> Tensor:
    """theta of the two-state plant's drift, (3, 2), float64."""
    return torch.tensor(_TRUE, dtype=torch.float64)


def regressor(x: Tensor) -> Tensor:
    """s(x) = (x1, x2, x2 (1 - (cos 2 x1 + 2)^2)): (..., 2) -> (..., 3)."""
    x1, x2 = x.unbind(-1)
    return torch.stack((x1, x2, x2 * (1 - input_gain(x1).square())), dim=-1)


def apply(theta: Tensor, s: Tensor) -> Tensor:
    """theta's: (..., 3, 2), (..., 3) -> (..., 2)."""
    return (theta.to(s) * s.unsqueeze(-1)).sum(-2)


def input_gain(x1: Tensor) -> Tensor:
    """cos 2 x1 + 2, the second entry of g."""
    return (2 * x1).cos() + 2


def desired_rate(desired: Tensor) -> Tensor:
    """hd(xd): (..., 2) -> (..., 2)."""
    d1, d2 = desired.unbind(-1)
    return torch.stack((d2 - d1, d2 - 2 * d1), dim=-1)


def feedforward(desired: Tensor, theta: Tensor) -> Tensor:
    """ud = gd+ (hd - theta' s(xd)): (..., 2), (..., 3, 2) -> (...)."""
    wanted = desired_rate(desired) - apply(theta, regressor(desired))
    return wanted[..., 1] / input_gain(desired[..., 0])


def _theta(name: str, value: Tensor | list[list[float]]) -> Tensor:
    rows = value.tolist() if isinstance(value, Tensor) else value
    if len(rows) != 3:
        raise ValueError(f"`TwoStateTracking({name}=...)` must be (3, 2); got {rows!r}.")
    return torch.tensor([vector("TwoStateTracking", name, row, 2) for row in rows], dtype=torch.float64)
