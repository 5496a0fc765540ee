"""How a piece of time lies in memory, and what may be asked to read it so."""

from __future__ import annotations

from torch import Tensor

from ..basis import StaFBasis, Target

_LIBRARY = __name__.partition(".")[0]


def batch_last(states: Tensor) -> Tensor:
    """The same (B, C, n), stored as (n, C, B): a coordinate is then one contiguous array, trajectories
    are the lanes of every vector instruction, and whatever is computed elementwise stays so."""
    return states.permute(2, 1, 0).contiguous().permute(2, 1, 0)


def library_only(basis: StaFBasis, target: Target) -> bool:
    """Whether V, the kernel and the radius are the library's own: functions of their argument alone.

    A user's may keep state between calls, which calls from several threads would spoil, or `view` its
    argument, which another layout refuses.
    """
    parts = (target, basis, basis.kernel, basis.centers, basis.centers.radius)
    return all(type(part).__module__.partition(".")[0] == _LIBRARY for part in parts)
