"""What moves among discs in the experiment `avoidance`: a mass, or a unicycle."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from ..adp import LQR, QuadraticCost
from ..adp.loop.controller import Policy
from ..numerics.checks import COMMAND_LINE, choice, positive_real
from ..systems import Linear


class Vehicle(NamedTuple):
    """What moves among the discs."""

    label: str  # of the policy
    size: int  # states, of which the first two are the place
    rate: Callable[[Tensor, Tensor], Tensor]  # x' of these: (..., size), (..., 2) -> (..., size)
    policy: Policy  # (..., size) -> (..., 2)
    bounds: tuple[float, float]  # of the two inputs
    point: Callable[[Tensor], Tensor]  # that is kept away from the discs: (..., size) -> (..., 2)
    reach: float  # m, of the vehicle from that point


def _mass(cfg: DictConfig, dt: float, bound: float) -> Vehicle:
    """p'' = u under its LQR."""
    matrix, push = torch.zeros(4, 4, dtype=torch.float64), torch.zeros(4, 2, dtype=torch.float64)
    matrix[0, 2] = matrix[1, 3] = push[2, 0] = push[3, 1] = 1.0
    cost = QuadraticCost(cfg.adp.q, cfg.adp.r, 4, 2, low=-bound, high=bound)
    lqr = LQR(Linear(matrix.tolist(), push.tolist()), cost, period=dt)

    def rate(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 2:], u), dim=-1)

    return Vehicle("LQR", 4, rate, lqr, (bound, bound), lambda x: x[..., :2], 0.0)


def _unicycle(cfg: DictConfig, dt: float, bound: float) -> Vehicle:
    """p' = v (cos, sin), heading' = w: the point ahead of it goes straight to the origin.

    Speed and turning both move that point, the turning alone not the place: only there has a disc a relative
    degree of one. The bound of w lets the point move sideways as fast as ahead.
    """
    ahead = positive_real(COMMAND_LINE, "avoidance.ahead", cfg.avoidance.ahead)

    def direction(x: Tensor) -> Tensor:
        return torch.stack((x[..., 2].cos(), x[..., 2].sin()), dim=-1)

    def rate(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((u[..., :1] * direction(x), u[..., 1:]), dim=-1)

    def point(x: Tensor) -> Tensor:
        return x[..., :2] + ahead * direction(x)

    def policy(x: Tensor) -> Tensor:
        along = direction(x)
        wanted = -point(x)
        forward = (along * wanted).sum(-1)
        aside = along[..., 0] * wanted[..., 1] - along[..., 1] * wanted[..., 0]
        return torch.stack((forward, aside / ahead), dim=-1)

    return Vehicle("lookahead", 3, rate, policy, (bound, bound / ahead), point, ahead)


VEHICLES = {"mass": _mass, "unicycle": _unicycle}


def vehicle(cfg: DictConfig, dt: float) -> Vehicle:
    """Build what `avoidance.vehicle` names, whose control is held for dt."""
    name = str(choice(COMMAND_LINE, "avoidance.vehicle", cfg.avoidance.vehicle, tuple(VEHICLES)))
    return VEHICLES[name](cfg, dt, positive_real(COMMAND_LINE, "avoidance.bound", cfg.avoidance.bound))
