"""Gymnasium's classic control as plants in torch: the same steps, for many rows, with derivatives."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..numerics.checks import choice
from ..numerics.runge_kutta import runge_kutta_step
from ..systems import StepPlant


def classic_control(name: str) -> StepPlant:
    """The plant inside an environment of Gymnasium's classic control, in torch.

    Example:
        >>> plant = envs.classic_control("Pendulum-v1")
        >>> plant.period, plant.periodic, plant.bounds
        (0.05, (0,), Bounds(low=[-2.0], high=[2.0]))

        Shown by `staf_torch/envs/README.md`.

    | name | state | input | rests at |
    |---|---|---|---|
    | ``Pendulum-v1`` | angle from upright, rate | torque in [-2, 2], clipped | upright |
    | ``CartPole-v1`` | place, speed, angle from upright, rate | force in [-10, 10], where the environment has the two ends alone | upright |
    | ``Acrobot-v1`` | angle of the first link from hanging, of the second from the first, their rates | torque in [-1, 1], where the environment has -1, 0 and 1 | upright |
    | ``MountainCarContinuous-v0`` | place, speed a step | force in [-1, 1], clipped | the flag, 0.45, held by a force |

    Angles are not wrapped, and an episode does not end: that is what an environment adds. A step of the
    mountain car is 1 s here.

    Args:
        name: of the environment.

    Raises:
        ValueError: if the name is none of these.

    Source: Gymnasium's documentation of each environment, which names the papers; the tests compare every
    plant step by step with the real environment.
    """  # noqa: E501
    makers = {
        "Pendulum-v1": _pendulum,
        "CartPole-v1": _cart_pole,
        "Acrobot-v1": _acrobot,
        "MountainCarContinuous-v0": _mountain_car,
    }
    return makers[str(choice("classic_control", "name", name, tuple(makers)))]()


def _pendulum() -> StepPlant:
    def step(x: Tensor, u: Tensor) -> Tensor:
        angle, rate = x.unbind(-1)
        pushed = 15.0 * angle.sin() + 3.0 * u[..., 0].clamp(-2.0, 2.0)
        after = (rate + 0.05 * pushed).clamp(-8.0, 8.0)
        return torch.stack((angle + 0.05 * after, after), dim=-1)

    return StepPlant(step, dim=2, inputs=1, dt=0.05, periodic=[0], low=-2.0, high=2.0)


def _cart_pole() -> StepPlant:
    total, lever, half_length, gravity = 1.1, 0.05, 0.5, 9.8

    def step(x: Tensor, u: Tensor) -> Tensor:
        _, speed, angle, turning = x.unbind(-1)
        sine, cosine = angle.sin(), angle.cos()
        shift = (u[..., 0] + lever * turning.square() * sine) / total
        reach = half_length * (4 / 3 - 0.1 * cosine.square() / total)
        bend = (gravity * sine - cosine * shift) / reach
        rate = torch.stack((speed, shift - lever * bend * cosine / total, turning, bend), dim=-1)
        return x + 0.02 * rate

    return StepPlant(step, dim=4, inputs=1, dt=0.02, periodic=[2], low=-10.0, high=10.0)


def _acrobot() -> StepPlant:
    # Links of 1 m and 1 kg, their centers of mass in the middle, each with an inertia of 1 kg m^2.
    gravity, dt = 9.8, 0.2
    fastest = torch.tensor([4 * math.pi, 9 * math.pi], dtype=torch.float64, device="cpu")  # rad/s

    def rate(x: Tensor, u: Tensor) -> Tensor:
        first, second, turn1, turn2 = x.unbind(-1)
        sine, cosine = second.sin(), second.cos()
        m11, m12, m22 = 3.5 + cosine, 1.25 + 0.5 * cosine, 1.25
        weight2 = 0.5 * gravity * (first + second).sin()
        weight1 = 1.5 * gravity * first.sin() + weight2
        swing1 = weight1 - 0.5 * sine * (turn2.square() + 2 * turn1 * turn2)
        pull2 = u[..., 0] - 0.5 * sine * turn1.square() - weight2
        bend2 = (pull2 + m12 / m11 * swing1) / (m22 - m12.square() / m11)
        return torch.stack((turn1, turn2, -(m12 * bend2 + swing1) / m11, bend2), dim=-1)

    def step(x: Tensor, u: Tensor) -> Tensor:
        after = runge_kutta_step(lambda at: rate(at, u), x, dt)
        limit = fastest.to(after)
        turning = torch.maximum(torch.minimum(after[..., 2:], limit), -limit)
        return torch.cat((after[..., :2], turning), dim=-1)

    upright = [math.pi, 0.0, 0.0, 0.0]
    return StepPlant(step, dim=4, inputs=1, dt=dt, periodic=[0, 1], equilibrium=upright, low=-1.0, high=1.0)


def _mountain_car() -> StepPlant:
    def step(x: Tensor, u: Tensor) -> Tensor:
        place, speed = x.unbind(-1)
        faster = speed + 0.0015 * u[..., 0].clamp(-1.0, 1.0) - 0.0025 * (3 * place).cos()
        faster = faster.clamp(-0.07, 0.07)
        after = (place + faster).clamp(-1.2, 0.6)
        at_wall = (after == -1.2) & (faster < 0)
        return torch.stack((after, torch.where(at_wall, 0.0, faster)), dim=-1)

    return StepPlant(step, dim=2, inputs=1, dt=1.0, equilibrium=[0.45, 0.0], low=-1.0, high=1.0)
