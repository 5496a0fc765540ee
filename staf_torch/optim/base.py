"""What an update law is."""

from __future__ import annotations

import abc

from torch import Tensor

from ..objective import Objective

LawState = tuple[Tensor, ...]
"""What a law carries from one iteration to the next: tensors (..., M), or (...) a row."""


class UpdateLaw(abc.ABC):
    """A pure iteration on a quadratic: state goes in as an argument and comes out as a value.

    A law object holds hyperparameters only. Rows never touch each other.
    """

    def init(self, weights: Tensor) -> LawState:
        """The state before the first iteration, for weights (..., M)."""
        return ()

    @abc.abstractmethod
    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        """One iteration: the new weights (..., M) and the new state."""

    def rescale(self, state: LawState, factor: Tensor) -> LawState:
        """The state when the unit of the weights changes, a -> factor a: (..., 1).

        The default scales everything, as is right for velocities and directions.
        """
        return tuple(part * factor for part in state)

    def contraction(self, condition_number: Tensor) -> Tensor | None:
        """A bound on excess after / excess before of one iteration, from kappa(K); None: not known."""
        return None
