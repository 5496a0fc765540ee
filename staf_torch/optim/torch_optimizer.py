"""The update laws as a torch optimizer."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim.optimizer import Optimizer, ParamsT

from ..numerics.checks import fail, integer
from .base import UpdateLaw
from .objective import NativeError


class ChaseOptimizer(Optimizer):
    """An update law on any torch loss that is quadratic in its parameters.

    A parameter (..., M) holds one independent problem a leading row: the loss is the sum over rows, or a
    tensor of row losses, and no row's loss may depend on another row or on another parameter's rows; the
    steps 1, 2, 4, 8, ... check that by two products with the curvature a parameter. The slope and the
    curvature come from autograd (double backward), the curvature exactly, one Hessian-vector product where
    `chase` has a product with K. Each `step` is a new objective (`begin`) and ``inner_steps`` iterations.

    Example:
        >>> weights = torch.zeros(5, 3, dtype=torch.float64, requires_grad=True)
        >>> optimizer = optim.ChaseOptimizer([weights], optim.ConjugateGradient(), inner_steps=3)
        >>> factor, samples = torch.eye(3, 8).double(), torch.ones(5, 8).double()
        >>> optimizer.step(lambda: (weights @ factor - samples).square().sum(-1)).shape  # the loss
        torch.Size([5])

        Shown by `tests/examples/two_optimizers.py`.

    Parameter groups have ``inner_steps``, and ``lr`` where the law has a `step_size`, which it then sets:
    learning-rate schedulers work on these laws. A rate of zero leaves the parameters alone.

    Args:
        params: parameters (..., M), or parameter groups.
        law: the update law; not one that learns from a sample at a state (`NormalisedLMS`).
        inner_steps: iterations a `step`, at least 1.

    Raises:
        ValueError: if an argument breaks its rule, or `step` gets no closure, or one that does not
            return a differentiable loss, or one that couples rows or parameters: by name, with
            the curvature between them.
    """

    def __init__(self, params: ParamsT, law: UpdateLaw, *, inner_steps: int = 1) -> None:
        if not isinstance(law, UpdateLaw):
            raise fail("ChaseOptimizer", "law", "must be an UpdateLaw", law)
        if "sampled" in law.needs:
            raise fail("ChaseOptimizer", "law", "must not need a sample at a state, as a loss has none", law)
        self.law, self._steps = law, 0
        defaults: dict[str, Any] = {"inner_steps": inner_steps}
        if law.step_size is not None:
            defaults["lr"] = law.step_size
        super().__init__(params, defaults)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """A further group of parameters, with its own ``inner_steps`` and ``lr``."""
        super().add_param_group(param_group)
        group = self.param_groups[-1]
        integer("ChaseOptimizer", "inner_steps", group["inner_steps"], least=1)
        for parameter in group["params"]:
            if parameter.dim() == 0 or not parameter.is_floating_point():
                raise ValueError(
                    "`ChaseOptimizer(params=...)` must be floating-point tensors (..., M); "
                    f"got the shape {tuple(parameter.shape)}."
                )

    @torch.no_grad()
    def step(self, closure: Callable[[], Tensor] | None = None) -> Tensor:  # type: ignore[override]
        """Take a time step of the law.

        Args:
            closure: returns the loss, a scalar or one number a row; it does not call ``backward``.

        Returns:
            The loss before the step, detached.
        """
        if closure is None:
            raise ValueError("`ChaseOptimizer.step(closure=...)` must be a function that returns the loss.")
        with torch.enable_grad():
            loss = closure()
        groups = [(group, p) for group in self.param_groups for p in group["params"] if p.requires_grad]
        slopes = _slopes(loss, [p for _, p in groups])
        self._steps += 1
        if self._steps & (self._steps - 1) == 0:  # a power of two: what couples may come later than the first
            _check_independent(self._names(), [p for _, p in groups], slopes)
        moved = []
        for (group, parameter), slope in zip(groups, slopes, strict=True):
            if slope is not None and group.get("lr") != 0:
                moved.append((parameter, self._advanced(group, parameter, slope)))
        for parameter, weights in moved:  # only now: the curvature was taken at the old parameters
            parameter.copy_(weights)
        return loss.detach()

    def __getstate__(self) -> dict[str, Any]:
        """For copies and pickle: torch's own keeps neither the law nor the count."""
        return {**super().__getstate__(), "law": self.law, "_steps": self._steps}

    def _names(self) -> list[str]:
        """Names of the parameters that are moved, as they were given or by their place."""
        return [
            f"`{group['param_names'][k]}`" if "param_names" in group else f"parameter {k} of group {g}"
            for g, group in enumerate(self.param_groups)
            for k, parameter in enumerate(group["params"])
            if parameter.requires_grad
        ]

    def _advanced(self, group: dict[str, Any], parameter: Tensor, slope: Tensor) -> Tensor:
        """The parameter's new value."""
        objective = LossObjective(parameter, slope)
        law = self.law if "lr" not in group else self.law.with_step_size(float(group["lr"]))
        weights, memory = parameter.detach().clone(), self.state[parameter]
        state = law.begin(objective, weights, memory["law"] if "law" in memory else law.init(weights))
        for _ in range(group["inner_steps"]):
            weights, state = law.step(objective, weights, state)
        memory["law"] = state
        return weights


