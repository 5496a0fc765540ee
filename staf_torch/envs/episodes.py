"""Episodes of a controlled plant, many side by side, in torch, and controllers of `adp` that play them."""

from __future__ import annotations

import functools
import math
import pkgutil
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from .. import systems
from ..adp import Controller, Cost, Feedback, QuadraticCost
from ..adp.loop.controller import Carried, Policy
from ..adp.loop.step import ClosedLoop, LoopState, points_of_steps
from ..adp.problem.rules import check_problem
from ..lanes.gradients import refuse_gradient
from ..lanes.per_row.objects import counts_of_rows
from ..lanes.row_numbers import all_rows, over_rows
from ..numerics.checks import choice, fail, one_or_each, positive, positive_real
from ..systems import Bounds, ControlAffineSystem, Plant

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


def make_cost(plant: ControlAffineSystem, cost: Cost | None) -> Cost:
    """The cost given, or x'x + u'u."""
    assert plant.dim is not None
    return QuadraticCost(1.0, 1.0, plant.dim, plant.inputs) if cost is None else cost


def make_bounds(plant: Plant, cost: Cost, bound: float | None) -> Bounds:
    """The bounds of the actions: the one given, else those of the cost or the plant, else 20."""
    if bound is not None:
        positive_real("PlantEnv", "bound", bound)
        return Bounds(-bound, bound, plant.inputs)
    known = cost.around(plant).bounds
    return Bounds(-_ACTION, _ACTION, plant.inputs) if known is None else known


def make_spaces(plant: Plant, limit: float, bounds: Bounds) -> tuple[spaces.Box, spaces.Box]:
    """Observations: the state, each coordinate within the limit. Actions: the inputs within their bounds, of
    numbers of rows the widest."""
    assert plant.dim is not None
    seen = spaces.Box(-limit, limit, (plant.dim,), np.float64)
    low, high = (all_rows(limit).reshape(-1, plant.inputs) for limit in (bounds.low, bounds.high))
    return seen, spaces.Box(low.amin(0).numpy(), high.amax(0).numpy(), (plant.inputs,), np.float64)


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


def make_spread(call: str, plant: Plant, spread: float | Sequence[float] | Tensor | None) -> float | Numbers:
    """Return half the width of the box of initial states: a number, or one a coordinate, (n,).

    Raises:
        ValueError: in the name of ``call``, if it is not positive, or not one a coordinate.
    """
    given = plant.spread if spread is None else spread
    if isinstance(given, int | float):
        return positive_real(call, "spread", given)
    each = positive(call, "spread", one_or_each(call, "spread", given, plant.equilibrium().shape[0]))
    return each.numpy()


def start(
    options: dict[str, Any] | None, generators: list[np.random.Generator], spread: float | Numbers, dim: int
) -> Tensor:
    """The initial states, (B, n): those of options["state"], or uniform in [-spread, spread]^n, a generator
    a row.

    Raises:
        ValueError: if the stated ones have another shape or are not finite.
    """
    stated = None if options is None else options.get("state")
    if stated is None:
        return torch.stack([torch.from_numpy(g.uniform(-spread, spread, dim)) for g in generators])
    states = torch.as_tensor(stated, device=getattr(stated, "device", "cpu")).to("cpu", torch.float64)
    if states.dim() == 1:
        states = states.expand(len(generators), -1)
    if states.shape != (len(generators), dim) or not bool(torch.isfinite(states).all()):
        raise fail("reset", 'options["state"]', f"must be ({len(generators)}, {dim}) and finite", states)
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
