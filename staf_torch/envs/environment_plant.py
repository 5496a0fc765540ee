"""A Gymnasium environment as a plant: put into a state, stepped, and read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from ..numerics.checks import fail
from ..systems import StepPlant
from ..systems.base import Limit
from ..systems.user_plants import Guess
from .episodes import Numbers

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
