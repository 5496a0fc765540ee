"""The bank of forecasters as a regressor for streams, with the conventions of scikit-learn."""

from __future__ import annotations

from typing import Any, Self

from torch import Tensor

from ...numerics.checks import flag, integer, positive_real
from ..estimator import StreamEstimator
from ..samples import pair
from .bank import Bank
from .rules import RECENT, BankShape

_NAME = "MixtureRegressor"


class MixtureRegressor(StreamEstimator):
    """Online regression by mixing forecasters on remembered samples: accurate, with nothing to tune.

    A stream keeps some samples; where the state comes back, local Gaussian processes take their centers from
    them. These, State Following filters, quadratic models, processes on the whole past, a linear model and
    the last value are mixed by how well they predict (`Bank`). About a tenth of a millisecond a sample;
    thousands of fast streams are the `StaFRegressor`'s.

    No stream influences another. A coordinate of x that is NaN was not measured and is held; a target that is
    NaN is not learned. Any finite number is survived: a stream that jumps starts afresh there.

    Example:
        >>> model = MixtureRegressor(memory=200, neighbours=16)
        >>> x = torch.linspace(0.0, 9.0, 90, dtype=torch.float64).sin()
        >>> model.fit(x[:-1, None], x[1:]).predict(x[-1:]).shape
        torch.Size([])

        Shown by `staf_torch/online/mixture/README.md`.

    Args:
        memory: samples kept of a stream, at least 128.
        neighbours: of them that make a local process, at least 8.
        robust: standard deviations beyond which a sample waits for the next: both are learned if that is as
            far off, else the first is skipped; None takes 30, or 8 for an error of over 12 spreads of y.
        scaling: whether x and y are brought to mean 0 and variance 1, learned from the first 40 samples, and
            again from 80, 160 and 320.

    Attributes:
        n_features_in_: n, from the first sample on.
        n_streams_: S, or None for a single stream without batch dimension.
        n_outputs_: K, or None for y without a dimension of its own.
        n_samples_seen_: samples that each stream has learned from, () or (S,).
        n_skipped_: samples that were not learned, () or (S,).
    """

    def __init__(
        self,
        memory: int = 1000,
        neighbours: int = 56,
        *,
        robust: float | None = None,
        scaling: bool = True,
    ) -> None:
        self.memory = memory
        self.neighbours = neighbours
        self.robust = robust
        self.scaling = scaling

    def tune(self, x: Any, y: Any) -> Self:
        """Check the shapes and forget what was learned: a mixture has nothing to tune.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams.
            y: x's shape without n, or with K in place of n for K outputs.
        """
        pair(self._call("tune"), x, y, (2, 3))
        return self.reset()

    def _begin(self, streams: int, outputs: int, like: Tensor) -> Bank:
        memory = integer(_NAME, "memory", self.memory, least=2 * RECENT)
        neighbours = integer(_NAME, "neighbours", self.neighbours, least=8)
        robust = None if self.robust is None else positive_real(_NAME, "robust", self.robust)
        shape = BankShape(len(like), outputs, memory, min(neighbours, memory))
        return Bank(shape, streams, flag(_NAME, "scaling", self.scaling), robust)

    def _decisive(self) -> tuple[str, ...]:
        return ("memory", "neighbours", "robust", "scaling")
