"""Episodes of a plant, and Gymnasium environments of them: one alone, or rows as one tensor program."""

from __future__ import annotations

import math
import pkgutil
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from .. import systems
from ..adp import Controller, Cost, QuadraticCost
from ..adp.loop.step import ClosedLoop, LoopState
from ..adp.problem.rules import check_problem
from ..lanes.gradients import refuse_gradient
from ..lanes.per_row.objects import counts_of_rows
from ..lanes.row_numbers import all_rows, over_rows
from ..numerics.checks import choice, fail, integer, one_or_each, positive, positive_real
from ..systems import Bounds, ControlAffineSystem

NamedPlant = str | type[ControlAffineSystem] | ControlAffineSystem
_ACTION = 20.0  # the largest action where neither plant nor cost states bounds
Numbers = np.ndarray[Any, np.dtype[np.float64]]
NAMES = tuple(
    name
    for name, plant in vars(systems).items()
    if isinstance(plant, type) and issubclass(plant, ControlAffineSystem) and plant.dim and plant.inputs
)
"""The plants of `systems` with inputs and a number of states, by the name of their class."""


def make_plant(plant: NamedPlant) -> ControlAffineSystem:
    """Return the plant given, or one of the class, the name in `systems` or the dotted path given."""
    made: object = plant
    if isinstance(plant, str) and "." in plant:
        try:
            made = pkgutil.resolve_name(plant)
        except (ImportError, AttributeError, ValueError) as error:
            raise fail("PlantEnv", "plant", f"cannot be imported ({error})", plant) from error
    elif isinstance(plant, str):
        made = getattr(systems, str(choice("PlantEnv", "plant", plant, NAMES)))
    if isinstance(made, type):
        made = made()
    if not isinstance(made, ControlAffineSystem) or made.dim is None or not made.inputs:
        raise fail("PlantEnv", "plant", "must be a ControlAffineSystem with states and inputs", made)
    return made


def to_control(action: Numbers | Tensor, shape: tuple[int, ...], bounds: Bounds) -> Tensor:
    """An action of NumPy or torch as float64, in the action space.

    Raises:
        ValueError: if it has another shape or leaves the bound: nothing is clipped behind your back.
    """
    u = torch.as_tensor(action, device=getattr(action, "device", "cpu")).detach().to("cpu", torch.float64)
    if u.shape != shape:
        raise fail("step", "action", f"must have the shape {shape}", tuple(u.shape))
    low, high = (all_rows(limit).expand(shape) for limit in (bounds.low, bounds.high))
    outside = ~((u >= low) & (u <= high)).reshape(-1, shape[-1]).all(-1)
    if bool(outside.any()):
        row = int(outside.nonzero()[0])
        sides = (limit.reshape(-1, shape[-1])[row].tolist() for limit in (low, high))
        box = ", ".join(f"[{a:g}, {b:g}]" for a, b in zip(*sides, strict=True))
        rule = f"must lie in {box} (make the environment with a larger `bound`, or clip)"
        raise fail("step", "action", rule, u)
    return u


def start(options: dict[str, Any] | None, generators: list[np.random.Generator], spread: Numbers) -> Tensor:
    """The initial states, (B, n): those of options["state"], or uniform in [-spread, spread]^n, a generator
    a row.

    Raises:
        ValueError: if the stated ones have another shape or are not finite.
    """
    stated = None if options is None else options.get("state")
    if stated is None:
        return torch.stack([torch.from_numpy(g.uniform(-spread, spread)) for g in generators])
    states = torch.as_tensor(stated, device=getattr(stated, "device", "cpu")).to("cpu", torch.float64)
    if states.dim() == 1:
        states = states.expand(len(generators), -1)
    if states.shape != (len(generators), len(spread)) or not bool(torch.isfinite(states).all()):
        raise fail(
            "reset", 'options["state"]', f"must be ({len(generators)}, {len(spread)}) and finite", states
        )
    return states.clone()


class _HeldControl(Controller):
    """u = what is carried: whoever steps the environment chooses it."""

    def init(self, x0: Tensor) -> Tensor:
        return x0.new_zeros(x0.shape[0], 0)

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        return carried, carried


