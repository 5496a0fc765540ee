"""The sequential part of a gradient chase for the paper's law on the CPU: one call a piece of time.

It computes what `recursion` defines, to rounding: g <- g - 2 lambda K g in place of a new residual an
iteration, one product with K in place of two, all of it in registers with trajectories as lanes.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ..basis import GramStructure
from ..optim import SteepestDescent, UpdateLaw
from ._compiled import compiled
from ._workers import openmp
from .recursion import Carry

_REALS = {torch.float32: "float", torch.float64: "double"}


class _Array(ctypes.Structure):
    _fields_ = (
        ("data", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("row", "time", "entry")),
    )


class _Problem(ctypes.Structure):
    _fields_ = (
        *((n, ctypes.c_int64) for n in ("batch", "times", "count", "inner_steps", "start", "threads")),
        ("core", ctypes.c_void_p),
        *((n, ctypes.c_int64) for n in ("core_row", "core_time", "core_i", "core_j")),
        ("values", _Array),
        ("log_scale", _Array),
        ("log_gain", _Array),
        *((n, ctypes.c_void_p) for n in ("last_gain", "weights", "diverged_at", "before", "after")),
        *((name, ctypes.c_int64) for name in ("history_time", "history_entry", "papers")),
        ("parallel", ctypes.c_void_p),
    )


class History(NamedTuple):
    """Where the weights of a piece are written, if at all: (C, M, B), contiguous in B, equally strided."""

    before: Tensor | None = None
    after: Tensor | None = None
    recorded: Tensor | None = None  # the paper's w in place of its units of e^{-g}; excludes the others


def fusible(law: UpdateLaw, inner_steps: int, tensors: Iterable[Tensor | None]) -> bool:
    """Whether the fused recursion computes this: the paper's law, plain CPU tensors without gradient."""
    given = [tensor for tensor in tensors if tensor is not None]
    return (
        type(law) is SteepestDescent
        and inner_steps > 0
        and not torch.compiler.is_compiling()
        and all(_plain(tensor, given[0].dtype) for tensor in given)
        and compiled(_REALS[given[0].dtype]) is not None
    )


def _plain(tensor: Tensor, dtype: torch.dtype) -> bool:
    return (
        type(tensor) is Tensor
        and tensor.device.type == "cpu"
        and tensor.dtype is dtype
        and dtype in _REALS
        and not (tensor.requires_grad and torch.is_grad_enabled())
        and not torch._C._functorch.is_functorch_wrapped_tensor(tensor)  # vmap, jvp, ...
        and forward_ad.unpack_dual(tensor).tangent is None
    )


def fused(
    structure: GramStructure, values: Tensor, inner_steps: int, carry: Carry, history: History
) -> Carry:
    """Correct the weights at every time of a piece, and write what ``history`` asks for.

    Args:
        structure: the Gram factors of the piece, (B, C).
        values: V(c(x_k)), (B, C, M).
        inner_steps: iterations a time, at least 1.
        carry: from the piece before, left as it is.
        history: written.
    """
    batch, times, count = values.shape
    log_scale, log_gain = structure.log_scale, structure.log_gain
    core = structure.core.expand(batch, times, count, count)
    # In and out, so copies: a result of the piece before may share them.
    weights, last_gain, diverged_at = map(_copy, (carry.weights.mT, carry.log_gain, carry.diverged_at))
    after = history.after if history.recorded is None else history.recorded
    problem = _Problem(
        *(batch, times, count, inner_steps, carry.time, torch.get_num_threads()),
        *(core.data_ptr(), *core.stride()),
        _array(values),
        _array(None if log_scale is None else log_scale.expand(values.shape)),
        _array(None if log_gain is None else log_gain.expand(batch, times).unsqueeze(-1)),
        None if log_gain is None else last_gain.data_ptr(),
        *(weights.data_ptr(), diverged_at.data_ptr(), _pointer(history.before), _pointer(after)),
        *((0, 0) if after is None else after.stride()[:2]),
        *(history.recorded is not None, _parallel()),
    )
    solve = compiled(_REALS[values.dtype])
    assert solve is not None
    solve(ctypes.byref(problem))
    time = carry.time + times
    return carry._replace(weights=weights.mT, log_gain=last_gain, time=time, diverged_at=diverged_at)


def _copy(tensor: Tensor) -> Tensor:
    return tensor.clone(memory_format=torch.contiguous_format)


def _array(tensor: Tensor | None) -> _Array:
    return _Array() if tensor is None else _Array(tensor.data_ptr(), *tensor.stride())


def _pointer(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


def _parallel() -> int | None:
    """The OpenMP entry that torch itself runs on: a second pool of threads on the same cores makes
    both several times slower. Without it the library starts threads of its own."""
    entry = openmp("GOMP_parallel")
    return None if entry is None else ctypes.cast(entry, ctypes.c_void_p).value  # type: ignore[arg-type]
