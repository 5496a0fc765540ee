"""The sequential part of a gradient chase for the paper's law on the CPU: one call a piece of time.

It computes what `recursion` defines, to rounding: g <- g - 2 lambda K g in place of a new residual an
iteration, one product with K in place of two, all of it in registers with trajectories as lanes. What the
weights do not touch, e^{s(x, d)}, g(x) and V at the centers, it finds a cacheful at a time from the states,
where a formula is known, and else reads from tensors.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ..basis import GramStructure
from ..optim import SteepestDescent, UpdateLaw
from ..targets import Formula
from ._compiled import compiled
from ._openmp import openmp
from .native import NativeStructure
from .recursion import Carry

_REALS = {torch.float32: "float", torch.float64: "double"}


class _Array(ctypes.Structure):
    _fields_ = (
        ("data", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("row", "time", "entry")),
    )


class _Problem(ctypes.Structure):
    _fields_ = (
        *((n, ctypes.c_int64) for n in ("batch", "times", "dim", "inner_steps", "start", "threads")),
        ("core", ctypes.c_void_p),
        *((n, ctypes.c_int64) for n in ("core_row", "core_time", "core_i", "core_j")),
        ("states", _Array),
        ("offsets", ctypes.c_void_p),
        ("exponential", ctypes.c_int64),
        ("evaluate", ctypes.c_void_p),
        ("parameters", ctypes.c_void_p),
        ("values", _Array),
        ("log_scale", _Array),
        ("log_gain", _Array),
        *((n, ctypes.c_void_p) for n in ("most", "last_gain", "weights", "diverged_at", "before", "after")),
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


def built(dtype: torch.dtype, count: int, *, shared: bool) -> Callable[..., None] | None:
    """The compiled recursion for this many centers, None where there is none.

    Args:
        dtype: of all tensors.
        count: M.
        shared: whether one K0 serves all states.
    """
    real, one = _REALS[dtype], str(shared).lower()
    return compiled("recursion", f"REAL={real}", f"COUNT={count}", f"SHARED={one}")


def evaluator(formula: Formula, dtype: torch.dtype, dim: int) -> Callable[..., None] | None:
    """The compiled formula of a target, None where it cannot be built."""
    return compiled("target", f"REAL={_REALS[dtype]}", f"DIM={dim}", f"FORMULA={formula.expression}")


def fused(
    states: Tensor,
    structure: GramStructure | NativeStructure,
    values: Tensor | Formula,
    inner_steps: int,
    carry: Carry,
    history: History,
    most: Tensor | None = None,
) -> Carry:
    """Correct the weights at every time of a piece, and write what ``history`` asks for.

    Args:
        states: x, (B, C, n).
        structure: the Gram factors of the piece, (B, C), or those of all states.
        values: V(c(x_k)), (B, C, M), or the formula of V, which goes with a `NativeStructure`.
        inner_steps: iterations a time, at least 1.
        carry: from the piece before, left as it is.
        history: written.
        most: (1,), written where g(x) is found here: the largest of it that is finite.
    """
    batch, times, dim = states.shape
    count = structure.core.shape[-1]
    problem = _Problem(batch=batch, times=times, dim=dim, inner_steps=inner_steps, start=carry.time)
    problem.threads, problem.parallel = torch.get_num_threads(), _parallel()
    held: list[object] = [states, structure.core, values]  # what the problem points to
    core = structure.core.expand(batch, times, count, count)
    problem.core = core.data_ptr()
    problem.core_row, problem.core_time, problem.core_i, problem.core_j = core.stride()
    problem.states = _array(states)
    has_gain = _structure(problem, structure, (batch, times, count), held)
    if isinstance(values, Tensor):
        problem.values = _array(values)
    else:
        evaluate = evaluator(values, states.dtype, dim)
        parameters = torch.tensor(values.parameters, dtype=states.dtype)
        held += [evaluate, parameters]
        problem.evaluate = ctypes.cast(evaluate, ctypes.c_void_p).value  # type: ignore[arg-type]
        problem.parameters = parameters.data_ptr()
    most = states.new_zeros(1) if most is None else most
    problem.most = most.data_ptr()
    # In and out, so copies: a result of the piece before may share them.
    weights, last_gain, diverged_at = map(_copy, (carry.weights.mT, carry.log_gain, carry.diverged_at))
    problem.weights, problem.diverged_at = weights.data_ptr(), diverged_at.data_ptr()
    problem.last_gain = last_gain.data_ptr() if has_gain else None
    after = history.after if history.recorded is None else history.recorded
    problem.before, problem.after = _pointer(history.before), _pointer(after)
    problem.papers = history.recorded is not None
    if after is not None:
        problem.history_time, problem.history_entry = after.stride()[:2]
    solve = built(states.dtype, count, shared=structure.core.dim() == 2)
    assert solve is not None
    solve(ctypes.byref(problem))
    return carry._replace(
        weights=weights.mT, log_gain=last_gain, time=carry.time + times, diverged_at=diverged_at
    )


def _structure(
    problem: _Problem,
    structure: GramStructure | NativeStructure,
    shape: tuple[int, int, int],
    held: list[object],
) -> bool:
    """Enter what is beside K0; whether the weights have a unit."""
    if isinstance(structure, NativeStructure):
        offsets = structure.offsets.contiguous()
        held.append(offsets)
        problem.offsets, problem.exponential = offsets.data_ptr(), structure.exponential
        return structure.exponential
    log_scale, log_gain = structure.log_scale, structure.log_gain
    problem.log_scale = _array(None if log_scale is None else log_scale.expand(shape))
    problem.log_gain = _array(None if log_gain is None else log_gain.expand(shape[:2]).unsqueeze(-1))
    return log_gain is not None


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
