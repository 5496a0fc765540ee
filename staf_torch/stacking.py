"""Bases and targets of several problems as one, each for rows of its own.

What differs between the problems becomes a tensor with one entry a row; what they share stays shared.
"""

from __future__ import annotations

import copy
import itertools
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from ._convention import described
from .basis import GramStructure, StaFBasis, Target
from .local import LocalSpace

Module = TypeVar("Module", bound=nn.Module)


class StackedBasis(StaFBasis):
    """Bases of one kernel type and one layout; basis i serves the next ``rows[i]`` rows of every batch.

    States are (B, T, n) with B = sum(rows). Hyperparameters that differ are (B, 1) in the kernel and the
    radius, so that bulk work runs over all rows at once. The Gram structure, on which the weight recursion
    hangs and with it every chaotic setting, is asked of each basis for its own rows: bit by bit the one that
    the basis alone would give.

    Args:
        bases: equal but for scalar hyperparameters.
        rows: of each, at least 1.

    Raises:
        ValueError: if the bases differ in more than scalar hyperparameters.
    """

    def __init__(self, bases: Sequence[StaFBasis], rows: Sequence[int]) -> None:
        stacked = stack_hyperparameters(bases, rows)
        super().__init__(stacked.kernel, stacked.centers)
        self._bases, self._rows = list(bases), list(rows)

    def gram_structure(self, x: Tensor) -> GramStructure:
        apart = zip(self._bases, x.split(self._rows), strict=True)
        parts = [basis.gram_structure(at) for basis, at in apart]
        if len(parts) == 1:
            return parts[0]
        cores = [_rows_of(part.core, rows, 2) for part, rows in zip(parts, self._rows, strict=True)]
        return GramStructure(
            torch.cat(cores),
            self._joined([part.log_scale for part in parts], 1),
            self._joined([part.log_gain for part in parts], 0),
        )

    def local(self, x: Tensor) -> LocalSpace:
        """Each basis its own space, set up and solved as it is alone."""
        if len(self._bases) == 1:
            return self._bases[0].local(x)
        spaces = [basis.local(at) for basis, at in zip(self._bases, x.split(self._rows), strict=True)]
        return StackedSpace(spaces, self._rows, self.centers.offsets(x))

    def check_reach(self, x: Tensor, stacklevel: int = 3) -> bool:
        """True, without a word: whoever runs several problems asks each basis about its own rows."""
        return True

    def pieces(self) -> tuple[list[int], list[StaFBasis]]:
        """Where the rows of each basis end, and the bases."""
        return list(itertools.accumulate(self._rows)), self._bases

    def _joined(self, parts: Sequence[Tensor | None], dims: int) -> Tensor | None:
        given = [part for part in parts if part is not None]
        if not given:
            return None
        assert len(given) == len(parts)  # one kernel type
        return torch.cat([_rows_of(part, rows, dims) for part, rows in zip(given, self._rows, strict=True)])


def _rows_of(quantity: Tensor, rows: int, dims: int) -> Tensor:
    """(rows, T, ...) as it is; (...) of ``dims`` dimensions, which serves all states, as (rows, 1, ...)."""
    return quantity if quantity.dim() > dims else quantity.expand(rows, 1, *quantity.shape)


