"""Points of balls for the tests of the theorems."""

from __future__ import annotations

import torch
from torch import Tensor


def random_offsets(radius: float, states: int, count: int, dim: int, seed: int = 0) -> Tensor:
    """Uniform in the ball, and as many on its surface: (states, 2 count, dim)."""
    generator = torch.Generator().manual_seed(seed)
    inside, surface = (torch.randn(states, count, dim, generator=generator).double() for _ in range(2))
    depth = torch.rand(states, count, 1, generator=generator).double() ** (1 / dim)
    units = [u / u.norm(dim=-1, keepdim=True) for u in (inside, surface)]
    return radius * torch.cat((depth * units[0], units[1]), dim=1)
