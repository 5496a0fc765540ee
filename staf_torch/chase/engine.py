"""The gradient chase: everything that does not depend on the weights in bulk over time, then the weight
recursion, then everything that follows from the weights in bulk again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from .._checks import integer, trailing
from ..basis import StaFBasis, Target
from ..objective import NativeError
from ..optim.base import UpdateLaw
from .certificate import Certificate, certify
from .known import known as find_known
from .predictors import Predictor
from .recursion import Carry, recursion
from .result import ChaseResult, concatenate

_WORKING_BYTES = 2**26


def chase(
    states: Tensor,
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    *,
    inner_steps: int = 10,
    predictor: Predictor | None = None,
    weights: Tensor | None = None,
    certificate: bool = False,
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
        predictor: how the weights move between times, `predictors.Secant()` or `predictors.Tangent()`;
            None keeps them.
        weights: the paper's w before the first correction, (M,) or (B, M); zero by default.
        certificate: whether the result has a `Certificate`.

    Raises:
        ValueError: if an argument breaks its rule, or the target returns another shape.

    Source: Rosenfeld et al., section 6.
    """
    trailing("chase", "states", states, dims=3, last=basis.dim)
    if states.dim() != 3 or 0 in states.shape:
        raise ValueError(f"`chase(states=...)` must have the shape (B, T, n); got {tuple(states.shape)}.")
    pieces = states.split(chunk_length(states.shape[0], basis, states.element_size()), dim=1)
    return concatenate(
        chase_pieces(
            pieces,
            basis,
            target,
            law,
            inner_steps=inner_steps,
            predictor=predictor,
            weights=weights,
            certificate=certificate,
        )
    )


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
    predictor: Predictor | None = None,
    weights: Tensor | None = None,
    certificate: bool = False,
) -> Iterator[ChaseResult]:
    """`chase` over consecutive pieces of time (B, C, n), a result a piece."""
    integer("chase", "inner_steps", inner_steps, least=0)
    if not isinstance(law, UpdateLaw):
        raise ValueError(f"`chase(law=...)` must be an UpdateLaw; got {law!r}.")
    if predictor is not None and not isinstance(predictor, Predictor):
        raise ValueError(f"`chase(predictor=...)` must be a Predictor or None; got {predictor!r}.")
    carry, warned = None, False
    for states in pieces:
        warned = warned or basis.check_reach(states)
        if carry is None:
            carry = _start(states, basis, law, weights)
            if predictor is not None:
                carry = carry._replace(previous=carry.weights, states=states[:, [0, 0]])
        result, carry = _piece(states, basis, target, law, inner_steps, predictor, certificate, carry)
        yield result


def _start(states: Tensor, basis: StaFBasis, law: UpdateLaw, weights: Tensor | None) -> Carry:
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
    return Carry(first, law.init(first), zero if gain is None else gain, 0, never)


def _piece(
    states: Tensor,
    basis: StaFBasis,
    target: Target,
    law: UpdateLaw,
    inner_steps: int,
    predictor: Predictor | None,
    certificate: bool,
    carry: Carry,
) -> tuple[ChaseResult, Carry]:
    """One piece of time: (B, C, n) and the carry to its result and the next carry."""
    structure = basis.gram_structure(states)
    values = basis.values(states, target)
    gram = structure.scaled().expand(*states.shape[:2], basis.count, basis.count)
    zero = states.new_zeros(states.shape[:2])
    log_gain = zero if structure.log_gain is None else structure.log_gain
    space = basis.local(states)
    fitted = space.fit(values)
    ideal = space.scaled_weights(fitted)
    scale = zero.new_ones(()) if structure.scale is None else structure.scale
    here = states.new_zeros(1, basis.dim)
    row = basis.kernel.core(states, here, space.offsets).squeeze(-2)  # k0(0, d_i), (..., M)
    value = target(states)
    known = find_known(law.needs, space, gram, ideal, scale * row, value)

    if predictor is None:
        run = recursion(gram, values, log_gain, law, inner_steps, carry, known)
    else:
        assert carry.states is not None
        around = torch.cat((carry.states, states), dim=1)
        parts = predictor.prepare(basis, target, around, carry.time)
        run = recursion(gram, values, log_gain, law, inner_steps, carry, known, predictor, parts)
        run = run._replace(carry=run.carry._replace(states=around[:, -2:]))

    objective = NativeError(gram, values)
    times = torch.arange(carry.time, run.carry.time, device=states.device)
    end = run.carry.diverged_at[:, None]
    lost = (end >= 0) & (times >= end)
    # Frozen weights stay in the units of the last state that they were corrected at.
    inverse_gain = (-torch.where(lost, run.carry.log_gain[:, None], log_gain)).exp()

    def reached(quantity: Tensor) -> Tensor:
        return torch.where(lost.view(*lost.shape, *[1] * (quantity.dim() - 2)), torch.nan, quantity)

    def at_state(scaled_weights: Tensor) -> Tensor:
        return reached(torch.linalg.vecdot(row, scale * scaled_weights))

    result = ChaseResult(
        state=states,
        weights=run.after * inverse_gain[..., None],
        ideal_weights=reached(ideal * inverse_gain[..., None]),
        coefficients=reached(scale * run.after),
        value=reached(value),
        estimate=at_state(run.after),
        estimate_before=at_state(run.before),
        ideal_estimate=reached(space.evaluate(here, fitted).squeeze(-1)),
        excess=reached(objective.excess(run.after, ideal) * inverse_gain),
        excess_before=reached(objective.excess(run.before, ideal) * inverse_gain),
        diverged_at=run.carry.diverged_at,
    )
    if not certificate:
        return result, run.carry
    vouched, link = certify(objective, log_gain, law, inner_steps, run.before, run.after, ideal, carry.link)
    vouched = Certificate(
        rate=reached(vouched.rate),
        growth=reached(vouched.growth),
        drift=reached(vouched.drift),
        bound=reached(vouched.bound),
        violated=vouched.violated & ~lost,
    )
    return dataclasses.replace(result, certificate=vouched), run.carry._replace(link=link)