class Episodes:
    """B episodes of one plant: the control is held for dt, the reward is minus the cost of that time.

    The steps are those of `adp.simulate`, so that the rewards of an episode add up to minus its cost.

    Example:
        >>> plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> episodes = envs.Episodes(plant, cost, 3, dt=0.01, horizon=1.0, limit=100.0, penalty=1e4)
        >>> type(episodes).__name__
        'Episodes'

        Shown by `staf_torch/envs/README.md`.

    Args:
        system: the plant, with inputs.
        cost: the cost rate.
        rows: B.
        dt: s.
        horizon: s; an episode is truncated there.
        limit: an episode terminates when its state would exceed it in norm, or become non-finite; the state
            then stays at its last good values.
        penalty: cost of that, so that leaving never pays.

    Attributes:
        state: x, (B, n).
        age: steps of each episode so far, (B,).

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        system: ControlAffineSystem,
        cost: Cost,
        rows: int,
        *,
        dt: float,
        horizon: float,
        limit: float,
        penalty: float,
    ) -> None:
        positive_real("Episodes", "horizon", horizon)
        check_problem(system, cost)
        self.loop = ClosedLoop(_HeldControl(), system, cost, dt=dt, limit=limit)
        self.steps = math.ceil(horizon / self.loop.dt - 1e-9)
        self.penalty = positive_real("Episodes", "penalty", penalty)
        for count in counts_of_rows(system, cost) - {rows}:
            rule = f"must be {count}, as many rows as plant and cost have numbers of (`PlantVectorEnv`)"
            raise fail("Episodes", "rows", rule, rows)
        self.state = all_rows(cost.q).new_zeros(rows, cost.dim)
        self.age = torch.zeros(rows, dtype=torch.int64, device="cpu")

    def begin(self, rows: Tensor, x0: Tensor) -> None:
        """New episodes in the rows of a mask (B,), from x0 (B, n)."""
        self.state = torch.where(rows.unsqueeze(-1), x0.to(self.state), self.state)
        self.age = torch.where(rows, 0, self.age)

    def step(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hold u (B, m) for dt: reward, terminated and truncated, (B,) each.

        Raises:
            ValueError: if u has another shape.
        """
        wanted = (len(self.state), self.loop.cost.inputs)
        if u.shape != wanted:
            raise fail("Episodes.step", "u", f"must have the shape {wanted}", tuple(u.shape))
        refuse_gradient("Episodes.step", u=u)
        alive = torch.ones_like(self.age, dtype=torch.bool)
        none = self.state.new_zeros(len(u))
        before = LoopState(self.state, none, alive, self.age, none, u.to(self.state))
        with torch.no_grad():
            after, _ = over_rows(self.loop, before, self.state.new_zeros(len(u), 0, self.state.shape[1]))
        self.state = after.x
        self.age = self.age + 1
        reward = -torch.where(after.alive, after.cost, self.penalty)
        return reward, ~after.alive, self.age >= self.steps


Flags = np.ndarray[Any, np.dtype[np.bool_]]


class _Regulated:
    """What both environments have: a plant, its cost, the bounds of the actions and the episodes."""

    def _prepare(
        self,
        rows: int,
        plant: NamedPlant,
        cost: Cost | None,
        spread: float | Sequence[float] | None,
        bound: float | None,
        limit: float,
        **more: float,
    ) -> tuple[spaces.Box, spaces.Box]:
        """Check the arguments, and return the spaces of observations and actions."""
        call = type(self).__name__
        self.plant = make_plant(plant)
        dim, inputs = self.plant._size(), self.plant.inputs
        self.cost = QuadraticCost(1.0, 1.0, dim, inputs) if cost is None else cost
        if bound is not None:
            self.bounds = Bounds(-positive_real(call, "bound", bound), bound, inputs)
        else:
            self.bounds = self.cost.around(self.plant).bounds or Bounds(-_ACTION, _ACTION, inputs)
        self.episodes = Episodes(self.plant, self.cost, rows, limit=limit, **more)
        wide = one_or_each(call, "spread", self.plant.spread if spread is None else spread, dim)
        self.spread = positive(call, "spread", wide).numpy()
        low, high = (all_rows(end).reshape(-1, inputs) for end in (self.bounds.low, self.bounds.high))
        actions = spaces.Box(low.amin(0).numpy(), high.amax(0).numpy(), (inputs,), np.float64)
        return spaces.Box(-limit, limit, (dim,), np.float64), actions


class PlantEnv(_Regulated, gymnasium.Env):
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
        self.observation_space, self.action_space = self._prepare(
            1, plant, cost, spread, bound, limit, dt=dt, horizon=horizon, penalty=penalty
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Numbers, dict[str, Any]]:
        """A new episode: its first observation."""
        super().reset(seed=seed)
        x0 = start(options, [self.np_random], self.spread)
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


class PlantVectorEnv(_Regulated, VectorEnv):
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
        self.single_observation_space, self.single_action_space = self._prepare(
            self.num_envs, plant, cost, spread, bound, limit, dt=dt, horizon=horizon, penalty=penalty
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
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
        chosen = rows.nonzero().flatten().tolist()
        x0 = self.episodes.state.clone()
        if options is not None and options.get("state") is not None:
            x0 = start(options, self._generators, self.spread)
        elif chosen:
            x0[rows] = start(None, [self._generators[row] for row in chosen], self.spread)
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
