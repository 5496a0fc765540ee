"""Approximations with everything learnable, and the functions that they are fitted to."""

from __future__ import annotations

from collections.abc import Callable

import torch
from helpers import basis_of, uniform
from torch import Tensor, nn
from variants import LEARNABLE_KERNELS, learned

import staf_torch as st
from staf_torch.targets import Paper

RADII: dict[str, Callable[[], Tensor | st.StateRadius]] = {
    "constant": lambda: learned(0.4),
    "shrinking": lambda: st.StateRadius(learned(0.5), learned(0.1), learned(1.0)),
}
MODES = ("value", "partial", "total_frozen_weights", "total")


def target_of(outputs: int | None) -> Callable[[Tensor], Tensor]:
    """The paper's V; or V, V^2, V^3, ... of a tenth of it."""
    if outputs is None:
        return Paper()
    return lambda y: torch.stack([(0.1 * Paper()(y)) ** (k + 1) for k in range(outputs)], dim=-1)


def learnable(
    kernel: str, radius: str, batch: tuple[int, ...] = (), outputs: int | None = None, count: int = 3
) -> tuple[st.StaF, Tensor]:
    """A fitted approximation of learnable hyperparameters, and points of its ball."""
    centers = st.StateFollowingCenters(nn.Parameter(st.rings(count)), RADII[radius]())
    staf = st.StaF(st.StaFBasis(LEARNABLE_KERNELS[kernel](), centers), batch, outputs)
    x = uniform(*batch, 2, low=0.3, seed=3)
    points = x.unsqueeze(-2) + uniform(*batch, 2, 2, low=-0.1, high=0.1, seed=4)
    return staf.fit_(x, target_of(outputs)), points


def fixed(kernel: str, batch: tuple[int, ...] = (), outputs: int | None = None) -> st.StaF:
    x = uniform(*batch, 2, low=0.3, high=1.2, seed=5)
    return st.StaF(basis_of(kernel, radius=0.5), batch, outputs).fit_(x, target_of(outputs))


def evaluated(staf: st.StaF, y: Tensor, mode: str, target: Callable[[Tensor], Tensor]) -> Tensor:
    return staf(y) if mode == "value" else staf.gradient(y, mode, target)


def as_function(
    staf: st.StaF, mode: str, target: Callable[[Tensor], Tensor]
) -> tuple[Callable[..., Tensor], list[Tensor]]:
    """The approximation as a function of the points, its parameters and its state, with their values."""

    class Called(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.staf = staf

        def forward(self, y: Tensor) -> Tensor:
            return evaluated(self.staf, y, mode, target)

    names = [name for name, _ in staf.named_parameters()] + ["state"]
    values = [p.detach().clone().requires_grad_() for p in staf.parameters()]
    called = Called()

    def function(y: Tensor, *parameters: Tensor) -> Tensor:
        swapped = {f"staf.{name}": p for name, p in zip(names, parameters, strict=True)}
        return torch.func.functional_call(called, swapped, (y,))

    return function, [*values, staf.state.clone().requires_grad_()]
