"""The plants on which methods are compared: one text of the equations for torch and for CasADi."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..adp import QuadraticCost, SampledProblem, TrackingCost
from ..systems import Clocked, Plant, RatePlant, StepPlant

Equations = Callable[[Any, Sequence[Any], Sequence[Any]], Sequence[Any]]
"""(a module with sin, cos, fmin, fmax, coordinates of x, those of u) -> those of x' or x+."""


class TorchMath:
    """The functions that equations use, under CasADi's names."""

    sin, cos = staticmethod(torch.sin), staticmethod(torch.cos)
    fmin, fmax = staticmethod(torch.clamp_max), staticmethod(torch.clamp_min)


@dataclasses.dataclass(frozen=True)
class RivalPlant:
    """A plant, its cost and its box of initial states.

    Attributes:
        equations: of x', or of x+ where ``discrete``.
        dt: s, for which a control is held.
        steps: of an episode.
        weights: diagonal of Q, and of R.
        low: of the inputs; ``high`` likewise.
        box: half the width of the box of initial states around ``target``.
        target: the set-point.
        periodic: coordinates that are angles.
        swing: whether the goal must be reached from far away, by a `GlobalValue`.
        horizon: periods that planning methods look ahead.
        path: coordinates of the state to follow from (module, t), of a plant in continuous time; None for the
            set-point. ``box`` is then around it at t = 0.
        rest: the input that holds the plant; 0 by default.
        left: share of the cost that may be left at the end of an episode that counts as regulated.
    """

    name: str
    equations: Equations
    dt: float
    steps: int
    weights: tuple[tuple[float, ...], tuple[float, ...]]
    low: tuple[float, ...]
    high: tuple[float, ...]
    box: tuple[float, ...]
    target: tuple[float, ...] | None = None
    periodic: tuple[int, ...] = ()
    discrete: bool = False
    swing: bool = False
    horizon: int = 50
    path: Callable[[Any, Any], Sequence[Any]] | None = None
    rest: tuple[float, ...] | None = None
    left: float = 1e-3

    @property
    def dim(self) -> int:
        return len(self.box)

    @property
    def inputs(self) -> int:
        return len(self.low)

    def goal(self) -> Tensor:
        """The set-point, or the path at t = 0, (n,)."""
        if self.path is not None:
            return self.way(torch.zeros((), dtype=torch.float64, device="cpu"))
        return torch.tensor(self.target or [0.0] * self.dim, dtype=torch.float64, device="cpu")

    def way(self, time: Tensor) -> Tensor:
        """The path: (...) -> (..., n)."""
        assert self.path is not None
        return torch.stack(tuple(self.path(TorchMath, time)), dim=-1)

    def plant(self) -> Plant:
        def function(x: Tensor, u: Tensor) -> Tensor:
            return torch.stack(tuple(self.equations(TorchMath, x.unbind(-1), u.unbind(-1))), dim=-1)

        given: dict[str, Any] = {
            "dim": self.dim,
            "inputs": self.inputs,
            "periodic": self.periodic,
            "low": self.low,
            "high": self.high,
            "equilibrium": self.goal() if self.rest is None else ([0.0] * self.dim, list(self.rest)),
        }
        if self.discrete:
            return StepPlant(function, dt=self.dt, **given)
        plant = RatePlant(function, **given)
        return plant if self.path is None else Clocked(plant)

    def cost(self) -> QuadraticCost:
        q, r = (torch.diag(torch.tensor(part, dtype=torch.float64, device="cpu")) for part in self.weights)
        if self.path is not None:
            return TrackingCost(q, r, self.dim, self.inputs, path=self.way)
        return QuadraticCost(q, r, self.dim, self.inputs, target=self.target)

    def problem(self) -> SampledProblem:
        return SampledProblem.of(self.plant(), self.cost(), dt=self.dt)

    def states(self, count: int, seed: int) -> Tensor:
        """Initial states, uniform in the box, with the time where there is a path: (count, n or n + 1)."""
        generator = torch.Generator().manual_seed(seed)
        uniform = torch.rand(count, self.dim, generator=generator, dtype=torch.float64, device="cpu")
        x = self.goal() + torch.tensor(self.box, dtype=torch.float64, device="cpu") * (2 * uniform - 1)
        return x if self.path is None else torch.cat((x, torch.zeros_like(x[:, :1])), dim=-1)


