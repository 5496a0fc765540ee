"""What a law needs to know of its objectives, in bulk over time."""

from __future__ import annotations

from collections.abc import Set

import torch
from torch import Tensor

from ..basis import StaFBasis
from ..local import LocalSpace
from ..objective import Known, extremes


def known(
    needs: Set[str], space: LocalSpace, gram: Tensor | None, ideal: Tensor, row: Tensor, sampled: Tensor
) -> Known:
    """The fields of `Known` that a law names in its `needs`, the others None.

    Args:
        needs: names of fields.
        space: the local space at the states (B, C).
        gram: e^{-g} K, (B, C, M, M); None only where nothing is needed.
        ideal: its ideal weights, (B, C, M).
        row: e^{-g} k(x, c_i), (B, C, M) or (M,) for all states.
        sampled: V(x), (B, C).
    """
    if not needs:
        return Known()
    assert gram is not None
    return Known(
        extremes=extremes(gram) if "extremes" in needs else None,
        ideal=ideal if "ideal" in needs else None,
        inverse=_inverse(space, gram) if "inverse" in needs else None,
        row=row.expand(ideal.shape) if "row" in needs else None,
        sampled=sampled if "sampled" in needs else None,
    )


def state_row(basis: StaFBasis, x: Tensor, space: LocalSpace) -> Tensor:
    """k0(0, d_i) at the states x (..., n), (..., M): e^{-g} k(x, c_i) but for the Gram structure's scale."""
    return basis.kernel.core(x, x.new_zeros(1, basis.dim), space.offsets).squeeze(-2)


def _inverse(space: LocalSpace, gram: Tensor) -> Tensor:
    """(e^{-g} K)^-1: (..., M, M), each column a fit to a unit vector of values."""
    units = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    columns = [space.scaled_weights(space.fit(unit.expand(gram.shape[:-1]))) for unit in units]
    return torch.stack(columns, dim=-1)
