"""Result of a closed loop at the recorded times, with its picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ...lanes.tree import flatten, unflatten
from ...results import pictures
from .controller import Carried
from .picture import LoopAbout, picture, summary

OF_ROWS = ("state", "control", "running_cost", "recorded", "frozen_at", "carried")
"""Fields of a result that have the rows first."""


@dataclasses.dataclass(frozen=True, repr=False)
class LoopResult:
    """A closed loop at the recorded times 0, every dt, 2 every dt, ...

    A row whose plant, control or weights became non-finite, or whose state left the ``limit``, is frozen at
    its last good values from there on: `frozen_at` says when, and it counts as diverged.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> x0 = torch.tensor([[0.5, 0.5]]).double()
        >>> lqr = adp.Feedback(adp.LQR(plant, cost))
        >>> result = adp.simulate(lqr, plant, cost, x0, dt=0.01, steps=50, every=10)
        >>> result.state.shape, bool(result.diverged.any()), bool(result.cost > 0)
        (torch.Size([1, 6, 2]), False, True)
        >>> list(result.recorded)  # an actor-critic records its weights: result["critic_weights"]
        []
        >>> result.figure(width=3.4).savefig("loop.pdf")

        Shown by `staf experiment=adp`.
    """

    time: Tensor  # (T,) seconds
    state: Tensor  # (B, T, n)
    control: Tensor  # (B, T, m) held from that time on; NaN at the end, where none is, and once frozen
    running_cost: Tensor  # (B, T) the cost from 0 to that time
    recorded: dict[str, Tensor]  # (B, T, ...) by name, of `Controller.recorded`: result["name"]
    frozen_at: Tensor  # (B,) seconds, inf for rows that never froze
    carried: Carried = ()  # by the controller at the end, (B, ...)
    about: LoopAbout | None = dataclasses.field(default=None, compare=False)  # what ran

    def __repr__(self) -> str:
        """Return five lines: what ran, states, controls, cost, how it ended."""
        return summary(self)

    def figure(
        self,
        *,
        rows: Sequence[int] | None = None,
        lqr: bool = True,
        width: float | None = None,
        font: float | str | None = None,
    ) -> Any:
        """Draw states and controls with their units and bounds, and the cost so far.

        The first of the rows has strong lines, the others thin ones; a row ends where it diverged. The LQR,
        which runs now from the first of them, is a broad grey line, the set-point or path is dotted where it
        is not 0. Angles are in [-pi, pi]. Where there is no LQR a line in the log says why; a result from a
        pickle has none.

        Args:
            rows: which; None for the first eight.
            lqr: whether to draw the LQR's run.
            width: inches, 7.2 by default; a column of a paper is 3.4.
            font: of all text: size in pt, family, or both, as ``"9 serif"``; 8 pt by default.

        Returns:
            A `matplotlib.figure.Figure`.

        Raises:
            ValueError: if an argument breaks its rule.
        """
        return pictures.draw(picture(self, rows, lqr), width, font)

    def __getitem__(self, name: str) -> Tensor:
        """(B, T, ...) of what the controller recorded.

        Raises:
            KeyError: if it records nothing of that name.
        """
        if name not in self.recorded:
            raise KeyError(f"the controller records {', '.join(self.recorded) or 'nothing'}; got {name!r}")
        return self.recorded[name]

    @property
    def actor_weights(self) -> Tensor:
        """(B, T, M) of an actor-critic; M = 0 where nothing learns."""
        return self._weights("actor_weights")

    @property
    def critic_weights(self) -> Tensor:
        """(B, T, M), likewise."""
        return self._weights("critic_weights")

    def _weights(self, name: str) -> Tensor:
        return self.recorded.get(name, self.state[..., :0])

    @property
    def cost(self) -> Tensor:
        """(B,) the cost of the whole run; of a frozen row, until it froze."""
        return self.running_cost[:, -1]

    @property
    def diverged(self) -> Tensor:
        """(B,) bool."""
        return torch.isfinite(self.frozen_at)

    def split(self, rows: Sequence[int]) -> list[LoopResult]:
        """The results of so many rows each, in their order."""
        leaves, structure = flatten([getattr(self, name) for name in OF_ROWS])
        parts = zip(*(leaf.split(rows) for leaf in leaves), strict=True)
        found = (LoopResult(self.time, *unflatten(structure, iter(part))) for part in parts)
        return [dataclasses.replace(part, about=self.about) for part in found]
