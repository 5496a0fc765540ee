"""A plant as a Gymnasium environment, alone or in many rows as one tensor program, and their names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from ..adp import Cost
from ..numerics.checks import integer
from .episodes import (
    NAMES,
    Episodes,
    NamedPlant,
    Numbers,
    make_bounds,
    make_cost,
    make_plant,
    make_spaces,
    make_spread,
    start,
    to_control,
)

Flags = np.ndarray[Any, np.dtype[np.bool_]]


class PlantEnv(gymnasium.Env):
    """Regulate a plant to the origin: the observation is x, the action u is held for dt, the reward is
    -int (x'Qx + u'Ru) dt over that time.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("staf_torch/TwoState-v0")
        >>> observation, _ = env.reset(seed=0)
        >>> observation.shape
        (2,)

        Shown by `staf_torch/envs/README.md`.

    Args:
        plant: the name of a plant of `systems`, a class of your own or its dotted path, or a plant.
        cost: the cost rate; x'x + u'u by default.
        dt: s.
        horizon: s; the episode is truncated there.
        spread: initial states are uniform in [-spread, spread]^n, by default the plant's own;
            `reset(options={"state": x})` sets one.
        bound: largest |u_i|; an action beyond it is refused. None for the bounds of the cost or the plant, or
            20 where there are none.
        limit: an episode whose |x| would exceed it terminates.
        penalty: cost of that.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        plant: NamedPlant = "TwoState",
        cost: Cost | None = None,
        *,
        dt: float = 0.01,
        horizon: float = 10.0,
        spread: float | Sequence[float] | None = None,
        bound: float | None = None,
        limit: float = 100.0,
        penalty: float = 1e4,
    ) -> None:
        self.plant = make_plant(plant)
        self.cost = make_cost(self.plant, cost)
        self.bounds = make_bounds(self.plant, self.cost, bound)
        self.episodes = Episodes(
            self.plant, self.cost, 1, dt=dt, horizon=horizon, limit=limit, penalty=penalty
        )
        self.observation_space, self.action_space = make_spaces(self.plant, limit, self.bounds)
        self.spread = make_spread("PlantEnv", self.plant, spread)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        """A new episode: its first observation."""
        super().reset(seed=seed)
        x0 = start(options, [self.np_random], self.spread, self.episodes.state.shape[1])
        self.episodes.begin(torch.ones(1, dtype=torch.bool, device="cpu"), x0)
        return self._observation(), {}

    def step(self, action: Numbers | Tensor) -> tuple[Numbers, float, bool, bool, dict[str, Any]]:
        """Hold the action for dt: observation, reward, terminated, truncated and no info.

        Raises:
            ValueError: if the action is not in the action space.
        """
        u = to_control(action, (self.plant.inputs,), self.bounds)
        reward, terminated, truncated = self.episodes.step(u.unsqueeze(0))
        return self._observation(), float(reward), bool(terminated), bool(truncated), {}

    def _observation(self) -> Numbers:
        return self.episodes.state[0].numpy().copy()


