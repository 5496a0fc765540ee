"""What a regressor of streams learns with, and predicts by."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from .compiled_filter import DirectCalls


class Streams(Protocol):
    """Streams side by side, none of which influences another: a `FilterStreams` or a `Bank`."""

    dtype: torch.dtype
    moves: bool  # samples of any device to where the streams are, and what is predicted back

    @property
    def compiled(self) -> bool: ...  # tensors of this dtype are read in place by compiled code
    @property
    def count(self) -> int: ...  # S
    @property
    def learned(self) -> Tensor: ...  # samples, (S,) int64
    @property
    def skipped(self) -> Tensor: ...
    def predict(  # mean and deviation of the next y at x (S, n), in a shape
        self, x: Tensor, shape: tuple[int, ...] | None = None
    ) -> tuple[Tensor, Tensor]: ...
    def learn(self, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None: ...
    def stretch(  # (T, S, ...) at once; False where samples are learned one by one
        self, x: Tensor, y: Tensor, lapse: Tensor
    ) -> bool: ...
    def direct(self, shape: tuple[int, ...], targets: tuple[int, ...]) -> DirectCalls | None: ...
    def clear(self, rows: Tensor) -> None: ...  # these streams begin anew
    def add(self, streams: int) -> None: ...  # behind the others
    def keep(self, rows: Tensor) -> None: ...  # these alone
    def state_dict(self) -> dict[str, Tensor]: ...
    def load_state_dict(self, state: dict[str, Tensor]) -> None: ...
