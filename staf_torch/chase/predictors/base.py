"""What a predictor is."""

from __future__ import annotations

import abc

from torch import Tensor

from ...basis import StaFBasis, Target

Parts = tuple[Tensor, ...]
"""What a predictor prepares in bulk: tensors (B, C, ...), those of one time (B, ...)."""


class Predictor(abc.ABC):
    """How the weights move from one time to the next, before they are corrected there.

    Like a law it is pure and holds hyperparameters only. The weights of a chase at x_k are e^{g(x_k)} times
    the paper's, with g the kernel's `log_gain`.

    Attributes:
        guarded: whether a prediction is dropped, row by row, where it is worse at its arrival than the
            weights held, F(predicted) > F(held). It costs two products with K a time.
    """

    guarded: bool = False

    def prepare(self, basis: StaFBasis, target: Target, states: Tensor, start: int) -> Parts:
        """What `predict` needs at the C arrivals of a piece of time, in bulk.

        Args:
            basis: kernel and centers.
            target: V.
            states: the two before the piece, then the piece, (B, 2 + C, n); what lies before the first
                time of all repeats it.
            start: the index of the first arrival.
        """
        return ()

    @abc.abstractmethod
    def predict(self, parts: Parts, weights: Tensor, previous: Tensor, unit: Tensor) -> Tensor:
        """The weights to start from at an arrival.

        Args:
            parts: of this arrival.
            weights: as corrected at the time before, (B, M).
            previous: as corrected at the time before that, (B, M); at the start, the same as weights;
                both in units of the state that they leave.
            unit: e^{g(x_{k+1}) - g(x_k)}, (B, 1): what holding the paper's weights multiplies them by.

        Returns:
            (B, M), in units of the state that they reach.
        """