def mass(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """A double integrator."""
    return x[1], u[0] + 0 * x[0]


def pendulum(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """x+ of Gymnasium's Pendulum-v1."""
    rate = m.fmax(m.fmin(x[1] + 0.05 * (15.0 * m.sin(x[0]) + 3.0 * u[0]), 8.0), -8.0)
    return x[0] + 0.05 * rate, rate


def cart_pole(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """(place, angle, their rates): 1 kg, a pole of 0.1 kg, half a metre to its middle, the factor 4/3."""
    sine, cosine = m.sin(x[1]), m.cos(x[1])
    shift = (u[0] + 0.05 * x[3] * x[3] * sine) / 1.1
    bend = (9.8 * sine - cosine * shift) / (0.5 * (4 / 3 - 0.1 * cosine * cosine / 1.1))
    return x[2], x[3], shift - 0.05 * bend * cosine / 1.1, bend


def quadrotor(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """(y, z, angle, their rates) under (thrust above hover, torque): 1 kg, 0.1 kg m^2."""
    lift = 9.81 + u[0]
    return x[3], x[4], x[5], -lift * m.sin(x[2]), lift * m.cos(x[2]) - 9.81, u[1] / 0.1


def small_quadrotor(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """(x, x', z, z', theta, theta') under two thrusts, safe-control-gym's: 27 g, the arms 39.7 mm."""
    lift = (u[0] + u[1]) / 0.027
    turn = 0.0397 * (u[1] - u[0]) / (1.4e-5 * math.sqrt(2))
    return x[1], m.sin(x[4]) * lift, x[3], m.cos(x[4]) * lift - 9.81, x[5], turn


def figure_eight(m: Any, t: Any) -> Sequence[Any]:
    """A lemniscate of 0.75 m around (0, 1 m) in 6 s, without the angle that it takes."""
    turn = 2 * math.pi / 6
    sine, cosine = m.sin(turn * t), m.cos(turn * t)
    across, up = 0.75 * turn * cosine, 0.75 * turn * (cosine * cosine - sine * sine)
    return 0.75 * sine, across, 0.75 * sine * cosine + 1.0, up, 0 * t, 0 * t


_CART_POLE = RivalPlant(
    *("cart_pole_10N", cart_pole, 0.02, 250, ((1.0, 1.0, 0.1, 0.1), (0.01,))),
    *((-10.0,), (10.0,), (0.3,) * 4),
    periodic=(1,),
)
CASES = {
    case.name: case
    for case in (
        RivalPlant("double_integrator", mass, 0.1, 150, ((1.0, 1.0), (1.0,)), (-1.0,), (1.0,), (5.0, 1.0)),
        RivalPlant(
            *("pendulum", pendulum, 0.05, 200, ((20.0, 2.0), (0.02,)), (-2.0,), (2.0,), (math.pi, 1.0)),
            periodic=(0,),
            discrete=True,
            swing=True,
        ),
        _CART_POLE,
        dataclasses.replace(_CART_POLE, name="cart_pole_5N", low=(-5.0,), high=(5.0,)),
        dataclasses.replace(
            _CART_POLE,
            name="cart_pole_to_1m",
            dt=1 / 15,
            steps=90,
            weights=((5.0, 5.0, 0.1, 0.1), (0.1,)),
            box=(1.0, 0.2, 0.2, 0.2),
            target=(1.0, 0.0, 0.0, 0.0),
            horizon=20,
        ),
        RivalPlant(
            *("quadrotor", quadrotor, 0.02, 200, ((1.0,) * 6, (1.0, 1.0))),
            *((-9.81, -1.0), (9.81, 1.0), (0.4,) * 6),
            periodic=(2,),
        ),
        RivalPlant(
            "figure_eight",
            small_quadrotor,
            0.02,
            300,
            ((5.0, 0.1, 5.0, 0.1, 0.1, 0.1), (0.1, 0.1)),
            (0.0563, 0.0563),  # two rotors each at their least and most: 3.16e-10 (0.2685 PWM + 4070.3)^2 N
            (0.2967, 0.2967),
            (0.05,) * 6,
            periodic=(4,),
            horizon=20,
            path=figure_eight,
            rest=(0.5 * 0.027 * 9.81,) * 2,
            left=0.2,
        ),
        dataclasses.replace(
            _CART_POLE,
            name="cart_pole_swing_up",
            steps=300,
            box=(1.0, math.pi, 1.0, 2.0),
            swing=True,
            horizon=120,
        ),
    )
}

Steer = Callable[[Tensor], Tensor]
"""u (B, m) from x (B, n), called once a period: it may remember its last plan."""
