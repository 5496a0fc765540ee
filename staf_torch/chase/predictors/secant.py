"""Linear extrapolation of the weights themselves."""

from __future__ import annotations

from torch import Tensor

from .base import Parts, Predictor


class Secant(Predictor):
    """a_{k+1} <- 2 a_k - a_{k-1}, of the paper's weights as they were corrected.

    Needs no gradient of V, but repeats the error of the correction: the weights that it extrapolates
    are not the ideal ones.
    """

    def predict(self, parts: Parts, weights: Tensor, previous: Tensor, unit: Tensor) -> Tensor:
        return unit * (2 * weights - previous)
