"""What a device evaluates of a StaF approximation: the value and its gradient."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from ..local import GradedSpace
from ..module import StaF
from .ridges import RidgeApproximator


class LocalApproximator(nn.Module):
    """V^(y) and its gradient around one state, the centers frozen, for any kernel, by the library's own
    local basis. The arithmetic is in float64 whatever comes in and goes out: a sum of kernels loses most
    digits of float32 to cancellation.

    Args:
        staf: fitted, of one state.
        dtype: of what comes in and goes out.

    Attributes:
        state: x, (n,).
        radius: nu(x), float.
    """

    def __init__(self, staf: StaF, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        if staf.state.dim() != 1:
            raise ValueError(
                f"`LocalApproximator(staf=...)` must have one state; got the batch {staf.state.shape[:-1]}."
            )
        own = copy.deepcopy(staf).double()
        self.dtype = dtype
        self.radius = float(own.basis.centers.radius(own.state).detach())
        self.register_buffer("state", own.state.detach())
        self.state: Tensor
        # Not a submodule: what the local basis is made of is constant here.
        self._space = own.basis.local(self.state)
        self._coefficients = own.coefficients.detach()

    def forward(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """V^ and grad V^: (B, n) -> (B,), (B, n)."""
        z = y.double() - self.state
        value, gradient = self._value(z), torch.func.grad(lambda at: self._value(at).sum())(z)
        return value.to(self.dtype), gradient.to(self.dtype)

    def _value(self, z: Tensor) -> Tensor:
        return self._space.evaluate(z, self._coefficients)


Approximator = RidgeApproximator | LocalApproximator


def approximator(staf: StaF, dtype: torch.dtype = torch.float64, reach: float = 10.0) -> Approximator:
    """The leanest module for V^ and its gradient around the one state of a fitted `StaF`.

    Example:
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), radius=0.1))
        >>> x = torch.tensor([1.0, 0.0], dtype=torch.float64)
        >>> value, gradient = deploy.approximator(StaF(basis).fit_(x, targets.Paper()))(x[None])
        >>> value.shape, gradient.shape
        (torch.Size([1]), torch.Size([1, 2]))

    Args:
        staf: fitted, of one state.
        dtype: of what comes in and goes out, and of the arithmetic where that keeps its digits.
        reach: as in `RidgeApproximator`.

    Raises:
        ValueError: if the approximation is of a batch of states, or ``reach`` is not positive.
    """
    space = staf.basis.local(staf.state.detach())
    graded = isinstance(space, GradedSpace) and space.rate.dim() == space.radius.dim() == 0
    if staf.state.dim() == 1 and graded:
        return RidgeApproximator(staf, dtype, reach)
    return LocalApproximator(staf, dtype)
