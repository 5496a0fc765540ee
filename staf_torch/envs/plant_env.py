"""One plant as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import torch
from torch import Tensor

from .._checks import positive_real
from ..adp import Cost
from .episodes import Episodes
from .settings import Numbers, Plant, make_cost, make_plant, make_spaces, start, to_control


class PlantEnv(gymnasium.Env):
    """Regulate a plant to the origin: the observation is x, the action u is held for dt, the reward is
    -int (x'Qx + u'Ru) dt over that time.

    Example:
        >>> env = gymnasium.make("staf_torch/TwoState-v0")
        >>> observation, _ = env.reset(seed=0)

    Args:
        plant: the name of a plant of `systems`, or a plant.
        cost: the cost rate; x'x + u'u by default.
        dt: s.
        horizon: s; the episode is truncated there.
        spread: initial states are uniform in [-spread, spread]^n; `reset(options={"state": x})` sets one.
        bound: largest |u_i|; an action beyond it is refused.
        limit: an episode whose |x| would exceed it terminates.
        penalty: cost of that.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        plant: Plant = "TwoState",
        cost: Cost | None = None,
        *,
        dt: float = 0.01,
        horizon: float = 10.0,
        spread: float = 1.0,
        bound: float = 20.0,
        limit: float = 100.0,
        penalty: float = 1e4,
    ) -> None:
        self.plant = make_plant(plant)
        self.cost = make_cost(self.plant, cost)
        self.observation_space, self.action_space = make_spaces(self.plant, limit, bound)
        self.episodes = Episodes(
            self.plant, self.cost, 1, dt=dt, horizon=horizon, limit=limit, penalty=penalty
        )
        self.bound, self.spread = bound, positive_real("PlantEnv", "spread", spread)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        """A new episode: its first observation."""
        super().reset(seed=seed)
        x0 = start(options, [self.np_random], self.spread, self.episodes.state.shape[1])
        self.episodes.begin(torch.ones(1, dtype=torch.bool), x0)
        return self._observation(), {}

    def step(self, action: Numbers | Tensor) -> tuple[Numbers, float, bool, bool, dict[str, Any]]:
        """Hold the action for dt: observation, reward, terminated, truncated and no info.

        Raises:
            ValueError: if the action is not in the action space.
        """
        u = to_control(action, (self.plant.inputs,), self.bound)
        reward, terminated, truncated = self.episodes.step(u.unsqueeze(0))
        return self._observation(), float(reward), bool(terminated), bool(truncated), {}

    def _observation(self) -> Numbers:
        seen: Numbers = self.episodes.state[0].numpy().copy()
        return seen
