"""What the compiled recursion finds by itself from the states, without tensors of it in memory."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..basis import StaFBasis, Target
from ..centers import ConstantRadius
from ..kernels import ExponentialKernel
from ..targets import Formula

_LIBRARY = __name__.partition(".")[0]


class NativeStructure(NamedTuple):
    """K(c(x)) = e^{g(x)} S K0 S with one K0 and offsets d for all states."""

    core: Tensor  # K0, (M, M)
    offsets: Tensor  # d, (M, n)
    exponential: bool  # S = diag(e^{x'd}) and g(x) = x'x; otherwise S = I and g = 0


def native_structure(basis: StaFBasis, states: Tensor) -> NativeStructure | None:
    """The Gram structure at all states (B, C, n), None where it needs tensors: centers at a moving radius,
    hyperparameters with a value a row, a kernel of yours."""
    kernel, centers = basis.kernel, basis.centers
    radius = centers.radius
    own = all(type(part).__module__.partition(".")[0] == _LIBRARY for part in (basis, kernel, centers))
    if not own or not kernel.state_free or type(radius) is not ConstantRadius or radius.radius.dim() > 0:
        return None
    at = states[0, 0]
    d = centers.offsets(at)
    if type(kernel) is ExponentialKernel:
        return NativeStructure(kernel.core(at, d, d), d, True)
    if kernel.log_gain(at) is not None:
        return None
    core, log_scale = kernel.core(at, d, d), kernel.log_scale(at, d)  # of d alone: see `Kernel.state_free`
    if core.dim() != 2:
        return None
    if log_scale is not None:
        scale = log_scale.exp()
        core = scale.unsqueeze(-1) * core * scale
    return NativeStructure(core, d, False)


def formula_of(target: Target, dim: int) -> Formula | None:
    """The formula of a target that gives one for what it computes, else None.

    One that was inherited says nothing of a `forward` that was not, and neither does it of hooks.
    """
    kind = type(target)
    if not isinstance(target, nn.Module) or not hasattr(kind, "formula") or "forward" in vars(target):
        return None
    if _definer(kind, "formula") is not _definer(kind, "forward"):
        return None
    if target._forward_hooks or target._forward_pre_hooks:
        return None
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*target.parameters(), *target.buffers())):
        return None
    formula: Formula = target.formula(dim)  # type: ignore[operator]
    return formula


def _definer(kind: type, name: str) -> type:
    return next(each for each in kind.__mro__ if name in vars(each))
