"""The gradient chase: everything that does not depend on the weights in bulk over time, then the weight
recursion, then everything that follows from the weights in bulk again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from .._checks import integer
from ..basis import StaFBasis, Target
from ..objective import Known, NativeError
from ..optim.base import UpdateLaw
from .certificate import Certificate, certify
from .correct import Dense, dense, lost, paper_units
from .known import known as find_known
from .known import state_row
from .parts import correct_parts
from .predictors import Predictor
from .recursion import Carry, Recursion, recursion
from .result import ChaseResult, concatenate
from .start import check_law, check_states, start

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
    check_states("chase", states, basis)
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
    check_law("chase", law)
    if predictor is not None and not isinstance(predictor, Predictor):
        raise ValueError(f"`chase(predictor=...)` must be a Predictor or None; got {predictor!r}.")
    carry, warned = None, False
    for states in pieces:
        warned = warned or basis.check_reach(states)
        if carry is None:
            carry = start("chase", states, basis, law, weights)
            if predictor is not None:
                carry = carry._replace(previous=carry.weights, states=states[:, [0, 0]])
        result, carry = _piece(states, basis, target, law, inner_steps, predictor, certificate, carry)
        yield result


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
    structure, values = basis.gram_structure(states), basis.values(states, target)
    space = basis.local(states)
    fitted = space.fit(values)
    ideal = space.scaled_weights(fitted)
    scale = states.new_ones(()) if structure.scale is None else structure.scale
    row = state_row(basis, states, space)
    value = target(states)
    # Every K of its own only where somebody asks for it: the fused recursion does not.
    whole = dense(structure, values) if law.needs or certificate or predictor is not None else None
    gram = None if whole is None else whole.gram
    known = find_known(law.needs, space, gram, ideal, scale * row, value)

    if predictor is None:
        run = correct_parts(states, basis, target, structure, values, law, inner_steps, carry, known, whole)
    else:
        assert whole is not None
        run = _predicted(predictor, basis, target, states, whole, values, law, inner_steps, carry, known)

    reached = _Reached(lost(run.carry, states.shape[1]))
    gain = states.new_zeros(()) if structure.log_gain is None else structure.log_gain
    inverse_gain = (-gain).exp()

    def at_state(scaled_weights: Tensor) -> Tensor:
        return reached(torch.linalg.vecdot(row, scale * scaled_weights))

    result = ChaseResult(
        state=states,
        weights=_paper_weights(run.after, paper_units(structure, run.carry, states.shape[1])),
        ideal_weights=reached(_paper_weights(ideal, inverse_gain[..., None])),
        coefficients=reached(scale * run.after),
        value=reached(value),
        estimate=at_state(run.after),
        estimate_before=at_state(run.before),
        ideal_estimate=reached(space.evaluate(states.new_zeros(1, basis.dim), fitted).squeeze(-1)),
        excess=reached(structure.quadratic(run.after - ideal) * inverse_gain),
        excess_before=reached(structure.quadratic(run.before - ideal) * inverse_gain),
        diverged_at=run.carry.diverged_at,
    )
    if not certificate:
        return result, run.carry
    assert whole is not None
    objective = NativeError(whole.gram, values)
    vouched, link = certify(
        objective, whole.log_gain, law, inner_steps, run.before, run.after, ideal, carry.link
    )
    result = dataclasses.replace(result, certificate=reached.certificate(vouched))
    return result, run.carry._replace(link=link)


def _predicted(
    predictor: Predictor,
    basis: StaFBasis,
    target: Target,
    states: Tensor,
    whole: Dense,
    values: Tensor,
    law: UpdateLaw,
    inner_steps: int,
    carry: Carry,
    known: Known,
) -> Recursion:
    """The recursion of one piece with a predictor, which looks at the two states before it as well."""
    assert carry.states is not None
    around = torch.cat((carry.states, states), dim=1)
    parts = predictor.prepare(basis, target, around, carry.time)
    run = recursion(whole.gram, values, whole.log_gain, law, inner_steps, carry, known, predictor, parts)
    return run._replace(carry=run.carry._replace(states=around[:, -2:]))


def _paper_weights(scaled: Tensor, units: Tensor) -> Tensor:
    """w = e^{-g} (e^g w): (B, C, M), (B, C, 1); NaN where e^{-g} underflows and w is not zero."""
    underflow = (units < torch.finfo(units.dtype).tiny) & (scaled != 0)
    return torch.where(underflow, torch.nan, scaled * units)


class _Reached:
    """NaN in place of what a trajectory did not reach."""

    def __init__(self, gone: Tensor) -> None:
        self._gone = gone  # (B, C) bool

    def __call__(self, quantity: Tensor) -> Tensor:
        """The same (B, C, ...), NaN there."""
        gone = self._gone.view(*self._gone.shape, *[1] * (quantity.dim() - 2))
        return torch.where(gone, torch.nan, quantity)

    def certificate(self, vouched: Certificate) -> Certificate:
        """The same, with nothing violated there."""
        return Certificate(
            rate=self(vouched.rate),
            growth=self(vouched.growth),
            drift=self(vouched.drift),
            bound=self(vouched.bound),
            violated=vouched.violated & ~self._gone,
        )
