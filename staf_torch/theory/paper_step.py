"""The step that the paper's own proof asks for, with its misprints corrected."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from .._checks import positive_real, trailing
from ..basis import StaFBasis, Target
from ..chase import along
from ..linalg import condition_number
from ..optim import SteepestDescent

_STARTS, _ASCENTS = 8, 60


class PaperStep(NamedTuple):
    """The constants of the gradient chase theorem over given states, and the step that they allow."""

    dt: float  # s
    contraction: float  # delta, of one iteration
    speed: float  # R_0 + R_3 over the M centers: max |c'|, in R^{nM}
    gradient: float  # R_1 = max |grad_c F(a, c)|, |a| <= R
    ideal_gradient: float  # R_2 = max |grad_c F(w(c), c)|
    radius: float  # R = max(|a^0|, |w(c)|)


def paper_step(
    basis: StaFBasis,
    target: Target,
    states: Tensor,
    velocities: Tensor,
    *,
    excess: float,
    initial_weights: Tensor | None = None,
) -> PaperStep:
    """dt = excess (1 - delta) / (2 max|c'| max(R_1, R_2)), one iteration a step.

    The proof bounds the two drift terms |eps_1| <= R_1 |c^{k+1} - c^k| and |eps_2| <= R_2 |c^{k+1} - c^k| by
    excess (1 - delta) / 2 each. As printed, R_1 is the gradient in a and not in c, over the wrong ball, and
    |c'| <= R_0 + R_3 lacks the sqrt(M) of M centers that move at once. For the paper's simulation and an
    excess of 0.35, which it reaches with dt = 1e-2 s, this step is 5.2e-7 s. R_1 is found by ascent
    from a few starts: a maximum that it misses would make the step smaller still.

    Args:
        basis: kernel and centers.
        target: V.
        states: x, (N, n), sampling the region or trajectory.
        velocities: x' there, (N, n).
        excess: the radius wanted, positive.
        initial_weights: a^0, (M,), the paper's w; zero by default.

    Raises:
        ValueError: if ``excess`` is not positive, or the states are not (N, n).

    Source: Rosenfeld et al., section 6; MATH.md, section 2.
    """
    positive_real("paper_step", "excess", excess)
    trailing("paper_step", "states", states, dims=2, last=basis.dim)
    centers, moving = along(basis.centers, states, velocities)
    weights = basis.ideal_weights(states, target)
    radius = weights.norm(dim=-1).max()
    if initial_weights is not None:
        radius = torch.maximum(radius, initial_weights.norm())

    def slope(a: Tensor) -> Tensor:
        """|grad_c F(a, c)|: (..., M) -> (...)."""

        def error(c: Tensor) -> Tensor:
            quadratic = torch.einsum("...i,...ij,...j->...", a, basis.kernel(c, c), a)
            return (quadratic - 2 * (a * target(c)).sum(-1)).sum()

        gradient: Tensor = torch.func.grad(error)(centers).flatten(-2).norm(dim=-1)
        return gradient

    delta = float(
        SteepestDescent().contraction(condition_number(basis.gram_structure(states).scaled()).max())
    )
    speed = float(moving.flatten(-2).norm(dim=-1).max())
    largest, ideal = float(_ascend(slope, weights, radius)), float(slope(weights).max())
    dt = excess * (1 - delta) / (2 * speed * max(largest, ideal)) if speed > 0 else torch.inf
    return PaperStep(dt, delta, speed, largest, ideal, float(radius))


def _ascend(function: Callable[[Tensor], Tensor], like: Tensor, radius: Tensor) -> Tensor:
    """max of a function (N, M) -> (N,) over |a| <= radius, by normalised gradient ascent on the sphere."""
    generator = torch.Generator().manual_seed(0)
    best = like.new_zeros(())
    for _ in range(_STARTS):
        start = torch.randn(like.shape[-1], generator=generator, dtype=torch.float64).to(like)
        a = (radius * start / start.norm()).expand(like.shape)
        for _ in range(_ASCENTS):
            gradient: Tensor = torch.func.grad(lambda at: function(at).sum())(a)
            a = radius * gradient / gradient.norm(dim=-1, keepdim=True)
        best = torch.maximum(best, function(a).max())
    return best
