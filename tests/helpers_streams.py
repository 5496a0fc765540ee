"""A stream on which everything happens, and the regressors of streams."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import staf_torch as st
from staf_torch.online import MixtureRegressor


def hard_stream(steps: int) -> tuple[Tensor, Tensor]:
    """Inputs that come back and jump, one still at first; a function that switches; outliers and gaps."""
    time = torch.arange(steps, dtype=torch.float64)
    x = torch.stack(((0.31 * time).sin() + 0.2 * (1.7 * time).cos(), (0.43 * time).cos()), -1)
    x[:, 1] = torch.where(time < 60, 0.02 * x[:, 1], x[:, 1])  # it moves by far more than its unit later
    x[150:170] += 6.0
    y = torch.where(time < 200, (2 * x[:, 0]).sin() + x[:, 1], 0.5 - x[:, 0] * x[:, 1])
    y = y + 0.05 * (7.3 * time).sin()
    y[90::37] += 9.0
    x[100::23, 1], y[110::31] = math.nan, math.nan
    return x, y


small_filter = functools.partial(st.StaFRegressor, radius=0.4, noise=0.05)
mixture = functools.partial(MixtureRegressor, 128, 8)
REGRESSORS: dict[str, Callable[..., Any]] = {"filter": small_filter, "mixture": mixture}
MODELS = {
    "filter": lambda: st.StaFRegressor(scaling=True),
    "filter of a kernel": lambda: st.StaFRegressor("matern", 0.4, noise=0.1, forgetting=0.99),
    "tuned filter": lambda: st.StaFRegressor().tune(*(part[:100] for part in hard_stream(100))),
    "mixture": mixture,
}
