"""The filter over a recorded stretch as a row program, with gradients by all that it reads."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes import Program
from ..lanes.tree import Tree
from .filter_program import FORECAST, after, carry_of, law_of
from .kalman_filter import LocalFilter
from .own_functions import OwnFunctions
from .stream_state import StreamState


class Forecast(NamedTuple):
    """Expected value of every sample before it was learned, and its likelihood then."""

    mean: Tensor  # in the shape of y
    deviation: Tensor  # standard deviation, noise included; as the mean
    log_density: Tensor  # of y, all outputs, (T,) or (T, S); 0 where none was measured


def log_density(y: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """log N(y; mean, deviation), entry by entry; 0 where y was not measured."""
    seen = torch.isfinite(y)
    z = (torch.where(seen, y, mean) - mean) / deviation
    found = -0.5 * z.square() - deviation.log() - 0.5 * math.log(2 * math.pi)
    return torch.where(seen, found, 0.0)


def forecasts(filter_: LocalFilter, x: Tensor, y: Tensor, lapse: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of every sample, from those before it: (S, T, K) each.

    With `OwnFunctions` compiled, forwards and backwards; with others in plain torch.

    Args:
        filter_: of S streams that have learned nothing.
        x: (S, T, n), float64.
        y: (S, T, K).
        lapse: (S, T).
    """
    rows, functions = len(x), filter_.functions
    numbers = tuple(torch.as_tensor(part, device=x.device).double().expand(rows) for part in law_of(filter_))
    if isinstance(functions, OwnFunctions):
        row = tuple(part.movedim(-1, 0).to(x.device) for part in functions), numbers
        mean, deviation = FORECAST(_fresh(x, y, functions.offsets.shape[0]), (x, y, lapse), row)[1]
        return mean, deviation

    def step(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        return after(functions, carry, now, row)

    program = Program(step, name=FORECAST.name, compile=False)
    mean, deviation = program(_fresh(x, y, len(functions.offsets)), (x, y, lapse), numbers)[1]
    return mean, deviation


def _fresh(x: Tensor, y: Tensor, count: int) -> Tree:
    """The carry of streams that have learned nothing."""
    (rows, _, n), k = x.shape, y.shape[-1]
    return carry_of(StreamState.empty(x.detach(), rows, n, count, k))
