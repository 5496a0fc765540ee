"""A controller or a policy of `adp` in an environment."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .._checks import positive_real
from ..adp import Controller, Feedback, Memory
from .settings import Numbers

Policy = Callable[[Tensor], Tensor]
"""u from x: (..., n) -> (..., m)."""


class Agent:
    """Observations of NumPy in, actions of NumPy out, from a feedback law or a learning controller.

    A learning controller learns on from step to step, row by row; `begin` makes it forget.

    Example:
        >>> env = gymnasium.make("staf_torch/TwoState-v0")
        >>> agent = envs.Agent(adp.LQR(env.unwrapped.plant, env.unwrapped.cost))
        >>> observation, _ = env.reset(seed=0)
        >>> agent(observation).shape
        (1,)

    Args:
        controller: a `Controller`, or a policy (..., n) -> (..., m).
        dt: s, between two actions.
        seed: of the random numbers that the controller draws; row b draws from seed + b, as in
            `adp.simulate`.
    """

    def __init__(self, controller: Controller | Policy, *, dt: float = 0.01, seed: int = 0) -> None:
        self.controller = controller if isinstance(controller, Controller) else Feedback(controller)
        self.dt, self.seed = positive_real("Agent", "dt", dt), seed
        self._memory: Memory | None = None
        self._generators: list[torch.Generator] = []

    def begin(self) -> None:
        """Forget what was learned, and draw the same random numbers again."""
        self._memory = None

    def __call__(self, observation: Numbers | Tensor) -> Numbers:
        """u: (n,) -> (m,), or (B, n) -> (B, m) with the same B until the next `begin`."""
        seen = torch.as_tensor(observation).to("cpu", torch.float64)
        x = seen.reshape(-1, seen.shape[-1])
        with torch.no_grad():
            if self._memory is None:
                self._memory = self.controller.init(x)
                self._generators = [torch.Generator().manual_seed(self.seed + row) for row in range(len(x))]
            u, self._memory = self.controller.step(x, self._memory, self._uniform(x), self.dt)
        action: Numbers = u.reshape(*seen.shape[:-1], -1).numpy()
        return action

    def _uniform(self, x: Tensor) -> Tensor:
        draws = self.controller.draws
        if not draws:
            return x.new_zeros(len(x), 0, x.shape[-1])
        shape = (draws, x.shape[-1])
        rows = [torch.rand(*shape, dtype=x.dtype, generator=generator) for generator in self._generators]
        return 2 * torch.stack(rows) - 1
