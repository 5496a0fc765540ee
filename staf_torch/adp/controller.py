"""What a controller in a closed loop is; feedback laws without memory."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor, nn


class Memory(NamedTuple):
    """What a controller carries from step to step. Feedback laws leave all of it empty."""

    critic: Tensor  # Wc, (B, M)
    actor: Tensor  # Wa, (B, M)
    gain: Tensor  # Gam or Lam, (B, M, M)
    identifier: Tensor  # what an identifier of the plant remembers, (B, K)


class Controller(nn.Module, abc.ABC):
    """u and the next memory, from the state and the memory.

    Attributes:
        draws: uniform random points of [-1, 1]^n that a step needs, a row.
    """

    draws: int = 0

    @abc.abstractmethod
    def init(self, x0: Tensor) -> Memory:
        """The memory before the first step: (B, n) -> rows of it."""

    @abc.abstractmethod
    def step(self, x: Tensor, memory: Memory, uniform: Tensor, dt: float) -> tuple[Tensor, Memory]:
        """The control to hold for ``dt`` seconds, and the memory after them.

        Args:
            x: (B, n).
            memory: rows of it.
            uniform: (B, draws, n), uniform on [-1, 1].
            dt: s.

        Returns:
            u (B, m) and the next memory.
        """

    def value(self, x: Tensor, memory: Memory) -> Tensor | None:
        """V^(x) where the controller has an idea of it: (..., n) -> (...)."""
        return None


class Feedback(Controller):
    """u = policy(x), without memory.

    Args:
        policy: (..., n) -> (..., m).
        value: of the policy or of its design, (..., n) -> (...), for the record.
    """

    def __init__(
        self, policy: Callable[[Tensor], Tensor], value: Callable[[Tensor], Tensor] | None = None
    ) -> None:
        super().__init__()
        self.policy = policy
        self._value = value

    def init(self, x0: Tensor) -> Memory:
        empty = x0.new_zeros(x0.shape[0], 0)
        return Memory(empty, empty, x0.new_zeros(x0.shape[0], 0, 0), empty)

    def step(self, x: Tensor, memory: Memory, uniform: Tensor, dt: float) -> tuple[Tensor, Memory]:
        return self.policy(x), memory

    def value(self, x: Tensor, memory: Memory) -> Tensor | None:
        return None if self._value is None else self._value(x)