class LossObjective:
    """The quadratic that a loss is in one of its parameters: F with -grad F(a) = g and Hessian 2 K.

    Args:
        parameter: a_0, (..., M), where the slope was taken.
        slope: grad F(a_0), (..., M), with its graph.
    """

    def __init__(self, parameter: Tensor, slope: Tensor) -> None:
        self._parameter, self._slope = parameter, slope
        self._at, self._descent = parameter.detach().clone(), -slope.detach()

    def curvature(self, direction: Tensor) -> Tensor:
        """K v: (..., M) -> (..., M)."""
        if not self._slope.requires_grad:  # a loss that is linear in this parameter
            return torch.zeros_like(direction)
        with torch.enable_grad():
            (product,) = torch.autograd.grad(
                self._slope, self._parameter, direction, retain_graph=True, allow_unused=True
            )
        return torch.zeros_like(direction) if product is None else product.detach() / 2

    def descent(self, weights: Tensor) -> Tensor:
        """g at any weights, from the slope at a_0 and the curvature: (..., M) -> (..., M)."""
        return self._descent - 2 * self.curvature(weights - self._at)

    @functools.cached_property
    def values(self) -> Tensor:
        """V = g(0) / 2: (..., M)."""
        return self.descent(torch.zeros_like(self._at)) / 2

    @functools.cached_property
    def gram(self) -> Tensor:
        """K, column by column: (..., M, M)."""
        units = torch.eye(self._at.shape[-1], dtype=self._at.dtype, device=self._at.device)
        return torch.stack([self.curvature(unit.expand_as(self._at)) for unit in units], dim=-1)

    def spectrum(self) -> tuple[Tensor, Tensor]:
        """The smallest and the largest eigenvalue of K: (...), (...)."""
        return NativeError(self.gram, self._descent).spectrum()

    def solve(self, values: Tensor) -> Tensor:
        """K^-1 v: (..., M) -> (..., M)."""
        return NativeError(self.gram, self._descent).solve(values)

    def minimiser(self) -> Tensor:
        """K^-1 V: (..., M)."""
        return self.solve(self.values)

    def sample(self) -> tuple[Tensor, Tensor]:
        """A loss has none."""
        raise ValueError("A loss has no sample at a state.")


def _slopes(loss: object, parameters: list[Tensor]) -> tuple[Tensor | None, ...]:
    if not isinstance(loss, Tensor) or not loss.requires_grad:
        got = f"a tensor {tuple(loss.shape)} without a graph" if isinstance(loss, Tensor) else repr(loss)
        raise ValueError(f"`ChaseOptimizer.step(closure=...)` must return a differentiable loss; got {got}.")
    try:
        with torch.enable_grad():
            return torch.autograd.grad(loss.sum(), parameters, create_graph=True, allow_unused=True)
    except RuntimeError as error:
        raise ValueError(
            "`ChaseOptimizer.step(closure=...)` must return the loss without calling `backward` on it; "
            f"autograd's error: {error}"
        ) from error


def _check_independent(names: list[str], parameters: list[Tensor], slopes: Sequence[Tensor | None]) -> None:
    """Refuse parameters and rows between which the loss has curvature.

    H v has no entry of another parameter, and H (s v) = s H v for one number s a row, where the rows are
    independent; with s different in every row and v at random, not otherwise.

    Args:
        names: of the parameters.
        parameters: (..., M).
        slopes: of the loss in them, with their graphs; None where it does not depend on one.

    Raises:
        ValueError: if two are coupled.
    """
    for name, parameter, slope in zip(names, parameters, slopes, strict=True):
        if slope is None or not slope.requires_grad:
            continue
        generator = torch.Generator().manual_seed(0)
        v = torch.randn(parameter.shape, dtype=torch.float64, generator=generator, device="cpu").to(parameter)
        rows = (
            torch.linspace(1, 2, v[..., 0].numel(), dtype=torch.float64, device="cpu")
            .to(v)
            .view_as(v[..., :1])
        )
        products = _products(slope, parameters, v)
        own = products[[p is parameter for p in parameters].index(True)]
        size, rounding = float(own.norm()), torch.finfo(v.dtype).eps ** 0.5
        for other, its, product in zip(names, parameters, products, strict=True):
            between = float(product.norm())
            if its is not parameter and between > rounding * size:
                raise ValueError(
                    f"`ChaseOptimizer(params=...)` must be independent of each other: the curvature of the "
                    f"loss between {name} and {other} is {_times(between, size)} of {name} itself. "
                    "Make them one parameter, or leave one of them to another optimizer."
                )
        apart = (_products(slope, [parameter], rows * v)[0] - rows * own).norm(dim=-1)
        whole = own.norm(dim=-1)
        coupled = apart > rounding * whole + torch.finfo(v.dtype).eps * whole.amax()
        if bool(coupled.any()):
            first = tuple(coupled.nonzero()[0].tolist())
            alone = torch.zeros_like(v)
            alone[first] = v[first]
            found = _products(slope, [parameter], alone)[0].norm(dim=-1)
            within = float(found[first])
            found[first] = 0
            second = tuple((found == found.max()).nonzero()[0].tolist())
            raise ValueError(
                f"`ChaseOptimizer(params=...)` must have rows that are independent problems: in {name} of "
                f"the shape {tuple(parameter.shape)} the curvature of the loss between the rows {first} and "
                f"{second} is {_times(float(found.max()), within)} of row {first} itself. Make what belongs "
                "together one row (..., M), or take another optimizer."
            )


def _times(size: float, other: float) -> str:
    return f"{size / other if other else torch.inf:.3g} times that"


def _products(slope: Tensor, parameters: list[Tensor], direction: Tensor) -> list[Tensor]:
    """The second derivatives of a loss, in a direction of one parameter's slope and in each parameter."""
    with torch.enable_grad():
        found = torch.autograd.grad(slope, parameters, direction, retain_graph=True, allow_unused=True)
    given = zip(parameters, found, strict=True)
    return [torch.zeros_like(p) if product is None else product.detach() for p, product in given]
