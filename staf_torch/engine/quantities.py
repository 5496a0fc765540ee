"""Quantities of a chase at states, before and after its weights are known: rows and times alike.

Leading dimensions ... are (B, C), a chunk of time at once, or (B,), one time of a row program.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..approximation.basis import GramStructure
from ..lanes import each
from ..lanes.device.kernel import beside_history
from ..local_basis import LocalSpace
from ..optim.objective import Precomputed, extremes
from .problem import Problem
from .recursion import Corrected
from .result import Certificate, ChaseResult


class Known(NamedTuple):
    """Quantities at the states x (..., n) that do not depend on the weights."""

    state: Tensor
    structure: GramStructure
    values: Tensor  # V(c), (..., M)
    local: Local | None  # None: nobody asks for it

    @property
    def log_gain(self) -> Tensor:
        """g(x), (...)."""
        gain = self.structure.log_gain
        return self.values.new_zeros(self.values.shape[:-1]) if gain is None else gain


class Local(NamedTuple):
    """The local space at the states, and what it says of V."""

    space: LocalSpace
    fitted: Tensor  # coefficients of V in the local basis, (..., M)
    ideal: Tensor  # e^g w, (..., M)
    row: Tensor  # k0(0, d_i): e^{-g} k(x, c_i) but for the scale S, (..., M) or (M,)
    value: Tensor  # V(x), (...)


def know(problem: Problem, x: Tensor, *, local: bool) -> Known:
    """Evaluate kernel and target at the states x (..., n)."""
    basis = problem.basis
    structure, values = basis.gram_structure(x), problem.values(x)
    if not local:
        return Known(x, structure, values, None)
    space = basis.local(x)
    fitted = space.fit(values)
    row = basis.kernel.core(x, x.new_zeros(1, basis.dim), space.offsets).squeeze(-2)
    return Known(
        x, structure, values, Local(space, fitted, space.scaled_weights(fitted), row, problem.target(x))
    )


def precompute(problem: Problem, known: Known, gram: Tensor) -> Precomputed:
    """Return the fields of `Precomputed` that the law names in its `needs`, the others None."""
    needs, local = problem.law.needs, known.local
    if not needs:
        return Precomputed()
    assert local is not None
    row = local.row if known.structure.scale is None else known.structure.scale * local.row
    return Precomputed(
        extremes=extremes(gram) if "extremes" in needs else None,
        ideal=local.ideal if "ideal" in needs else None,
        inverse=_inverse(local.space, gram) if "inverse" in needs else None,
        row=row.expand(local.ideal.shape) if "row" in needs else None,
        sampled=local.value if "sampled" in needs else None,
    )


def _inverse(space: LocalSpace, gram: Tensor) -> Tensor:
    """Return (e^{-g} K)^-1, (..., M, M): each column a fit to a unit vector of values."""
    units = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    units = units.view(-1, *[1] * (gram.dim() - 2), gram.shape[-1]).expand(-1, *gram.shape[:-1])
    # One after the other in a program, which else holds several matrices of a row.
    columns = each(lambda some: space.scaled_weights(space.fit(some)), units, dim=0, together=1)
    return columns.movedim(0, -1)


class Numbers(NamedTuple):
    """The tensors of a `ChaseResult` that follow from states and weights."""

    weights: Tensor
    ideal_weights: Tensor
    coefficients: Tensor
    value: Tensor
    estimate: Tensor
    estimate_before: Tensor
    ideal_estimate: Tensor
    excess: Tensor
    excess_before: Tensor

    def result(
        self, state: Tensor, diverged_at: Tensor, certificate: Certificate | None = None
    ) -> ChaseResult:
        """Return them as a result, all where they are."""
        state, diverged_at = (beside_history(each, self.weights) for each in (state, diverged_at))
        return ChaseResult(state=state, diverged_at=diverged_at, certificate=certificate, **self._asdict())


def numbers(
    known: Known,
    run: Corrected,
    unit: Tensor,
    lost: Tensor,
    product: Callable[[Tensor], Tensor] | None = None,
) -> Numbers:
    """Return everything that follows from the weights, which stand in units of e^{-g}, ``unit`` (...): a row
    that diverged, ``lost``, keeps its last. ``product`` is e^{-g} K v, where somebody has it."""
    structure, local = known.structure, known.local
    assert local is not None
    space, fitted, ideal, row, value = local
    scale = ideal.new_ones(()) if structure.scale is None else structure.scale
    gain = known.state.new_zeros(()) if structure.log_gain is None else structure.log_gain
    inverse_gain = (-gain).exp()

    def reached(quantity: Tensor) -> Tensor:
        return unless(lost, quantity)

    def at_state(scaled_weights: Tensor) -> Tensor:
        return reached(torch.linalg.vecdot(row.expand(ideal.shape), scale * scaled_weights))

    def excess(weights: Tensor) -> Tensor:
        error = weights - ideal
        square = structure.quadratic(error) if product is None else torch.linalg.vecdot(error, product(error))
        return reached(square * inverse_gain)

    origin = known.state.new_zeros(1, known.state.shape[-1])
    return Numbers(
        weights=_paper_weights(run.after, unit.unsqueeze(-1)),
        ideal_weights=reached(_paper_weights(ideal, inverse_gain.unsqueeze(-1))),
        coefficients=reached(scale * run.after),
        value=reached(value),
        estimate=at_state(run.after),
        estimate_before=at_state(run.before),
        ideal_estimate=reached(space.evaluate(origin, fitted).squeeze(-1)),
        excess=excess(run.after),
        excess_before=excess(run.before),
    )


def unless(lost: Tensor, quantity: Tensor) -> Tensor:
    """Return the quantity (..., *) with NaN, or False, where a row is lost (...)."""
    gone = lost.view(*lost.shape, *[1] * (quantity.dim() - lost.dim()))
    return quantity & ~gone if quantity.dtype == torch.bool else torch.where(gone, torch.nan, quantity)


def _paper_weights(scaled: Tensor, units: Tensor) -> Tensor:
    """Return w = e^{-g} (e^g w): (..., M), (..., 1); NaN where e^{-g} underflows and w is not zero."""
    underflow = (units < torch.finfo(units.dtype).tiny) & (scaled != 0)
    return torch.where(underflow, torch.nan, scaled * units)


def with_certificate(result: ChaseResult, vouched: Certificate, lost: Tensor) -> ChaseResult:
    """Return the result with a certificate, NaN and nothing violated where a trajectory is lost."""
    return dataclasses.replace(result, certificate=Certificate(*(unless(lost, term) for term in vouched)))
