"""Random numbers of a closed loop: of a row's seed and the step, or of a generator a row."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ...lanes.philox import seed_parts, uniform


def by_generator(controller: nn.Module) -> bool:
    """Return whether a controller asks for the numbers of a generator a row: `RandomPoints(random=...)`."""
    return any(getattr(part, "random", "") == "generator" for part in controller.modules())


def points_of_step(seed: Tensor, step: Tensor, draws: int, dim: int) -> Tensor:
    """Return uniform numbers on [-1, 1), (B, draws, n): those of a row's seed (B, 4) at a step (B,)."""
    drawn: Tensor = uniform(seed, step, draws * dim).unflatten(-1, (draws, dim))
    return drawn


def points_of_steps(x: Tensor, seeds: Sequence[int], first: int, count: int, draws: int) -> Tensor:
    """Return numbers of ``count`` steps from a first one on for the rows x (B, n), (B, count, draws, n)."""
    if not draws:
        return x.new_empty(len(x), count, 0, x.shape[-1])
    key = seed_parts(seeds, x).unsqueeze(1).expand(-1, count, -1)
    step = torch.arange(first, first + count, dtype=x.dtype, device=x.device).expand(len(x), count)
    return points_of_step(key, step, draws, x.shape[-1])


def generated(x0: Tensor, count: int, draws: int, generators: Sequence[torch.Generator]) -> Tensor:
    """Return the next ``count`` steps' numbers, (B, count, draws, n), one generator of the CPU a row."""
    rows, dim = x0.shape
    if not draws or x0.is_meta:
        return x0.new_empty(rows, count, draws, dim)
    drawn = torch.empty(rows, count, draws, dim, dtype=torch.float64, device="cpu")
    for row, generator in zip(drawn.unbind(0), generators, strict=False):
        row.uniform_(-1.0, 1.0, generator=generator)
    return drawn.to(x0)
