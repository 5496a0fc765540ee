"""The gradient chase: everything that does not depend on the weights in bulk over time, then the weight
recursion, then everything that follows from the weights in bulk again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from .._checks import integer, trailing
from ..basis import StaFBasis, Target
from ..optim.base import UpdateLaw
from .correct import correct, lost, paper_units
from .layout import batch_last
from .recursion import Carry
from .result import ChaseResult, concatenate

_WORKING_BYTES = 2**26


def chase(
    states: Tensor,
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    predictor: None = None,
    weights: Tensor | None = None,
) -> ChaseResult:
    """Chase the ideal weights of ``target`` along given trajectories.

    At every time it corrects at x_k by ``inner_steps`` iterations of ``law`` and records the corrected
    weights, then moves on. No trajectory influences another.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=100)
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> chase(states, basis, targets.Paper(), optim.SteepestDescent()).weights.shape
        torch.Size([1, 101, 3])

    Args:
        states: x, (B, T, n).
        basis: kernel and centers.
        target: V, (..., n) -> (...).
        law: the update law.
        inner_steps: iterations at every time, at least 0.
        predictor: how the weights move between times; None keeps them.
        weights: the paper's w before the first correction, (M,) or (B, M); zero by default.

    Raises:
        ValueError: if an argument breaks its rule, or the target returns another shape.

    Source: Rosenfeld et al., section 6.
    """
    check_states("chase", states, basis)
    pieces = states.split(chunk_length(states.shape[0], basis, states.element_size()), dim=1)
    return concatenate(chase_pieces(pieces, basis, target, law, inner_steps=inner_steps, weights=weights))


def chunk_length(batch: int, basis: StaFBasis, itemsize: int) -> int:
    """Times a piece, so that the working memory of `chase_pieces` is some 64 MiB at any horizon."""
    numbers = 4 * basis.count**2 + (basis.count + 2) * (basis.dim + 8)
    return max(1, _WORKING_BYTES // (batch * numbers * itemsize))


def chase_pieces(
    pieces: Iterable[Tensor],
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    weights: Tensor | None = None,
) -> Iterator[ChaseResult]:
    """`chase` over consecutive pieces of time (B, C, n), a result a piece."""
    integer("chase", "inner_steps", inner_steps, least=0)
    check_law("chase", law)
    carry = None
    for states in pieces:
        if carry is None:
            carry = start(states, basis, law, weights)
        result, carry = _piece(states, basis, target, law, inner_steps, carry)
        yield result


def check_states(call: str, states: Tensor, basis: StaFBasis) -> None:
    trailing(call, "states", states, dims=3, last=basis.dim)
    if states.dim() != 3 or 0 in states.shape:
        raise ValueError(f"`{call}(states=...)` must have the shape (B, T, n); got {tuple(states.shape)}.")


def check_law(call: str, law: UpdateLaw) -> None:
    if not isinstance(law, UpdateLaw):
        raise ValueError(f"`{call}(law=...)` must be an UpdateLaw; got {law!r}.")


def start(states: Tensor, basis: StaFBasis, law: UpdateLaw, weights: Tensor | None) -> Carry:
    """The carry before the first time of the states (B, C, n)."""
    shape = (states.shape[0], basis.count)
    first = states.new_zeros(shape)
    if weights is not None:
        trailing("chase", "weights", weights, dims=1, last=basis.count)
        if weights.dim() > 2 or (weights.dim() == 2 and weights.shape != shape):
            raise ValueError(
                f"`chase(weights=...)` must have the shape {shape[1:]} or {shape}; "
                f"got {tuple(weights.shape)}."
            )
        first = first + weights.to(states)
    gain = basis.kernel.log_gain(states[:, 0])
    # The units of the first weights: those of the first state, e^{-g(x_0)}.
    first = first if gain is None else torch.where(first == 0, 0.0, first * gain.exp()[:, None])
    zero = states.new_zeros(states.shape[0])
    never = torch.full(zero.shape, -1, dtype=torch.int64, device=states.device)
    return Carry(first, law.init(first), zero if gain is None else gain.clone(), 0, never)


def _piece(
    states: Tensor,
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
) -> tuple[ChaseResult, Carry]:
    """One piece of time: (B, C, n) and the carry to its result and the next carry."""
    at = batch_last(states)
    structure, values = basis.gram_structure(at), basis.values(at, target)
    run = correct(structure, values, law, inner_steps, carry)

    space = basis.local(at)
    fitted = space.fit(values)
    ideal = space.scaled_weights(fitted)
    zero = at.new_zeros(())
    inverse_gain = (zero if structure.log_gain is None else -structure.log_gain).exp()
    scale = zero.exp() if structure.scale is None else structure.scale
    here = zero.expand(*at.shape[:2], 1, basis.dim)
    row = basis.kernel.core(at, here, space.offsets).squeeze(-2)  # k0(0, d_i), (..., M)
    gone = lost(run.carry, at.shape[1])

    def known(quantity: Tensor) -> Tensor:
        return torch.where(gone.view(*gone.shape, *[1] * (quantity.dim() - 2)), torch.nan, quantity)

    def at_state(scaled_weights: Tensor) -> Tensor:
        return known(torch.linalg.vecdot(row, scale * scaled_weights))

    result = ChaseResult(
        state=states,
        weights=run.after * paper_units(structure, run.carry, at.shape[1]),
        ideal_weights=known(ideal * inverse_gain.unsqueeze(-1)),
        coefficients=known(scale * run.after),
        value=known(target(at)),
        estimate=at_state(run.after),
        estimate_before=at_state(run.before),
        ideal_estimate=known(space.evaluate(here, fitted).squeeze(-1)),
        excess=known(structure.quadratic(run.after - ideal) * inverse_gain),
        excess_before=known(structure.quadratic(run.before - ideal) * inverse_gain),
        diverged_at=run.carry.diverged_at,
    )
    return result, run.carry
