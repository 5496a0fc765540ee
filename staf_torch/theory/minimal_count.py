"""How many centers are needed in fact: the smallest layout whose ideal weights are accurate enough."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from .._checks import fail, positive_real, trailing
from ..basis import StaFBasis
from ..centers import StateFollowingCenters, ball, polygon, rings
from ..kernels import Kernel
from ..local import LocalSpace
from .sampling import ball_grid, supremum

_BLOCK = 2**21  # kernel values in a temporary
_SHELLS = 6
_DIRECTIONS = {1: 2, 2: 128}  # of each shell; in space 256
_MOST_CENTERS = 500


@dataclasses.dataclass(frozen=True)
class MinimalCount:
    """What `minimal_count` returns, over L layouts and the states (...) of a trajectory."""

    count: int  # the smallest M that does for all states
    pointwise: Tensor  # (...) int64, the smallest M that does for each state
    counts: Tensor  # (L,) int64, M of the layouts
    errors: Tensor  # (L, ...) sup |V - V^| on the ball of each state


def standard_layouts(dim: int) -> list[Tensor]:
    """Directions (M, n) of growing M, each unisolvent for polynomials of one degree more.

    In the plane one and two points, then `rings` with 3 to 28; in other dimensions `ball` with
    C(n + k, n) points, k = 0, 1, ..., up to 500 of them and k = 6.
    """
    if dim == 2:
        return [polygon(1), polygon(2), *(rings(count) for count in (3, 6, 10, 15, 21, 28))]
    counts = [math.comb(dim + degree, dim) for degree in range(7)]
    return [ball(count, dim) for count in counts if count <= _MOST_CENTERS]


def minimal_count(
    target: Callable[[Tensor], Tensor],
    kernel: Kernel,
    states: Tensor,
    radius: float,
    epsilon: float,
    layouts: Sequence[Tensor] | None = None,
) -> MinimalCount:
    """The smallest M with sup |V(y) - V^(y; x)| <= epsilon on the ball N_r(x) of every state x.

    V^ has the ideal weights. The layouts are tried from the fewest centers on; the first that does gives M.

    Example:
        >>> states = systems.simulate(systems.Oscillator(), torch.tensor([[1.0, 0.0]]).double(), 0.05, 125)
        >>> minimal_count(targets.Paper(), ExponentialKernel(), states, radius=0.1, epsilon=1e-2).count
        6

    Args:
        target: V, points (..., n) to values (...).
        kernel: of the basis.
        states: a trajectory, (..., n).
        radius: r, positive, in the units of the state.
        epsilon: positive, in the units of V.
        layouts: directions (M, n), one layout each; `standard_layouts` if None.

    Returns:
        M over the trajectory and for each of its states, and all errors.

    Raises:
        ValueError: if an argument breaks its rule, or no layout does (the message has the best one).

    Source: the feasibility theorem of Rosenfeld et al., section 3, and the proposition after it (in the
    supremum norm): such an M exists. Here it is measured.
    """
    call = "minimal_count"
    trailing(call, "states", states, dims=1)
    allowed = positive_real(call, "epsilon", epsilon)
    families = standard_layouts(states.shape[-1]) if layouts is None else layouts
    ordered = sorted(_checked(call, families, states.shape[-1]), key=len)
    errors = layout_errors(target, kernel, states, radius, ordered)
    counts = torch.tensor([len(layout) for layout in ordered])
    good = errors <= allowed  # (L, ...)
    enough = good.reshape(len(counts), -1).all(-1)
    if not bool(enough.any()):
        worst = errors.reshape(len(counts), -1).amax(-1)
        best = int(worst.nan_to_num(nan=torch.inf).argmin())
        raise ValueError(
            f"`minimal_count(epsilon=...)` must be in the reach of a layout, but the best one "
            f"({int(counts[best])} centers) leaves an error of {float(worst[best]):.3g}; got {epsilon!r}."
        )
    pointwise = counts[good.int().argmax(0)]  # the first layout that does at the state
    return MinimalCount(int(counts[enough.int().argmax()]), pointwise, counts, errors)


def layout_errors(
    target: Callable[[Tensor], Tensor],
    kernel: Kernel,
    states: Tensor,
    radius: float,
    layouts: Sequence[Tensor],
) -> Tensor:
    """sup |V(y) - V^(y; x)| over the ball N_r(x), ideal weights, for each layout and state.

    The supremum is the largest value on a grid of the ball (769 points in the plane, denser towards its
    surface), improved by a search from its largest points.

    Args:
        target: V, points (..., n) to values (...).
        kernel: of the basis.
        states: (..., n).
        radius: r, positive, in the units of the state.
        layouts: L directions (M, n).

    Returns:
        (L, ...), NaN where the target is not finite.

    Raises:
        ValueError: if an argument breaks its rule.
    """
    call = "layout_errors"
    trailing(call, "states", states, dims=1)
    extent = positive_real(call, "radius", radius)
    dim = states.shape[-1]
    _checked(call, layouts, dim)
    grid = extent * ball_grid(dim, _SHELLS, _DIRECTIONS.get(dim, 256)).to(states)
    rows = states.reshape(-1, dim)
    with torch.no_grad():
        found = [
            torch.cat(list(_errors(target, StaFBasis(kernel, StateFollowingCenters(u, extent)), rows, grid)))
            for u in layouts
        ]
    return torch.stack(found).reshape(len(found), *states.shape[:-1])


def _checked(call: str, layouts: Sequence[Tensor], dim: int) -> Sequence[Tensor]:
    if not layouts:
        raise fail(call, "layouts", "must name at least one layout", layouts)
    for layout in layouts:
        trailing(call, "layouts", layout, dims=2, last=dim)
    return layouts


def _errors(
    target: Callable[[Tensor], Tensor], basis: StaFBasis, states: Tensor, grid: Tensor
) -> Iterator[Tensor]:
    """For some of the states (S, n) at a time, so that memory stays bounded: (S',)."""
    radius = float(grid.norm(dim=-1).max())
    for x in states.split(max(1, _BLOCK // (len(grid) * basis.count))):
        space = basis.local(x)
        coefficients = space.fit(basis.values(x, target))

        def error(
            z: Tensor, x: Tensor = x, space: LocalSpace = space, coefficients: Tensor = coefficients
        ) -> Tensor:
            return (target(x.unsqueeze(-2) + z) - space.evaluate(z, coefficients)).abs()

        yield supremum(error, grid, radius)
