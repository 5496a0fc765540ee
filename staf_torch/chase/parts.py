"""The weight recursion of a stack of problems.

From states to weights the compiled recursion computes in its own arithmetic whatever it can; so does it here,
for each basis and target by themselves: a member of the stack has the weights that it has alone, bit by bit.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..basis import GramStructure, StaFBasis, Target
from ..objective import Known
from ..optim.base import UpdateLaw
from ..stacking import parts
from .correct import Dense, Native, correct, native
from .recursion import Carry, Recursion


def correct_parts(
    states: Tensor,
    basis: StaFBasis,
    target: Target,
    structure: GramStructure,
    values: Tensor,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
    known: Known,
    whole: Dense | None,
) -> Recursion:
    """`correct`, with what each basis and target of a stack can be computed from natively.

    Args:
        states: x_k, (B, C, n).
        basis, target: plain or stacked.
        structure, values, law, inner_steps, carry, known, whole: as in `correct`.
    """
    apart = parts(basis, target)
    own = [native(states[at], b, v, law, inner_steps, _rows(carry, at)) for at, b, v in apart]
    if len(apart) == 1 or all(one.structure is None for one in own):
        first = own[0] if len(apart) == 1 else Native()
        return correct(states, structure, values, first, law, inner_steps, carry, known, whole)
    runs = [
        correct(states[at], _factors(structure, at), values[at], one, law, inner_steps, _rows(carry, at))
        for (at, _, _), one in zip(apart, own, strict=True)
    ]
    ends = [run.carry for run in runs]
    end = carry._replace(
        weights=torch.cat([end.weights for end in ends]),
        law_state=tuple(torch.cat(state) for state in zip(*(end.law_state for end in ends), strict=True)),
        log_gain=torch.cat([end.log_gain for end in ends]),
        time=ends[0].time,
        diverged_at=torch.cat([end.diverged_at for end in ends]),
    )
    before, after = (torch.cat([getattr(run, name) for run in runs]) for name in ("before", "after"))
    return Recursion(before, after, end)


def _rows(carry: Carry, at: slice) -> Carry:
    return carry._replace(
        weights=carry.weights[at],
        law_state=tuple(state[at] for state in carry.law_state),
        log_gain=carry.log_gain[at],
        diverged_at=carry.diverged_at[at],
    )


def _factors(structure: GramStructure, at: slice) -> GramStructure:
    """Of some rows: a core (M, M), a scale (M,) serve all."""
    core, log_scale, log_gain = structure
    return GramStructure(
        core if core.dim() == 2 else core[at],
        log_scale if log_scale is None or log_scale.dim() == 1 else log_scale[at],
        None if log_gain is None else log_gain[at],
    )
