"""Predictors of the weights from time to time, and the derivatives of V(c) and the Gram matrix they use."""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..lanes.per_row.objects import OfRows
from ..numerics.checks import choice
from ..numerics.derivatives import use_forward_mode

PredictorInputs = tuple[Tensor, ...]
"""What a predictor prepares in bulk: tensors (B, C, ...), those of one time (B, ...)."""


class Predictor(metaclass=OfRows):
    """Base class: the weights' step from one time to the next, before they are corrected there.

    Like a law it is pure and holds hyperparameters only. The weights of a chase at x_k are e^{g(x_k)} times
    the paper's, with g the kernel's `log_gain`.

    Example:
        >>> issubclass(predictors.Tangent, predictors.Predictor), predictors.Secant().products(6)
        (True, 0)

        Shown by `staf experiment=laws`.

    Attributes:
        guarded: whether a prediction is dropped, row by row, where it is worse at its arrival than the
            weights held, F(predicted) > F(held). It costs two products with K a time.
    """

    guarded: bool = False

    def products(self, count: int) -> int:
        """Work of one time step, in products of an M x M matrix with a vector, with M = ``count`` centers."""
        return 2 if self.guarded else 0

    @property
    def title(self) -> str:
        """The predictor as in a sentence, from the name of its class."""
        return type(self).__name__.lower()

    def prepare(
        self, basis: StaFBasis, target: Target, states: Tensor, start: int | Tensor
    ) -> PredictorInputs:
        """Compute in bulk the quantities that `predict` reads at the C arrivals of a chunk of time.

        Args:
            basis: kernel and centers.
            target: V.
            states: the two before the chunk, then the chunk, (B, 2 + C, n); what lies before the first
                time of all repeats it.
            start: the index of the first arrival; (B,) within a row program, where it is not known before.
        """
        return ()

    @abc.abstractmethod
    def predict(self, inputs: PredictorInputs, weights: Tensor, previous: Tensor, unit: Tensor) -> Tensor:
        """The weights to start from at an arrival.

        Args:
            inputs: what `Predictor.prepare` returned for this arrival.
            weights: as corrected at the time before, (B, M).
            previous: as corrected at the time before that, (B, M); at the start, the same as weights;
                both in units of the state that they leave.
            unit: e^{g(x_{k+1}) - g(x_k)}, (B, 1): what holding the paper's weights multiplies them by.

        Returns:
            (B, M), in units of the state that they reach.
        """


class Secant(Predictor):
    """a_{k+1} <- 2 a_k - a_{k-1}, of the paper's weights as they were corrected.

    Needs no gradient of V, but repeats the error of the correction: the weights that it extrapolates
    are not the ideal ones. In directions that the law hardly corrects they run away: six centers under ten
    line searches at dt = 0.02 reach thousands of times F(0). The guard keeps them bounded; with three
    centers it gains a factor 9 under ten line searches and loses a factor 6 under one.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=50)
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> plain, guessed = (
        ...     chase(states, basis, targets.Paper(), optim.SteepestDescent(), predictor=p).excess[0, -1]
        ...     for p in (None, predictors.Secant())
        ... )
        >>> bool(guessed < plain)
        True

        Shown by `staf predictor=secant`.

    Args:
        guarded: whether to drop, row by row, a prediction that is worse than the weights held.
    """

    def __init__(self, guarded: bool = False) -> None:
        self.guarded = guarded

    def predict(self, inputs: PredictorInputs, weights: Tensor, previous: Tensor, unit: Tensor) -> Tensor:
        return unit * (2 * weights - previous)


