"""Environments of others: one as a plant, put into a state, stepped and read, and agents that play in one."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from ..adp import Controller, Feedback
from ..adp.loop.controller import Carried, Policy
from ..adp.loop.step import points_of_steps
from ..lanes.row_numbers import over_rows
from ..numerics.checks import choice, fail, positive_real
from ..numerics.runge_kutta import runge_kutta_step
from ..systems import StepPlant
from ..systems.base import Limit
from ..systems.user_plants import Guess
from .plant_env import Numbers

Read = Callable[[Any], Numbers]
"""x (n,) of an environment without its wrappers."""
Write = Callable[[Any, Numbers], None]
"""Put such an environment into the state x (n,)."""


class EnvironmentPlant(StepPlant):
    """x+ = where one step of a Gymnasium environment leads from x under the action u.

    Any environment will do that can be put into a state. Those of MuJoCo (x = (qpos, qvel)) and of classic
    control (x = ``env.unwrapped.state``) need no more than their name; of another one say how, by ``read``
    and ``write``. Every row is one step of the environment, in turn: `systems.MujocoPlant` and
    `envs.classic_control` are faster where they fit.

    Example:
        >>> plant = envs.EnvironmentPlant("Pendulum-v1", periodic=[0])
        >>> lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
        >>> lqr.k.shape
        torch.Size([1, 2])

        Shown by `staf_torch/envs/README.md`.

    Args:
        env: an environment or its id. Its actions must be a vector of numbers (a Box).
        read: the state of ``env.unwrapped``, an array (n,).
        write: puts ``env.unwrapped`` into a state.
        dt: s, the time of a step; None for the ``dt`` of the environment.
        periodic: coordinates that are angles in rad.
        equilibrium: as in `StepPlant`.
        low: of the inputs; None for those of the action space.
        high: likewise.

    Raises:
        ValueError: if the actions are no Box, the environment cannot be put into a state or does not have its
            ``dt``, or as in `StepPlant`.
    """

    def __init__(
        self,
        env: str | gymnasium.Env,
        *,
        read: Read | None = None,
        write: Write | None = None,
        dt: float | None = None,
        periodic: Sequence[int] = (),
        equilibrium: Guess = None,
        low: Limit = None,
        high: Limit = None,
    ) -> None:
        made = gymnasium.make(env) if isinstance(env, str) else env
        inside: Any = made.unwrapped
        actions = made.action_space
        if not isinstance(actions, spaces.Box) or len(actions.shape) != 1:
            rule = "must have actions that are a vector of numbers (a Box)"
            raise fail("EnvironmentPlant", "env", rule, f"{actions} of {env}")
        if (read is None) != (write is None):
            raise fail("EnvironmentPlant", "read", "and write go together", None)
        inside.reset(seed=0)
        if read is None or write is None:
            read, write = _access(inside, env)
        period = getattr(inside, "dt", None) if dt is None else dt
        if period is None:
            raise fail("EnvironmentPlant", "dt", "must be given, in s: the environment has no `dt`", None)
        self.env = made
        unbounded = low is None and high is None
        super().__init__(
            _Stepped(inside, read, write),
            dim=len(np.asarray(read(inside))),
            inputs=actions.shape[0],
            dt=float(period),
            periodic=periodic,
            equilibrium=equilibrium,
            low=actions.low.tolist() if unbounded else low,
            high=actions.high.tolist() if unbounded else high,
        )


class _Stepped:
    """Step an environment once for every row."""

    def __init__(self, env: Any, read: Read, write: Write) -> None:
        self.env, self.read, self.write = env, read, write

    def __call__(self, x: Numbers, u: Numbers) -> Numbers:
        """x+: (B, n), (B, m) -> (B, n)."""
        if isinstance(x, torch.Tensor):
            raise TypeError("an environment takes NumPy arrays")
        after = np.empty_like(x)
        for row in range(len(x)):
            self.write(self.env, x[row])
            self.env.step(u[row])  # in float64: rounded to the action's float32 it had no smooth slope
            after[row] = self.read(self.env)
        return after


def _access(env: Any, named: object) -> tuple[Read, Write]:
    """Return the functions that read and write the state of an environment of MuJoCo or classic control."""
    if hasattr(env, "set_state") and hasattr(env, "data"):
        size = len(env.data.qpos)
        return (
            lambda env: np.concatenate((env.data.qpos, env.data.qvel)),
            lambda env, x: env.set_state(x[:size], x[size:]),
        )
    if hasattr(env, "state"):
        return lambda env: np.array(env.state), lambda env, x: setattr(env, "state", np.array(x))
    rule = "and write must be given: how to set the state is not known"
    raise fail("EnvironmentPlant", "read", rule, named)


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


class Agent:
    """Observations of NumPy in, actions of NumPy out, from a feedback law or a learning controller.

    A learning controller learns on from step to step, row by row; `begin` makes it forget.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("staf_torch/TwoState-v0")
        >>> agent = envs.Agent(adp.LQR(env.unwrapped.plant, env.unwrapped.cost))
        >>> observation, _ = env.reset(seed=0)
        >>> agent(observation).shape
        (1,)

        Shown by `staf_torch/envs/README.md`.

    Args:
        controller: a `Controller`, or a policy (..., n) -> (..., m).
        dt: s, between two actions.
        seed: of the random numbers that the controller draws; row b draws from seed + b, as in
            `adp.simulate`.
        state: the plant's state from an observation, (..., k) -> (..., n) of NumPy arrays, where an
            environment shows another thing: the sine and cosine of an angle, say.
        action: the action from a control, (..., m) of NumPy, where an environment wants another thing: the
            number of one of its actions, say.
    """

    def __init__(
        self,
        controller: Controller | Policy,
        *,
        dt: float = 0.01,
        seed: int = 0,
        state: Callable[[Numbers], Numbers] | None = None,
        action: Callable[[Numbers], Any] | None = None,
    ) -> None:
        self.controller = controller if isinstance(controller, Controller) else Feedback(controller)
        self.dt, self.seed = positive_real("Agent", "dt", dt), seed
        self.state, self.action = state, action
        self._carried: Carried | None = None
        self._steps = 0  # since `begin`

    def begin(self) -> None:
        """Forget what was learned, and begin the sequence of random numbers anew."""
        self._carried = None

    def __call__(self, observation: Numbers | Tensor) -> Any:
        """u, or the action that stands for it: (n,) -> (m,), or (B, n) -> (B, m) with the same B until the
        next `begin`."""
        shown = observation if self.state is None else self.state(np.asarray(observation))
        seen = torch.as_tensor(shown, device=getattr(shown, "device", "cpu")).to("cpu", torch.float64)
        x = seen.reshape(-1, seen.shape[-1])
        with torch.no_grad():
            if self._carried is None:
                self._carried = over_rows(self.controller.init, x)
                self._steps = 0
            seeds = range(self.seed, self.seed + len(x))
            uniform = points_of_steps(x, seeds, self._steps, 1, self.controller.draws)[:, 0]
            self._steps += 1
            step = functools.partial(self.controller.step, dt=self.dt)
            u, self._carried = over_rows(step, x, self._carried, uniform)
        control: Numbers = u.reshape(*seen.shape[:-1], -1).numpy()
        return control if self.action is None else self.action(control)
