"""The filter of many streams as a row program, of devices and with gradients, and as one call of C++."""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..lanes import Program, Shared, shared_program
from ..lanes.calls.choice import runs_kernels, worth
from ..lanes.compilation.compiler import compiled
from ..lanes.trace.step import Step
from ..lanes.tree import Tree
from .kalman_filter import LocalFilter
from .local_functions import LocalFunctions, OwnFunctions
from .samples import in_place
from .stream_state import LANES, Counts, StateParts, StreamState, blocks_of

NATIVE = Path(__file__).with_name("native")
"""The folder of the C++ of this room."""

_SHORT = 10_000  # streams times the square of centers: a call of some 20 us at most
_REALS = {torch.float32: "float", torch.float64: "double"}
_MOST = 66  # centers: beyond, unrolled loops and a stack frame of M^2 vectors no longer pay
_DIMS = 3, 1, 3, 3  # of the tensors of `OwnFunctions`, streams among them


def law_of(filter_: LocalFilter) -> tuple[Tensor | float, ...]:
    """Return the numbers of a filter beside its functions, in the order of the program."""
    return filter_.ratio, filter_.forgetting, filter_.slack, filter_.robust, filter_.base


def step(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
    """Expect a sample, and learn it: streams are the first dimension, but of what all have alike."""
    functions, law = row
    return after(_functions(functions), carry, now, law)


def after(functions: LocalFunctions | OwnFunctions, carry: Tree, now: Tree, law: Tree) -> tuple[Tree, Tree]:
    """Return the state after a sample x (S, n), y (S, K), lapse (S,) of every stream, and mean and deviation
    (S, K) expected before.

    The carry is the table (S, rows) in the dtype of the streams, in three parts of which the second is D's
    lower triangle, and counts (S, 4); the law is that of `law_of`.
    """
    (*parts, counts), (x, y, lapse) = carry, now
    filter_, real, old = LocalFilter(functions, *law), parts[0].dtype, _state(parts)
    # what counts values has no derivative
    still = {name: getattr(old, name).detach() for name in ("surprises", "told", "leaps")}
    old, x, y = old._replace(**still), x.mT, y.mT
    expected = filter_.expected(old, x, filter_.forgetting**lapse)
    new, seen = filter_.learned(old, Counts(*counts.unbind(1)), x, y, lapse, torch.finfo(real))
    count = old.mean.shape[1]
    lower = [count * i + j for i, j in _entries(count) if j <= i]
    head = torch.cat((new.anchor, new.last, new.mean.flatten(0, 1)))
    found = head, new.learned.flatten(0, 1)[lower], torch.cat(new[4:])
    kept = tuple(part.mT.to(real) for part in found)
    return (*kept, torch.stack(seen, 1)), tuple(part.mT for part in expected)


def _learning(*alike: Tensor) -> Step:
    """Learn a sample; with the functions that all streams have alike, or none."""

    def learned(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        functions, law = row
        return after(_functions(functions or alike), carry, now, law)[0], ()

    return learned


def _expecting(*alike: Tensor) -> Step:
    """Expect a sample, as `_learning`."""

    def expected(_: Tree, __: Tree, row: Tree) -> tuple[Tree, Tree]:
        functions, law, parts, x = row
        filter_ = LocalFilter(_functions(functions or alike), *law)
        mean, deviation = filter_.expected(_state(parts), x.mT, filter_.forgetting)
        return (), (mean.mT.to(x.dtype), deviation.mT.to(x.dtype))

    return expected


def _functions(functions: Tree) -> OwnFunctions:
    """With streams last; those of all streams alike have one."""
    own = zip(functions, _DIMS, strict=True)
    return OwnFunctions(*(part.movedim(0, -1) if part.dim() == d else part.unsqueeze(-1) for part, d in own))


def _state(parts: Sequence[Tensor]) -> StateParts:
    """The state in float64, D whole: streams are the last dimension."""
    head, lower, tail = (part.double().mT for part in parts)
    outputs, count = len(tail) // 7, math.isqrt(2 * len(lower))
    mean = head[-(outputs + 1) * count :].unflatten(0, (-1, count))
    anchor, last = head[: -(outputs + 1) * count].unflatten(0, (2, -1)).unbind()
    places = [max(i, j) * (max(i, j) + 1) // 2 + min(i, j) for i, j in _entries(count)]
    learned = lower[places].unflatten(0, (count, count))
    return StateParts(anchor, last, mean, learned, *tail.split([*[outputs] * 7, 1, 1]))


def _entries(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(count)]


FORECAST = Program(step, name="StaFRegressor over a stretch")
"""Expects every sample, and learns it."""


def carry_of(state: StreamState) -> tuple[Tensor, ...]:
    """The carry of a program that goes on from a state: views of a device's table."""
    _, _, mean, lower, *tail = state.heights
    parts = state.table.split((2 * state.dim + mean, lower, sum(tail)))
    return *(part.mT for part in parts), state.counts.mT


class KernelFilter:
    """`LocalFilter.predict` and `learn` as kernels of a device, a stream a thread; of a kernel with a
    constant diagonal and exponent rate."""

    def __init__(self, definition: LocalFilter, state: StreamState) -> None:
        functions, where = definition.functions, state.blocks.device

        def placed(value: Tensor | float) -> Tensor | Shared:
            tensor = torch.as_tensor(value, dtype=torch.float64, device=where)
            return tensor.expand(state.streams) if tensor.dim() else Shared(tensor)

        alike: tuple[Tensor, ...] = ()  # numbers of the programs' tables
        self._functions: tuple[Tensor, ...] = ()  # columns
        if isinstance(functions, OwnFunctions):
            self._functions = tuple(part.movedim(-1, 0).to(where) for part in functions)
        else:
            assert functions.rate is not None
            told = OwnFunctions.of(functions.rate.double().reshape(1), functions.offsets.unsqueeze(0))
            alike = tuple(part[..., 0].to(where) for part in told)
        self._learn = shared_program("StaFRegressor.fit", _learning(*alike), *alike)
        self._expect = shared_program("StaFRegressor.predict", _expecting(*alike), *alike)
        self._law = tuple(map(placed, law_of(definition)))
        self._lapse = torch.ones(state.streams, dtype=torch.float64, device=where)

    def predict(self, state: StreamState, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the next y at x (S, n), of the table's dtype: (S, K)."""
        row = self._functions, self._law, carry_of(state)[:3], x
        mean, deviation = self._expect((), (), row, steps=1)[1]
        return mean[:, 0], deviation[:, 0]

    def learn(self, state: StreamState, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        """Learn one sample a stream: (S, n), (S, K), in the table's dtype; (S,) float64."""
        time = self._lapse if lapse is None else lapse
        self.stretch(state, x.unsqueeze(0), y.unsqueeze(0), time.unsqueeze(0))

    def stretch(self, state: StreamState, x: Tensor, y: Tensor, lapse: Tensor) -> None:
        """Learn the samples of a stretch in one call: (T, S, n), (T, S, K), (T, S)."""
        now = tuple(part.transpose(0, 1) for part in (x, y, lapse))
        (*parts, counts), _ = self._learn(carry_of(state), now, (self._functions, self._law))
        state.put(*(part.mT for part in parts))
        state.counts.copy_(counts.mT)


class Forecast(NamedTuple):
    """Expected value of every sample before it was learned, and its likelihood then."""

    mean: Tensor  # in the shape of y
    deviation: Tensor  # standard deviation, noise included; as the mean
    log_density: Tensor  # of y, all outputs, (T,) or (T, S); 0 where none was measured


def log_density(y: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """log N(y; mean, deviation), entry by entry; 0 where y was not measured."""
    seen = torch.isfinite(y)
    z = (torch.where(seen, y, mean) - mean) / deviation
    found = -0.5 * z.square() - deviation.log() - 0.5 * math.log(2 * math.pi)
    return torch.where(seen, found, 0.0)


def forecasts(filter_: LocalFilter, x: Tensor, y: Tensor, lapse: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation (S, T, K) of every sample from those before it, of S streams that
    have learned nothing: x (S, T, n), float64, y (S, T, K), lapse (S, T).

    With `OwnFunctions` compiled, forwards and backwards; with others in plain torch.
    """
    rows, functions = len(x), filter_.functions
    numbers = tuple(torch.as_tensor(part, device=x.device).double().expand(rows) for part in law_of(filter_))
    if isinstance(functions, OwnFunctions):
        row = tuple(part.movedim(-1, 0).to(x.device) for part in functions), numbers
        mean, deviation = FORECAST(_fresh(x, y, functions.offsets.shape[0]), (x, y, lapse), row)[1]
        return mean, deviation

    def step(carry: Tree, now: Tree, row: Tree) -> tuple[Tree, Tree]:
        return after(functions, carry, now, row)

    program = Program(step, name=FORECAST.name, compile=False)
    mean, deviation = program(_fresh(x, y, len(functions.offsets)), (x, y, lapse), numbers)[1]
    return mean, deviation


def _fresh(x: Tensor, y: Tensor, count: int) -> Tree:
    """The carry of streams that have learned nothing."""
    (rows, _, n), k = x.shape, y.shape[-1]
    return carry_of(StreamState.empty(x.detach(), rows, n, count, k))


class StreamsInC(ctypes.Structure):
    """`Streams` of _filter.cpp."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("streams", "stride", "closed")),
        *((name, ctypes.c_void_p) for name in ("table", "counts", "ratio", "forgetting")),
        *((name, ctypes.c_void_p) for name in ("offsets", "squares", "newton", "gram", "rate", "reach")),
        *((name, ctypes.c_void_p) for name in ("slack2", "robust", "size")),
        *((name, ctypes.c_double) for name in ("tiny", "most")),
    )


def functions_in_c(functions: LocalFunctions | OwnFunctions) -> list[Tensor]:
    """Return `Functions` of _filter.hpp: d, |d|^2, C, K0, q and the largest |d|."""
    if isinstance(functions, OwnFunctions):
        squares = functions.offsets.square().sum(1)
        reach = squares.amax(0).clamp(min=1e-300).sqrt()
        return [functions.offsets, squares, functions.shared, functions.gram, functions.rate, reach]
    assert functions.shared is not None
    assert functions.rate is not None
    # C = P'L^-T is upper triangular in the order of the pivots, in which compiled code has the centers
    order = (functions.shared == 0).long().cumprod(1).sum(1).argsort()
    newton, offsets = functions.shared[order].contiguous(), functions.offsets.double()[order].contiguous()
    assert not newton.tril(-1).any()
    gram = functions.kernel.core(torch.zeros_like(offsets[0]), offsets, offsets).contiguous()
    squares = offsets.square().sum(-1)
    return [offsets, squares, newton, gram, functions.rate.double(), squares.amax().clamp(min=1e-300).sqrt()]


def _numbers_of(definition: LocalFilter) -> list[Tensor]:
    """Return numbers as _filter.cpp reads them: of all streams alike, or (blocks, numbers, `LANES`)."""
    slack, *law = (
        torch.as_tensor(part, device="cpu").double()
        for part in (definition.slack, definition.robust, definition.base)
    )
    parts = [*functions_in_c(definition.functions), slack.square(), law[0], law[1].sqrt()]
    if not isinstance(definition.functions, OwnFunctions):
        return parts
    streams = len(definition.functions.rate)
    return [
        blocks_of((part if part.dim() else part.expand(streams)).reshape(-1, streams), padding=1.0)
        for part in parts
    ]


_packed = struct.Struct("7q").pack  # `Given` of _filter.cpp: what belongs to a call alone


class CompiledFilter:
    """`LocalFilter.predict` and `learn` of one `StreamState`, whose tensors must not be replaced
    meanwhile, a stream in every vector lane; of a kernel with a constant diagonal and exponent rate, on
    the processor."""

    def __init__(self, definition: LocalFilter, state: StreamState, call: Callable[..., None]) -> None:
        ratio, forgetting = definition.ratio.contiguous(), definition.forgetting.contiguous()
        self._held = [state.blocks, state.counts, ratio, forgetting, *_numbers_of(definition)]
        streams, real = state.streams, torch.finfo(state.dtype)
        places = (each.data_ptr() for each in self._held)
        self._streams = StreamsInC(streams, streams, 0, *places, real.eps**0.5, real.max)
        self._run, self.reference = call, ctypes.addressof(self._streams)
        # the same function, called without giving Python's lock away
        address = ctypes.cast(call, ctypes.c_void_p).value  # type: ignore[arg-type]
        self.holding = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_char_p)(address or 0)
        self._shape = (streams, state.outputs)
        self.short = streams * state.count**2 <= _SHORT

    @classmethod
    def build(
        cls, definition: LocalFilter, state: StreamState
    ) -> CompiledFilter | KernelFilter | LocalFilter:
        """The compiled filter, kernels of a device, or the definition where there is neither."""
        functions, real = definition.functions, _REALS.get(state.dtype)
        own = isinstance(functions, OwnFunctions)
        plain = isinstance(functions, OwnFunctions) or (
            functions.rate is not None and functions.shared is not None and functions.stationary
        )
        if not plain or real is None or state.count > _MOST:
            return definition
        if runs_kernels(state.blocks) and worth(True, state.blocks):
            return KernelFilter(definition, state)
        if not state.blocks.is_cpu:
            return definition
        sizes = f"DIM={state.dim}", f"COUNT={state.count}", f"OUTPUTS={state.outputs}", f"LANES={LANES}"
        call = compiled(NATIVE / "_filter.cpp", *sizes, f"REAL={real}", *(["OWN=1"] if own else []))
        return definition if call is None else cls(definition, state, call)

    def close(self, closed: bool) -> None:
        """Let direct calls do nothing while the streams are changed, or go on with them."""
        self._streams.closed = closed

    def predict(
        self, state: StreamState, x: Tensor, shape: tuple[int, ...] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the next y at x (S, n), contiguous, of the table's dtype: (S, K)."""
        shape = self._shape if shape is None else shape
        mean, deviation = x.new_empty(shape), x.new_empty(shape)
        places = x.data_ptr(), 0, 0, mean.data_ptr(), deviation.data_ptr()
        self._run(_packed(self.reference, 1, *places))
        return mean, deviation

    def learn(self, state: StreamState, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        """Learn one sample a stream: (S, n), (S, K), contiguous and in the table's dtype; (S,) float64."""
        time = 0 if lapse is None else lapse.data_ptr()
        self._run(_packed(self.reference, 2, x.data_ptr(), y.data_ptr(), time, 0, 0))


class DirectCalls:
    """Calls of a compiled filter on a few streams, `short`, that need no lock: they hold Python's own.
    Samples of this dtype and these shapes are read where they lie.

    What a call must fit and where the streams lie is one object, so that both are always of the same
    streams.
    """

    def __init__(
        self, filter_: CompiledFilter, dtype: torch.dtype, shape: tuple[int, ...], targets: tuple[int, ...]
    ) -> None:
        self.filter, self._dtype, self._shape, self._targets = filter_, dtype, shape, targets
        self._run, self._reference = filter_.holding, filter_.reference
        self._like = torch.empty(targets, dtype=dtype, device="cpu")  # whose form results have, quicker so

    def learn(self, x: Any, y: Any) -> bool:
        """Learn one sample a stream; False where it does not fit, or the streams are just changed."""
        try:
            return (
                in_place(x, self._dtype, self._shape)
                and in_place(y, self._dtype, self._targets)
                and self._run(_packed(self._reference, 6, x.data_ptr(), y.data_ptr(), 0, 0, 0)) == 1
            )
        except RuntimeError:  # under a transform of torch.func there is no address
            return False

    def predict(self, x: Any) -> tuple[Tensor, Tensor] | None:
        """Mean and standard deviation of the next y; None where `learn` returns False."""
        if not in_place(x, self._dtype, self._shape):
            return None
        mean, deviation = torch.empty_like(self._like), torch.empty_like(self._like)
        try:
            places = x.data_ptr(), 0, 0, mean.data_ptr(), deviation.data_ptr()
        except RuntimeError:  # under a transform of torch.func there is none
            return None
        return (mean, deviation) if self._run(_packed(self._reference, 5, *places)) == 1 else None