class Tangent(Predictor):
    """A step of w' = K^-1 (d/dt V(c) - K' w), the implicit derivative of K(c) w = V(c), from w = a_k.

    V(c) and K are differentiated along the trajectory by one forward-mode product. No model of the plant
    is asked for: x_{k+1} is known on arrival there, when the prediction is made. Both orders are affine
    in the weights, and what they read is computed in bulk, with u = K^-1 dV(c) and J = K^-1 dK:

    ``order=1``: Euler at x_k, a <- a + u - J a along dx = (x_{k+1} - x_{k-1}) / 2 = dt x' + O(dt^3)
        (forward at the first step). It leaves an excess O(dt^4) to correct.
    ``order=2``: the midpoint rule at (x_k + x_{k+1}) / 2, a <- a + u - J (a + (u - J a) / 2) along
        dx = x_{k+1} - x_k. It leaves O(dt^6) at the same cost.

    K and the weights are those of the chase, e^{-g} K and e^g w: K w = V(c) all the same, and where g(x) is
    steep the paper's weights would change by orders of magnitude in a step.

    Under one iteration of steepest descent the first order is chaotic: perturbations of 1e-14 of the
    initial weights change its ultimate excess between 5e-5 and 1.7e-4 in the paper's simulation. The second
    leaves 1e-11 there.

    Example:
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> states = systems.simulate(systems.Oscillator(), x0, dt=0.01, steps=50)
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> plain, guessed = (
        ...     chase(states, basis, targets.Paper(), optim.SteepestDescent(), predictor=p).excess[0, -1]
        ...     for p in (None, predictors.Tangent())
        ... )
        >>> bool(guessed < plain)
        True

        Shown by `staf predictor=tangent`.

    Args:
        order: 1 or 2.

    Raises:
        ValueError: for another order.

    The target and the kernel must be differentiable in forward mode.
    """

    def __init__(self, order: int = 2) -> None:
        choice("Tangent", "order", order, (1, 2))
        self.order = order

    def products(self, count: int) -> int:
        return self.order * count + 2  # M solves and two products, and M more of these for order 2

    @property
    def title(self) -> str:
        return f"tangent order {self.order}"

    def prepare(
        self, basis: StaFBasis, target: Target, states: Tensor, start: int | Tensor
    ) -> PredictorInputs:
        before, x, after = states[:, :-2], states[:, 1:-1], states[:, 2:]
        if self.order == 2:
            advance, relax = _tangent(basis, target, (x + after) / 2, after - x)
            return advance - _apply(relax, advance) / 2, relax - relax @ relax / 2
        start = start if isinstance(start, int) else start.unsqueeze(-1)
        first = (torch.arange(x.shape[1], device=x.device) + start) == 1
        return _tangent(basis, target, x, torch.where(first.unsqueeze(-1), after - x, (after - before) / 2))

    def predict(self, inputs: PredictorInputs, weights: Tensor, previous: Tensor, unit: Tensor) -> Tensor:
        advance, relax = inputs
        return weights + advance - _apply(relax, weights)


def _tangent(basis: StaFBasis, target: Target, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
    """K^-1 dV(c) and K^-1 dK at the states x along dx, with e^{-g} K for K: (B, C, M), (B, C, M, M)."""
    rates = gram_rates(basis, target, x, dx)
    space = basis.local(x)
    columns = space.scaled_weights(space.fit(rates.gram_rate.movedim(-1, 0)))  # (M, ..., M), each a fit
    return space.scaled_weights(space.fit(rates.values_rate)), columns.movedim(0, -1)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix * vector.unsqueeze(-2)).sum(-1)


class GramRates(NamedTuple):
    """V(c(x)) and e^{-g} K(c(x)) at the states x, and their derivatives along dx."""

    values: Tensor  # (..., M)
    gram: Tensor  # (..., M, M)
    values_rate: Tensor  # (..., M)
    gram_rate: Tensor  # (..., M, M)


def gram_rates(basis: StaFBasis, target: Target, x: Tensor, dx: Tensor) -> GramRates:
    """Return V(c), e^{-g} K(c) and their derivatives along dx, by one forward-mode product.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> x = torch.tensor([[1.0, 0.5]]).double()
        >>> rates = gram_rates(basis, targets.Paper(), x, torch.tensor([[0.1, 0.0]]).double())
        >>> type(rates).__name__
        'GramRates'

        Shown by `staf predictor=tangent`.

    Args:
        basis: kernel and centers.
        target: V.
        x: states, (..., n).
        dx: direction of the states, (..., n); velocities give derivatives by time.
    """

    def structure(at: Tensor) -> tuple[Tensor, Tensor]:
        gram = basis.gram_structure(at).scaled()
        return basis.values(at, target), gram.expand(*x.shape[:-1], basis.count, basis.count)

    (values, gram), (values_rate, gram_rate) = along(structure, x, dx)
    return GramRates(values, gram, values_rate, gram_rate)


def along(function: Callable[[Tensor], Any], x: Tensor, dx: Tensor) -> tuple[Any, Any]:
    """f(x) and its derivative along dx, in forward mode: torch.func.jvp without the warning that torch
    gives itself on first use, which would end a program in which warnings are errors.

    Example:
        >>> x, dx = torch.tensor([1.0, 2.0]), torch.tensor([0.1, 0.0])
        >>> value, rate = along(lambda x: x.square().sum(-1), x, dx)
        >>> float(value), round(float(rate), 6)
        (5.0, 0.2)

        Shown by `staf predictor=tangent`.

    Raises:
        NotImplementedError: if an operation of the function has no derivative in forward mode.
    """
    use_forward_mode()
    try:
        primal, tangent = torch.func.jvp(function, (x,), (dx,))[:2]
    except NotImplementedError as error:
        said = str(error).partition("\n")[0]
        raise NotImplementedError(
            "A `Tangent` predictor needs derivatives of V and of the kernel in forward mode; torch's error: "
            + said
        ) from None
    return primal, tangent
