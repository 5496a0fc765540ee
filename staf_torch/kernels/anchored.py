"""The kernel of the functions that vanish at the origin."""

from __future__ import annotations

import torch
from torch import Tensor

from .base import Kernel


class AnchoredKernel(Kernel):
    """k_0(y, c) = k(y, c) - k(y, 0) k(0, c) / k(0, 0).

    The reproducing kernel of {f in H : f(0) = 0}. For the exponential kernel it is exp(y'c) - 1, the
    basis of the paper's optimal regulation example, so that V^(0) = 0. A center at the origin spans
    nothing.

    Example:
        >>> k = AnchoredKernel(ExponentialKernel())
        >>> k(torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double())
        tensor([[1.7183, 0.0000]], dtype=torch.float64)

        Shown by `staf experiment=adp`.

    Args:
        kernel: the kernel k, with k(0, 0) > 0.

    Raises:
        ValueError: if ``kernel`` is not a kernel, or k(0, 0) is not positive.
    """

    def __init__(self, kernel: Kernel) -> None:
        super().__init__()
        if not isinstance(kernel, Kernel):
            raise ValueError(f"`AnchoredKernel(kernel=...)` must be a Kernel; got {type(kernel).__name__}.")
        zero = torch.zeros(1, 1, dtype=torch.float64, device="cpu")
        corner = kernel(zero, zero)
        if not corner.is_meta and not bool((corner > 0).all()):
            raise ValueError(
                "`AnchoredKernel(kernel=...)` must have k(0, 0) > 0; "
                f"got {corner.flatten().tolist()} from {type(kernel).__name__}."
            )
        self.kernel = kernel

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return self.kernel.anchored(x1, x2)

    def gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor | None:
        return self.kernel.anchored_gradient(x1, x2, b)

    def rank(self, dim: int) -> int | None:
        base = self.kernel.rank(dim)
        return None if base is None else base - 1
