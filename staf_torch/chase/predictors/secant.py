"""Linear extrapolation of the weights themselves."""

from __future__ import annotations

from torch import Tensor

from .base import Parts, Predictor


class Secant(Predictor):
    """a_{k+1} <- 2 a_k - a_{k-1}, of the paper's weights as they were corrected.

    Needs no gradient of V, but repeats the error of the correction: the weights that it extrapolates
    are not the ideal ones. In directions that the law hardly corrects they run away: six centers under ten
    line searches at dt = 0.02 reach thousands of times F(0). The guard keeps them bounded; with three
    centers it gains a factor 9 under ten line searches and loses a factor 6 under one.

    Args:
        guarded: whether to drop, row by row, a prediction that is worse than the weights held.
    """

    def __init__(self, guarded: bool = False) -> None:
        self.guarded = guarded

    def predict(self, parts: Parts, weights: Tensor, previous: Tensor, unit: Tensor) -> Tensor:
        return unit * (2 * weights - previous)
