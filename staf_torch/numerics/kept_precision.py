"""Modules whose numbers keep their dtype."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

from torch import Tensor, nn


class KeptPrecision(nn.Module):
    """Base of modules that compute in the dtype that they were made with, whatever the caller's is.

    `.float()` and `.to(dtype)` leave their tensors as they are, and those of what they hold; devices are
    followed. A forward converts what comes and returns the caller's dtype.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def moved(tensor: Tensor) -> Tensor:
            after = fn(tensor)
            return after if after.dtype == tensor.dtype else tensor.to(after.device)

        done: Any = super()._apply(moved, recurse)  # type: ignore[no-untyped-call]
        return done  # type: ignore[no-any-return]
