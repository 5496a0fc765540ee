"""Numbers, centers and bases that many tests begin with."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from variants import KERNELS

import staf_torch as st


def uniform(*shape: int, low: float = -1.0, high: float = 1.0, seed: int | None = None) -> Tensor:
    """Random numbers in float64, the same on every run."""
    generator = None if seed is None else torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(*shape, dtype=torch.float64, generator=generator)


def tensor(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def centers_of(count: int = 6, radius: float = 0.3, dim: int = 2) -> st.StateFollowingCenters:
    return st.StateFollowingCenters(st.rings(count) if dim == 2 else st.ball(count, dim), radius)


def basis_of(kernel: str, count: int = 6, radius: Any = 0.3, dim: int = 2) -> st.StaFBasis:
    return st.StaFBasis(KERNELS[kernel].make(), centers_of(count, radius, dim))


def random_positive_definite(seed: int, *batch: int, size: int, log_condition: float = 3.0) -> Tensor:
    """Q diag(10^u) Q' with u uniform in [0, log_condition]: (*batch, size, size)."""
    generator = torch.Generator().manual_seed(seed)
    square = torch.randn(*batch, size, size, dtype=torch.float64, generator=generator)
    rotation = torch.linalg.qr(square)[0]
    exponent = torch.rand(*batch, size, dtype=torch.float64, generator=generator) * log_condition
    matrix = (rotation * 10.0 ** exponent.unsqueeze(-2)) @ rotation.mT
    return (matrix + matrix.mT) / 2


def changed(given: Any, **parts: Any) -> Any:
    """A named tuple with some of its parts replaced."""
    names = type(given).__match_args__
    return type(given)(*(parts.get(name, part) for name, part in zip(names, given, strict=True)))
