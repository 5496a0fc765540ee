"""The recursion of `recursion.py` for the paper's law on the CPU, compiled: one call a chunk of time.

It computes g <- g - 2 lambda K g in place of a new residual an iteration, one product with K in place of two,
all of it in registers with trajectories as lanes. What the weights do not touch, e^{s(x, d)}, g(x) and V at
the centers, it evaluates a cacheful at a time from the states where it can, and else reads from tensors.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from ..approximation.basis import GramStructure, StaFBasis, Target
from ..centers import ConstantRadius
from ..kernels import ExponentialKernel
from ..lanes.build import compiled
from ..lanes.openmp import openmp
from ..optim import SteepestDescent
from ..targets import Formula
from .problem import Problem
from .recursion import Carry

_FOLDER = Path(__file__).parent
_LIBRARY = __name__.partition(".")[0]
_REALS = {torch.float32: "float", torch.float64: "double"}


class SharedStructure(NamedTuple):
    """K(c(x)) = e^{g(x)} S K0 S with one K0 and offsets d for all states, evaluated by the compiled code."""

    core: Tensor  # K0, (M, M)
    offsets: Tensor  # d, (M, n)
    exponential: bool  # S = diag(e^{x'd}) and g(x) = x'x; otherwise S = I and g = 0


class CompiledInputs(NamedTuple):
    """What the compiled recursion reads beside the states x (B, C, n), or evaluates from them."""

    structure: GramStructure | SharedStructure  # tensors (B, C, ...), or what serves all states
    values: Tensor | Formula  # V(c(x_k)), (B, C, M); a formula of V only with a `SharedStructure`


class EvaluatedInside(NamedTuple):
    """What the compiled recursion evaluates by itself from the states; None: what it reads from tensors."""

    structure: SharedStructure | None = None
    formula: Formula | None = None  # only beside a structure


class History(NamedTuple):
    """Where the weights of a chunk are written, if at all: (C, M, B), contiguous in B, equally strided."""

    before: Tensor | None = None
    after: Tensor | None = None
    recorded: Tensor | None = None  # the paper's w in place of its units of e^{-g}; excludes the others


def runs(problem: Problem, states: Tensor, inputs: CompiledInputs, carry: Carry) -> bool:
    """Return whether `advance` may be called: all that the native code takes for granted is checked here.

    The paper's law; plain strided CPU tensors of one dtype, without gradient, tangent or transform; shapes; a
    build for them. Everything else, and so whatever a user's target returns, is left to `recursion`.
    """
    structure, values = inputs
    (batch, times, dim), count = states.shape, problem.basis.count
    shared = isinstance(structure, SharedStructure)
    exact: list[tuple[Tensor, tuple[int, ...]]] = [
        (states, (batch, times, dim)),
        (carry.weights, (batch, count)),
        (carry.log_gain, (batch,)),
    ]
    broadcast: list[tuple[Tensor, tuple[int, ...]]] = [
        (structure.core, (count, count) if shared else (batch, times, count, count))
    ]
    if isinstance(structure, SharedStructure):
        exact.append((structure.offsets, (count, dim)))
    else:
        scale, gain = structure.log_scale, structure.log_gain
        broadcast += [] if scale is None else [(scale, (batch, times, count))]
        broadcast += [] if gain is None else [(gain, (batch, times))]
    if isinstance(values, Tensor):
        exact.append((values, (batch, times, count)))
    return (
        type(problem.law) is SteepestDescent
        and problem.inner_steps > 0
        and not torch.compiler.is_compiling()
        and states.dtype in _REALS
        and all(_plain(tensor, states.dtype) and tensor.shape == shape for tensor, shape in exact)
        and all(_plain(tensor, states.dtype) and _expands(tensor, shape) for tensor, shape in broadcast)
        and (shared or isinstance(values, Tensor))
        and library(states.dtype, count, shared=structure.core.dim() == 2) is not None
        and (isinstance(values, Tensor) or evaluator(values, states.dtype, dim) is not None)
    )


def _plain(tensor: Tensor, dtype: torch.dtype) -> bool:
    """Return whether native code may read the memory of a tensor."""
    return (
        type(tensor) is Tensor
        and tensor.device.type == "cpu"
        and tensor.layout is torch.strided
        and tensor.dtype is dtype
        and not tensor.is_neg()  # memory holds the negative
        and _without_derivative(tensor)
    )


def _without_derivative(tensor: Tensor) -> bool:
    return (
        not (tensor.requires_grad and torch.is_grad_enabled())
        and not torch._C._functorch.is_functorch_wrapped_tensor(tensor)  # vmap, jvp, ...
        and forward_ad.unpack_dual(tensor).tangent is None
    )


def _expands(tensor: Tensor, shape: tuple[int, ...]) -> bool:
    given = tensor.shape
    return len(given) <= len(shape) and all(
        own in (1, want) for own, want in zip(reversed(given), reversed(shape), strict=False)
    )


def evaluated_inside(problem: Problem, states: Tensor, carry: Carry) -> EvaluatedInside:
    """Return what the compiled recursion evaluates by itself of these states (B, C, n), basis and target."""
    if type(problem.law) is not SteepestDescent or not _plain(states, states.dtype):
        return EvaluatedInside()
    structure = shared_structure(problem.basis, states)
    if structure is None:
        return EvaluatedInside()
    formula = formula_of(problem.target, problem.basis.dim)
    if formula is None or not runs(problem, states, CompiledInputs(structure, formula), carry):
        return EvaluatedInside(structure)
    return EvaluatedInside(structure, formula)


def shared_structure(basis: StaFBasis, states: Tensor) -> SharedStructure | None:
    """Return the Gram structure of all states (B, C, n); None where it needs tensors.

    Those are centers at a moving radius, hyperparameters with a value a row, and kernels of a user's own.
    """
    kernel, centers = basis.kernel, basis.centers
    radius = centers.radius
    own = all(type(part).__module__.partition(".")[0] == _LIBRARY for part in (basis, kernel, centers))
    if not own or not kernel.state_free or type(radius) is not ConstantRadius or radius.radius.dim() > 0:
        return None
    at = states[0, 0]
    d = centers.offsets(at)
    if type(kernel) is ExponentialKernel:
        return SharedStructure(kernel.core(at, d, d), d, True)
    if kernel.log_gain(at) is not None:
        return None
    core, log_scale = kernel.core(at, d, d), kernel.log_scale(at, d)  # of d alone: see `Kernel.state_free`
    if core.dim() != 2:
        return None
    if log_scale is not None:
        scale = log_scale.exp()
        core = scale.unsqueeze(-1) * core * scale
    return SharedStructure(core, d, False)


def formula_of(target: Target, dim: int) -> Formula | None:
    """Return the formula of a target that gives one for what it computes, else None.

    A formula that was inherited says nothing of a `forward` that was not, nor of hooks, and carries no
    gradient to the numbers of a target that is learned.
    """
    kind = type(target)
    if not isinstance(target, nn.Module) or not hasattr(kind, "formula") or "forward" in vars(target):
        return None
    if _definer(kind, "formula") is not _definer(kind, "forward"):
        return None
    if target._forward_hooks or target._forward_pre_hooks:
        return None
    if not all(_without_derivative(tensor) for tensor in _tensors(target)):
        return None
    formula: Formula = target.formula(dim)  # type: ignore[operator]
    return formula


def _tensors(target: nn.Module) -> Iterator[Tensor]:
    """Yield what a target is made of, tensors that it never registered included."""
    for module in target.modules():
        yield from module.parameters(recurse=False)
        yield from module.buffers(recurse=False)
        yield from (value for value in vars(module).values() if isinstance(value, Tensor))


def _definer(kind: type, name: str) -> type:
    return next(each for each in kind.__mro__ if name in vars(each))


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


def library(dtype: torch.dtype, count: int, *, shared: bool) -> Callable[..., None] | None:
    """Return the compiled recursion for this many centers, None where there is none.

    Args:
        dtype: of all tensors.
        count: M.
        shared: whether one K0 serves all states.
    """
    real, one = _REALS[dtype], str(shared).lower()
    return compiled(_FOLDER / "_recursion.cpp", f"REAL={real}", f"COUNT={count}", f"SHARED={one}")


def evaluator(formula: Formula, dtype: torch.dtype, dim: int) -> Callable[..., None] | None:
    """Return the compiled formula of a target, None where it cannot be built."""
    return compiled(
        _FOLDER / "_target.cpp", f"REAL={_REALS[dtype]}", f"DIM={dim}", f"FORMULA={formula.expression}"
    )


def advance(
    inner_steps: int,
    states: Tensor,
    inputs: CompiledInputs,
    carry: Carry,
    history: History,
    largest_gain: Tensor | None = None,
) -> Carry:
    """Correct the weights at every time of a chunk, and write what ``history`` asks for; `runs` says when.

    Args:
        inner_steps: iterations a time.
        states: x, (B, C, n).
        inputs: of these times.
        carry: from the chunk before, left as it is.
        history: written.
        largest_gain: (1,), written where g(x) is evaluated here: the largest that is finite.
    """
    structure, values = inputs
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
    most = states.new_zeros(1) if largest_gain is None else largest_gain
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
    solve = library(states.dtype, count, shared=structure.core.dim() == 2)
    assert solve is not None
    solve(ctypes.byref(problem))
    return carry._replace(
        weights=weights.mT, log_gain=last_gain, time=carry.time + times, diverged_at=diverged_at
    )


def _structure(
    problem: _Problem,
    structure: GramStructure | SharedStructure,
    shape: tuple[int, int, int],
    held: list[object],
) -> bool:
    """Enter what stands beside K0, and return whether the weights have a unit."""
    if isinstance(structure, SharedStructure):
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
    """Return the OpenMP entry that torch itself runs on: a second pool of threads on the same cores makes
    both several times slower. Without it the library starts threads of its own."""
    entry = openmp("GOMP_parallel")
    return None if entry is None else ctypes.cast(entry, ctypes.c_void_p).value  # type: ignore[arg-type]
