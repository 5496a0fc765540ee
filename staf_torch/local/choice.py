"""Which local basis a kernel gets."""

from __future__ import annotations

from torch import Tensor

from ..kernels import Kernel, PolynomialKernel
from .elimination import Degrees, degrees_of


def choose(kernel: Kernel, directions: Tensor) -> tuple[str, Degrees | None]:
    """The kind of local basis, and what fixes it for these directions (M, n), None where nothing has to.

    Raises:
        ValueError: if directions coincide to rounding, for a graded basis.
    """
    if kernel.exponent_rate() is not None:
        return "graded", degrees_of(directions)
    if isinstance(kernel, PolynomialKernel) and kernel.full:
        degrees = degrees_of(directions)
        # A functional of a higher degree than the kernel's sees nothing: a case for the Newton basis.
        if len(degrees.sizes) <= kernel.degree + 1:
            return "polynomial", degrees
    return "newton", None
