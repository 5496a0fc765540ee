"""Streams side by side: the interface, and streams with coordinates that are angles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from ..numerics.angles import turned
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


class TurningStreams:
    """Streams whose periodic coordinates of x, in rad, are turned by whole turns to within pi of the latest
    x (S, n), NaN where there is none.

    The centers of a filter follow the latest x, so that nothing is lost by not going back: what was learned
    a turn before was forgotten when the centers left it.
    """

    def __init__(self, inner: Streams, periodic: Sequence[int], latest: Tensor) -> None:
        self.inner, self.periodic, self.latest = inner, tuple(periodic), latest
        self.dtype, self.moves = inner.dtype, inner.moves

    @property
    def compiled(self) -> bool:
        return self.inner.compiled

    def direct(self, shape: tuple[int, ...], targets: tuple[int, ...]) -> None:
        """No calls without a lock: samples are turned before."""

    @property
    def count(self) -> int:
        return self.inner.count

    @property
    def learned(self) -> Tensor:
        return self.inner.learned

    @property
    def skipped(self) -> Tensor:
        return self.inner.skipped

    def near(self, x: Tensor) -> Tensor:
        """x (S, n), turned to the latest where there is one."""
        latest = self.latest.reshape(x.shape)
        return torch.where(latest.isnan() | x.isnan(), x, turned(x, latest, self.periodic))

    def predict(self, x: Tensor, shape: tuple[int, ...] | None = None) -> tuple[Tensor, Tensor]:
        return self.inner.predict(self.near(x), shape)

    def learn(self, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        at = self.near(x)
        self.inner.learn(at, y, lapse)
        rows = at.reshape(self.latest.shape)
        self.latest = torch.where(torch.isfinite(rows), rows, self.latest)

    def stretch(self, x: Tensor, y: Tensor, lapse: Tensor) -> bool:
        """Return False: each sample is turned to the one before."""
        return False

    def clear(self, rows: Tensor) -> None:
        self.inner.clear(rows)
        self.latest[rows] = torch.nan

    def add(self, streams: int) -> None:
        self.inner.add(streams)
        self.latest = torch.cat(
            (self.latest, self.latest.new_full((streams, self.latest.shape[1]), torch.nan))
        )

    def keep(self, rows: Tensor) -> None:
        self.inner.keep(rows)
        self.latest = self.latest[rows]

    def state_dict(self) -> dict[str, Tensor]:
        return self.inner.state_dict() | {"latest": self.latest.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        self.inner.load_state_dict(state)
        self.latest = state["latest"].clone()


def turned_in_time(x: Tensor, periodic: Sequence[int]) -> Tensor:
    """A record (T, ...) whose angles are turned sample by sample to the one measured before."""
    if not periodic:
        return x
    rows, latest = [], x[0]
    for now in x:
        unknown = latest.isnan() | now.isnan()
        rows.append(torch.where(unknown, now, turned(now, latest, periodic)))
        latest = torch.where(torch.isfinite(rows[-1]), rows[-1], latest)
    return torch.stack(rows)
