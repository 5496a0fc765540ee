"""The filter of many streams in one call of compiled code, and of one stream in a microsecond."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..lanes.calls.choice import runs_kernels, worth
from ..lanes.compilation.compiler import compiled
from .filter_program import KernelFilter
from .kalman_filter import LocalFilter
from .local_functions import LocalFunctions, OwnFunctions
from .samples import in_place
from .stream_state import LANES, StreamState, blocks_of

NATIVE = Path(__file__).with_name("native")
"""The folder of the C++ of this room."""

_SHORT = 10_000  # streams times the square of centers: a call of some 20 us at most
_REALS = {torch.float32: "float", torch.float64: "double"}
_MOST = 66  # centers: beyond, unrolled loops and a stack frame of M^2 vectors no longer pay


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
