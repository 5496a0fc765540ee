"""Where a gradient chase starts, and what it refuses."""

from __future__ import annotations

import torch
from torch import Tensor

from .._checks import trailing
from ..basis import StaFBasis
from ..optim.base import UpdateLaw
from .recursion import Carry


def check_states(call: str, states: Tensor, basis: StaFBasis) -> None:
    """Refuse states that are not (B, T, n) with at least one of each."""
    trailing(call, "states", states, dims=3, last=basis.dim)
    if states.dim() != 3 or 0 in states.shape:
        raise ValueError(f"`{call}(states=...)` must have the shape (B, T, n); got {tuple(states.shape)}.")


def check_law(call: str, law: UpdateLaw) -> None:
    """Refuse what is not an update law."""
    if not isinstance(law, UpdateLaw):
        raise ValueError(f"`{call}(law=...)` must be an UpdateLaw; got {law!r}.")


def start(call: str, states: Tensor, basis: StaFBasis, law: UpdateLaw, weights: Tensor | None) -> Carry:
    """The carry before the first time of the states (B, C, n)."""
    shape = (states.shape[0], basis.count)
    first = states.new_zeros(shape)
    if weights is not None:
        trailing(call, "weights", weights, dims=1, last=basis.count)
        if weights.dim() > 2 or (weights.dim() == 2 and weights.shape != shape):
            raise ValueError(
                f"`{call}(weights=...)` must have the shape {shape[1:]} or {shape}; "
                f"got {tuple(weights.shape)}."
            )
        first = first + weights.to(states)
    gain = basis.kernel.log_gain(states[:, 0])
    # The units of the first weights: those of the first state, e^{-g(x_0)}.
    first = first if gain is None else torch.where(first == 0, 0.0, first * gain.exp()[:, None])
    zero = states.new_zeros(states.shape[0])
    never = torch.full(zero.shape, -1, dtype=torch.int64, device=states.device)
    return Carry(first, law.init(first), zero if gain is None else gain, 0, never)