class StackedSpace(NamedTuple):
    """Local spaces, each at the states of its own rows; see `LocalSpace`."""

    spaces: list[LocalSpace]
    rows: list[int]
    offsets: Tensor  # d, (B, T or 1, M, n), or (M, n) for all states

    @property
    def rank(self) -> Tensor:
        """(B, T) or (B, 1)."""
        return torch.cat([_rows_of(s.rank, rows, 0) for s, rows in zip(self.spaces, self.rows, strict=True)])

    def fit(self, values: Tensor) -> Tensor:
        """The ideal coefficients: (B, T, M) -> (B, T, M)."""
        return self._each("fit", values)

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (P, n) for all states or (B, T, P, n), (B, T, M) -> (B, T, P)."""
        apart = zip(self.spaces, self._points(z), coefficients.split(self.rows), strict=True)
        return torch.cat([space.evaluate(at, beta) for space, at, beta in apart])

    def evaluate_with_gradient(self, z: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """V^(x + z) and its gradient in z: the same -> (B, T, P), (B, T, P, n)."""
        apart = zip(self.spaces, self._points(z), coefficients.split(self.rows), strict=True)
        found = [space.evaluate_with_gradient(at, beta) for space, at, beta in apart]
        values, gradients = zip(*found, strict=True)
        return torch.cat(values), torch.cat(gradients)

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """e^{g(x)} w: (B, T, M) -> (B, T, M)."""
        return self._each("scaled_weights", coefficients)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (B, T, M) -> (B, T, M)."""
        return self._each("weights", coefficients)

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta from the paper's w: (B, T, M) -> (B, T, M)."""
        return self._each("coefficients", weights)

    def _points(self, z: Tensor) -> Sequence[Tensor]:
        """Points of each basis."""
        return [z] * len(self.spaces) if z.dim() == 2 else z.split(self.rows)

    def _each(self, method: str, given: Tensor) -> Tensor:
        apart = zip(self.spaces, given.split(self.rows), strict=True)
        return torch.cat([getattr(space, method)(rows) for space, rows in apart])


class StackedTarget(nn.Module):
    """Targets V_i, each for the next ``rows[i]`` rows of every batch.

    Args:
        targets: functions (..., n) -> (...).
        rows: of each, at least 1.
    """

    def __init__(self, targets: Sequence[Target], rows: Sequence[int]) -> None:
        super().__init__()
        self._targets, self._rows = list(targets), list(rows)

    def pieces(self) -> tuple[list[int], list[Target]]:
        """Where the rows of each target end, and the targets."""
        return list(itertools.accumulate(self._rows)), self._targets

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([target(at) for target, at in zip(self._targets, x.split(self._rows), strict=True)])


class Part(NamedTuple):
    """Rows of a batch with one basis and one target."""

    rows: slice
    basis: StaFBasis
    target: Target


def parts(basis: StaFBasis, target: Target) -> list[Part]:
    """What a basis and a target, stacked or not, are made of, in the order of the rows."""
    base_ends, bases = basis.pieces() if isinstance(basis, StackedBasis) else ([], [basis])
    target_ends, targets = target.pieces() if isinstance(target, StackedTarget) else ([], [target])
    cuts = sorted({0, *base_ends, *target_ends})
    if len(bases) == len(targets) == 1:
        return [Part(slice(None), bases[0], targets[0])]
    return [
        Part(slice(at, stop), bases[bisect_right(base_ends, at)], targets[bisect_right(target_ends, at)])
        for at, stop in itertools.pairwise(cuts)
    ]


def stack_hyperparameters(modules: Sequence[Module], rows: Sequence[int]) -> Module:
    """One module in place of several whose scalar buffers differ: those are (B, 1), B = sum(rows).

    Args:
        modules: of one type.
        rows: of each.

    Raises:
        ValueError: if they differ in more than scalar buffers.
    """
    first = modules[0]
    stacked = copy.deepcopy(first)
    found = [dict(module.named_buffers()) for module in modules]
    forms = [(described(module), held.keys()) for module, held in zip(modules, found, strict=True)]
    if any(form != forms[0] for form in forms):
        raise ValueError("`stack_hyperparameters(modules=...)` must differ in scalar hyperparameters alone.")
    counts = torch.tensor(rows)
    for name, buffer in found[0].items():
        values = [buffers[name] for buffers in found]
        if all(torch.equal(value, buffer) for value in values):
            continue
        if any(value.dim() > 0 for value in values):
            raise ValueError(
                f"`stack_hyperparameters(modules=...)` must agree in `{name}`, which is no scalar."
            )
        owner, _, attribute = name.rpartition(".")
        each = torch.stack(values).repeat_interleave(counts.to(buffer.device)).unsqueeze(-1)
        setattr(stacked.get_submodule(owner), attribute, each)
    return stacked
