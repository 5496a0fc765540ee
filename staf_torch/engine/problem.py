"""The problem of a gradient chase: basis, target, law, predictor and times."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..lanes import each
from ..numerics.checks import fail, integer, object_of, sampled, trailing
from ..numerics.rows import check_law, check_target
from ..optim.base import LawState, UpdateLaw
from ..optim.objective import NativeError
from .predictors import Predictor

_TOGETHER = 10  # centers at which V is written out one by one


@dataclasses.dataclass(frozen=True)
class Problem:
    """A gradient chase but for its states, which come in chunks of time.

    Raises:
        ValueError: if the law, the iterations or the predictor break their rule.
    """

    call: str  # the public function, for messages
    basis: StaFBasis
    target: Target
    law: UpdateLaw
    inner_steps: int
    predictor: Predictor | None = None
    certificate: bool = False

    def __post_init__(self) -> None:
        integer(self.call, "inner_steps", self.inner_steps, least=0)
        object_of(self.call, StaFBasis, "`StaFBasis(kernel, centers)`", basis=self.basis)
        self.basis.check_learned()
        object_of(self.call, UpdateLaw, "`optim.ConjugateGradient()`, for example", law=self.law)
        if self.predictor is not None and not isinstance(self.predictor, Predictor):
            raise fail(self.call, "predictor", "must be a Predictor or None", self.predictor)

    def check_states(self, states: Tensor) -> None:
        """Refuse states that are not (B, T, n) with at least one of each."""
        trailing(self.call, "states", states, dims=3, last=self.basis.dim, vmap=False)
        if states.dim() != 3 or 0 in states.shape:
            raise ValueError(
                f"`{self.call}(states=...)` must have the shape (B, T, n); got {tuple(states.shape)}."
            )
        directions = self.basis.centers.directions
        if directions.is_meta and not states.is_meta:
            raise fail(self.call, "basis", "must have its values: it was built on the meta device", None)
        check_target(self.target, states, sizes=directions.shape)
        if len(states) in directions.shape:  # a shape alone says nothing then
            check_law(self.law, NativeError, directions.new_zeros(len(directions)))

    def values(self, x: Tensor) -> Tensor:
        """Return V(c(x)) at the states x (..., n): (..., M)."""
        basis, target = self.basis, self.target
        if basis.count <= _TOGETHER:
            return basis.values(x, target)
        # Many centers: a compiled program goes through them some at a time, and its text is short.
        centers = basis.centers(x)
        return each(
            lambda at: sampled(target, target(at), at), centers, dim=x.dim() - 1, together=_TOGETHER // 2
        )

    def first_state(self, weights: Tensor) -> LawState:
        """Return what the law carries into the first iteration, for weights (B, M).

        Raises:
            TypeError: if `init` of the law returns no tuple of tensors.
            ValueError: if one of them does not begin with B, the rows.
        """
        state, name = self.law.init(weights), f"{type(self.law).__name__}.init"
        if not isinstance(state, tuple) or not all(isinstance(part, Tensor) for part in state):
            raise TypeError(f"`{name}` must return a tuple of tensors; got {state!r}.")
        for k, part in enumerate(state):
            if part.shape[:1] != weights.shape[:1]:
                raise ValueError(
                    f"`{name}` must return tensors of the shapes (B,), (B, M) or (B, M, M), here with B = "
                    f"{weights.shape[0]}; number {k} is {tuple(part.shape)}."
                )
        return state

    def check_step(self, weights: Tensor, state: LawState, before: LawState) -> None:
        """Refuse what the law made of weights (B, M) if it is not shaped like what it was given.

        Raises:
            ValueError: naming the law and the part.
        """
        name = f"{type(self.law).__name__}.step"
        if weights.shape[-1:] != (self.basis.count,) or weights.dim() != 2:
            raise ValueError(
                f"`{name}` must return weights of the shape (B, {self.basis.count}); "
                f"got {tuple(weights.shape)}."
            )
        shapes, given = ([tuple(part.shape) for part in parts] for parts in (state, before))
        if shapes != given:
            raise ValueError(
                f"`{name}` must return a state of the shapes that it got, {given}; got {shapes}."
            )

    def first_weights(self, states: Tensor, weights: Tensor | None) -> Tensor:
        """Return e^g w before the first correction, (B, M), in units of the first state.

        Raises:
            ValueError: if the weights have another shape.
        """
        shape = (states.shape[0], self.basis.count)
        first = states.new_zeros(shape)
        if weights is None:
            return first
        trailing(self.call, "weights", weights, dims=1, last=self.basis.count)
        if weights.dim() > 2 or (weights.dim() == 2 and weights.shape != shape):
            raise ValueError(
                f"`{self.call}(weights=...)` must have the shape {shape[1:]} or {shape}; "
                f"got {tuple(weights.shape)}."
            )
        first = first + weights.to(states)
        gain = self.basis.kernel.log_gain(states[:, 0])
        return first if gain is None else torch.where(first == 0, 0.0, first * gain.exp()[:, None])
