"""Derivatives of functions: of rows backwards and forwards, and by differences of what can only be called."""

from __future__ import annotations

import functools
import math
import operator
import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from ..lanes.calls.inputs import seen_by_others
from ..lanes.gradients import backward, jacrev, vjp

STEP = 6e-6  # the cube root of the rounding error: a central difference is then good to its square


Apart = Callable[[Tensor, Tensor], Tensor]
"""The difference of two values of a function."""


def central_slopes(
    function: Callable[[Tensor], Tensor],
    at: Tensor,  # (n,), float64
    scale: Tensor | None = None,  # (n,) of the unknowns: a step is 6e-6 of it; None for max(1, |at|)
    apart: Apart = operator.sub,  # the difference of two values, (B, k), (B, k) -> (B, k)
) -> Tensor:
    """Return the Jacobian (k, n) of a batched function (B, n) -> (B, k) at one point, from 2n rows in one
    call."""
    size = at.abs().clamp(min=1.0) if scale is None else scale
    steps = torch.diag(STEP * size)
    probes = torch.cat((at + steps, at - steps))
    ahead, behind = function(probes).chunk(2)
    widths = (probes[: len(at)] - probes[len(at) :]).diagonal()  # as represented, not as wanted
    return (apart(ahead, behind) / widths.unsqueeze(-1)).mT


def row_jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Return values (..., *outputs) and derivatives (..., *outputs, n) of a function of rows, in which no
    row sees another, at (..., n): one backward pass for every entry of an output, whatever the number of
    rows."""
    values, pull = vjp(function, at)[:2]
    outputs = values.shape[at.dim() - 1 :]
    if not outputs:
        return values, pull(torch.ones_like(values))[0]
    units = torch.eye(math.prod(outputs), dtype=values.dtype, device=values.device)
    rows = [pull(unit.reshape(outputs).expand_as(values).contiguous())[0] for unit in units.unbind(0)]
    return values, torch.stack(rows, dim=-2).unflatten(-2, outputs)


def point_jacobian(function: Callable[[Tensor], Tensor], at: Tensor, count: int) -> Tensor:
    """Return the derivative (*outputs, n) of a function of points (..., n) -> (..., *outputs) at one of them
    (n,), by one backward pass for all ``count`` entries of an output.

    A tenth of the time of `torch.func.jacrev`, which is left to transforms and traces.
    """
    if seen_by_others() or torch.is_inference_mode_enabled() or torch.compiler.is_compiling():
        slopes: Tensor = jacrev(function)(at)
        return slopes.detach()
    points = at.detach().expand(count, -1).clone().requires_grad_()
    with torch.enable_grad():
        values = function(points)
    outputs = values.shape[1:]
    if not values.requires_grad:
        return torch.zeros(*outputs, len(at), dtype=values.dtype, device=values.device)
    units = torch.eye(count, dtype=values.dtype, device=values.device).view_as(values)
    (found,) = backward((values,), (points,), (units,), create_graph=False)
    return found.view(*outputs, len(at))


def slope_of(values: Tensor, at: Tensor, *, create_graph: bool = False) -> Tensor:
    """Return the derivative of the sum of values by ``at``: 0 where they do not depend on it. With
    ``create_graph`` it is differentiated again; else the graph is kept for others."""
    if not values.requires_grad:
        return torch.zeros_like(at)
    return torch.autograd.grad(
        values.sum(), at, retain_graph=True, create_graph=create_graph, materialize_grads=True
    )[0]


@functools.cache
def use_forward_mode() -> None:
    """Let torch load what its forward mode needs, without its warning about its own `torch.jit.script`."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.script")
        torch.func.jvp(
            torch.sin, (torch.zeros(1, device="cpu").double(),), (torch.ones(1, device="cpu").double(),)
        )


def jacobian(function: Callable[[Tensor], Tensor], y: Tensor) -> Tensor:
    """ds_i/dy_j of a function of every row by itself, (..., n) -> (..., M): (..., M, n).

    A derivative along every coordinate where there are fewer of these than values, else one pass backwards a
    value; backwards, too, where an operation of a user's own has no derivative in forward mode, and where
    the batch is traced as any: forward mode asks torch for its size as a number.
    """
    use_forward_mode()
    units = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
    if not any(isinstance(size, torch.SymInt) for size in y.shape):
        try:
            values, first = torch.func.jvp(function, (y,), (units[0].expand_as(y).clone(),))[:2]
            if len(units) <= values.shape[-1]:
                rest = [torch.func.jvp(function, (y,), (unit.expand_as(y).clone(),))[1] for unit in units[1:]]
                return torch.stack([first, *rest], dim=-1)
        except RuntimeError:  # NotImplementedError is one; what else is wrong is so backwards, too
            pass
    return row_jacobian(function, y)[1]
