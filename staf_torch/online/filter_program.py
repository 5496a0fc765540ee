"""The filter of streams as a row program, a stream a row: what runs on a device, and has gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes import Program, Shared, shared_program
from ..lanes.trace.step import Step
from ..lanes.tree import Tree
from .kalman_filter import LocalFilter
from .local_functions import LocalFunctions, OwnFunctions
from .stream_state import Counts, StateParts, StreamState

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