class PlantVectorEnv(VectorEnv):
    """`PlantEnv` in B rows that never touch each other: row b is the single environment seeded seed + b.

    Example:
        >>> import gymnasium
        >>> plants = gymnasium.make_vec("staf_torch/TwoState-v0", num_envs=1000)
        >>> observations, _ = plants.reset(seed=0)
        >>> observations.shape
        (1000, 2)

        Shown by `staf_torch/envs/README.md`.

    Args:
        plant, cost, dt, horizon, spread, bound, limit, penalty: as in `PlantEnv`.
        num_envs: B; that of the rows where plant or cost have numbers of a row's own (`staf_torch.rows`).
        autoreset_mode: when a finished row begins anew: at its next step, whose action is then ignored
            (Gymnasium's default), in the same step (the last observation is ``info["final_obs"]``), or by
            ``reset(options={"reset_mask": mask})`` alone.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        plant: NamedPlant = "TwoState",
        cost: Cost | None = None,
        *,
        num_envs: int = 1,
        dt: float = 0.01,
        horizon: float = 10.0,
        spread: float | Sequence[float] | None = None,
        bound: float | None = None,
        limit: float = 100.0,
        penalty: float = 1e4,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.num_envs = integer("PlantVectorEnv", "num_envs", num_envs, least=1)
        self.mode = AutoresetMode(autoreset_mode)
        self.metadata = {**type(self).metadata, "autoreset_mode": self.mode}
        self.plant = make_plant(plant)
        self.cost = make_cost(self.plant, cost)
        self.bounds = make_bounds(self.plant, self.cost, bound)
        self.episodes = Episodes(
            self.plant, self.cost, num_envs, dt=dt, horizon=horizon, limit=limit, penalty=penalty
        )
        self.single_observation_space, self.single_action_space = make_spaces(self.plant, limit, self.bounds)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.spread = make_spread("PlantVectorEnv", self.plant, spread)
        self._generators: list[np.random.Generator] = []
        self._over = torch.zeros(num_envs, dtype=torch.bool, device="cpu")

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        """New episodes in all rows, or in those of ``options["reset_mask"]``: the observations."""
        if seed is not None or not self._generators:
            count = range(self.num_envs)
            seeds = seed if isinstance(seed, list) else [None if seed is None else seed + k for k in count]
            self._generators = [gymnasium.utils.seeding.np_random(one)[0] for one in seeds]
        mask = None if options is None else options.get("reset_mask")
        rows = (
            torch.ones_like(self._over)
            if mask is None
            else torch.as_tensor(mask, dtype=torch.bool, device=getattr(mask, "device", "cpu"))
        )
        self._begin(rows, options)
        return self._observation(), {}

    def step(self, actions: Numbers | Tensor) -> tuple[Numbers, Numbers, Flags, Flags, dict[str, Any]]:
        """Hold the actions (B, m) for dt: observations, rewards, terminated, truncated, info.

        Raises:
            ValueError: if an action is not in the action space.
        """
        u = to_control(actions, (self.num_envs, self.plant.inputs), self.bounds)
        anew = self._over if self.mode is AutoresetMode.NEXT_STEP else torch.zeros_like(self._over)
        reward, terminated, truncated = self.episodes.step(u)
        if bool(anew.any()):
            self._begin(anew, None)
            reward = torch.where(anew, 0.0, reward)
            terminated, truncated = terminated & ~anew, truncated & ~anew
        self._over = terminated | truncated
        info: dict[str, Any] = {}
        if self.mode is AutoresetMode.SAME_STEP and bool(self._over.any()):
            over = self._over.numpy().copy()
            final = np.full(self.num_envs, None, dtype=object)
            for row in np.flatnonzero(over):
                final[row] = self.episodes.state[row].numpy().copy()
            info = {"final_obs": final, "_final_obs": over, "final_info": {}, "_final_info": over.copy()}
            self._begin(self._over, None)
        return self._observation(), reward.numpy(), terminated.numpy(), truncated.numpy(), info

    def _begin(self, rows: Tensor, options: dict[str, Any] | None) -> None:
        # A row draws from its own generator, and only when it begins: no row depends on another.
        dim = self.episodes.state.shape[1]
        chosen = rows.nonzero().flatten().tolist()
        x0 = self.episodes.state.clone()
        if options is not None and options.get("state") is not None:
            x0 = start(options, self._generators, self.spread, dim)
        elif chosen:
            x0[rows] = start(None, [self._generators[row] for row in chosen], self.spread, dim)
        self.episodes.begin(rows, x0)
        self._over = self._over & ~rows

    def _observation(self) -> Numbers:
        return self.episodes.state.numpy().copy()


PLANTS = {f"staf_torch/{name}-v0": name for name in NAMES}
"""Id of the environment: name of its plant."""
OWN_PLANT = "staf_torch/Plant-v0"
"""Id of the environment of your own plant: ``gymnasium.make_vec(OWN_PLANT, plant="my_module.Rocket")``."""


def register_plants() -> None:
    """Register every plant with Gymnasium, once.

    Example:
        >>> import gymnasium
        >>> envs.register_plants()  # done by `import staf_torch.envs` already; twice does no harm
        >>> any(name.startswith("staf") for name in gymnasium.registry)
        True

        Shown by `staf_torch/envs/README.md`.
    """
    for name, plant in (*PLANTS.items(), (OWN_PLANT, None)):
        if name not in gymnasium.registry:
            gymnasium.register(
                name,
                entry_point="staf_torch.envs:PlantEnv",
                vector_entry_point="staf_torch.envs:PlantVectorEnv",
                kwargs={} if plant is None else {"plant": plant},
            )
