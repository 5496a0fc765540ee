"""Base class of update laws."""

from __future__ import annotations

import abc
from typing import Any, Self

import torch
from torch import Tensor

from ..lanes import repeat
from ..lanes.per_row.objects import OfRows
from .objective import Objective

LawState = tuple[Tensor, ...]
"""What a law carries from one iteration to the next: tensors (...), (..., M) or (..., M, M) a row."""


class UpdateLaw(metaclass=OfRows):
    """A pure iteration on a quadratic: state goes in as an argument and comes out as a value.

    A law object holds hyperparameters only. Rows never touch each other.

    Example:
        >>> class Halfway(optim.UpdateLaw):
        ...     def step(self, objective, weights, state):
        ...         return weights + 0.1 * objective.descent(weights), state
        >>> Halfway().title, Halfway().products(6, iterations=10)
        ('halfway', 11)

        Shown by `staf experiment=laws`.

    Attributes:
        needs: the fields of `Precomputed` that the law will ask for at every time; a chase computes them in
            bulk. Without them an `Objective` computes what it is asked for on the spot.
        step_size: the hyperparameter that a learning-rate schedule may drive, None where there is none.
    """

    needs: frozenset[str] = frozenset()
    step_size: float | None = None

    @classmethod
    def from_settings(cls, *, inner_steps: int | None = None, **arguments: Any) -> Self:
        """Return the law of a node of settings that also says how many iterations a chase takes.

        The group `optimizer` of `staf` is such a node: ``inner_steps`` is an argument of `chase`, not of the
        law, which is made of the other arguments.

        Args:
            inner_steps: not used here.
            arguments: those of the constructor.
        """
        return cls(**arguments)

    def init(self, weights: Tensor) -> LawState:
        """The state before the first iteration, for weights (..., M)."""
        return ()

    def begin(self, objective: Objective, weights: Tensor, state: LawState) -> LawState:
        """The state when a new objective begins: once a time step, before its first iteration."""
        return state

    @abc.abstractmethod
    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        """Iterate once: the new weights (..., M) and the new state."""

    def iterate(
        self, objective: Objective, weights: Tensor, state: LawState, count: int
    ) -> tuple[Tensor, LawState]:
        """``count`` iterations: `step` again and again, but for rounding.

        A law whose step finds anew what it could carry along, a residual say, may do so here.
        """

        def once(carry: tuple[Tensor, LawState]) -> tuple[Tensor, LawState]:
            return self.step(objective, *carry)

        moved: tuple[Tensor, LawState] = repeat(count, once, (weights, state))
        return moved

    def rescale(self, state: LawState, factor: Tensor) -> LawState:
        """The state when the unit of the weights changes, a -> factor a, K -> K / factor: (..., 1).

        The default scales vectors (..., M), as is right for velocities, and matrices (..., M, M), as is right
        for K^-1; numbers (...), a count or a flag say, stay. A law that carries others, gradients say, which
        the unit leaves alone, says so here.
        """
        extra = factor.dim() - 1
        return tuple(
            part
            if part.dim() == extra
            else part * factor.view(*factor.shape, *[1] * (part.dim() - extra - 1))
            for part in state
        )

    def contraction(self, condition_number: Tensor) -> Tensor | None:
        """A bound on excess after / excess before of one iteration, from kappa(K); None: not known."""
        return None

    def products(self, count: int, iterations: int) -> int:
        """Work of one time step, in products of an M x M matrix with a vector: with K and with K^-1.

        The default is a law that carries its residual: one product an iteration, and one to begin.

        Args:
            count: M.
            iterations: in the time step.
        """
        return iterations + 1

    @property
    def title(self) -> str:
        """The law as in a sentence, from the name of its class: `steepest descent`."""
        return "".join(" " + c.lower() if c.isupper() else c for c in type(self).__name__).strip()

    def with_step_size(self, size: float) -> UpdateLaw:
        """Return a copy of the law with another `step_size`.

        Raises:
            ValueError: if the law has none, or the size breaks its rule.
        """
        raise ValueError(f"`{type(self).__name__}` has no step size to set; got {size!r}.")


def line_search(objective: Objective, g: Tensor, direction: Tensor) -> Tensor:
    """lambda = g'p / (2 p'K p), the minimiser of F(a + lambda p), and 0 where p'K p is not positive.

    Args:
        objective: F.
        g: -grad F(a), (..., M).
        direction: p, (..., M).

    Returns:
        (..., 1).
    """
    slope = torch.linalg.vecdot(g, direction)
    curvature = torch.linalg.vecdot(direction, objective.curvature(direction))
    usable = curvature > 0
    length = torch.where(usable, slope / (2 * torch.where(usable, curvature, 1.0)), 0.0)
    return length.unsqueeze(-1)


def worse_than_none(objective: Objective, weights: Tensor, g: Tensor) -> Tensor:
    """Return whether F(a) > F(0), by which a row is recognised that a law with momentum has lost.

    Args:
        objective: F.
        weights: a, (..., M).
        g: -grad F(a), (..., M).

    Returns:
        (..., 1) bool; F(a) - F(0) = -a'(V + g/2) needs no further product with K.
    """
    rise = -torch.linalg.vecdot(weights, objective.values + g / 2)
    worse: Tensor = (rise > 0).unsqueeze(-1)
    return worse
