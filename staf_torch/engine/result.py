"""The result of a gradient chase."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from torch import Tensor

from ..lanes.device.kernel import joined
from ..numerics.repr_text import count, span
from .certificate import Certificate


@dataclasses.dataclass(frozen=True)
class ChaseResult:
    """A gradient chase over T times. "Before" is at x_k with the weights brought from x_{k-1}; without
    that word, after the correction at x_k.

    From the time at which a trajectory diverged its weights stay what they last were, and all that
    follows from them is NaN.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=50)
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> result = chase(states, basis, targets.Paper(), optim.Exact())
        >>> result.weights.shape, bool(result.excess.max() < 1e-9)
        (torch.Size([1, 51, 3]), True)

        Shown by `staf experiment=gradient_chase`.
    """

    state: Tensor  # (B, T, n) as given
    weights: Tensor  # (B, T, M) the paper's w
    ideal_weights: Tensor  # (B, T, M)
    coefficients: Tensor  # (B, T, M) b in V^(x+z) = e^{s(z)} sum_i b_i k0(z, d_i); never overflows
    value: Tensor  # (B, T) V(x)
    estimate: Tensor  # (B, T) V^(x)
    estimate_before: Tensor  # (B, T)
    ideal_estimate: Tensor  # (B, T) V^(x) with the ideal weights
    excess: Tensor  # (B, T) F(a) - F(w)
    excess_before: Tensor  # (B, T)
    diverged_at: Tensor  # (B,) int64 index of the first time that is not finite, -1 if none
    certificate: Certificate | None = None  # where it was asked for

    @property
    def diverged(self) -> Tensor:
        """(B,) bool: whether the trajectory, V, the Gram matrix or the weights became non-finite."""
        return self.diverged_at >= 0

    def __repr__(self) -> str:
        rows, times, centers = self.weights.shape
        return (
            f"ChaseResult({rows} trajectories, {times} times, {centers} centers; at the last time |V - V^| "
            f"{span((self.value - self.estimate)[:, -1].abs())}, excess {span(self.excess[:, -1])}; "
            f"{count(self.diverged)} diverged)"
        )


@dataclasses.dataclass(frozen=True)
class ChaseWeights:
    """The weights of a gradient chase alone.

    Example:
        >>> states = torch.ones(1, 20, 2).double()
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> law = optim.SteepestDescent()
        >>> chase_weights(states, basis, targets.Paper(), law, history=False).weights.shape
        torch.Size([1, 1, 3])

        Shown by `tests/benchmarks/README.md`.
    """

    weights: Tensor  # (B, T, M) the paper's w, corrected; (B, 1, M) at the last time for record="last"
    diverged_at: Tensor  # (B,) int64 index of the first time that is not finite, -1 if none

    @property
    def diverged(self) -> Tensor:
        """(B,) bool: whether the trajectory, V, the Gram matrix or the weights became non-finite."""
        return self.diverged_at >= 0

    def __repr__(self) -> str:
        rows, times, centers = self.weights.shape
        size = f"{rows} trajectories, {times} times, {centers} centers"
        return f"ChaseWeights({size}; {count(self.diverged)} diverged)"


def concatenate(pieces: Iterable[ChaseResult]) -> ChaseResult:
    """Consecutive pieces of time as one result."""
    parts = list(pieces)
    if len(parts) == 1:
        return parts[0]
    whole = {
        field.name: joined([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(ChaseResult)
        if field.name not in ("diverged_at", "certificate")
    }
    vouched = [part.certificate for part in parts if part.certificate is not None]
    return ChaseResult(
        **whole,
        diverged_at=parts[-1].diverged_at.to(whole["weights"].device),
        certificate=Certificate(*(joined(terms) for terms in zip(*vouched, strict=True)))
        if vouched
        else None,
    )
