"""The bank of forecasters, and the regressor for streams around it with the conventions of scikit-learn."""

from __future__ import annotations

import ctypes
import functools
import logging
import math
import struct
from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor

from ...centers import simplex
from ...kernels import GaussianKernel
from ...lanes.compilation.compiler import compiled
from ...numerics.checks import flag, integer, positive_real, trailing
from ..compiled_filter import NATIVE, functions_in_c
from ..estimator import StreamEstimator
from ..filter_streams import Streams, refuse_other, table_of
from ..local_functions import LocalFunctions
from ..samples import pair
from .definition import BankDefinition
from .rules import (
    CARRIED_RADIUS,
    CARRIED_WIDTH,
    RECENT,
    SEARCHED,
    TRACKED,
    BankShape,
    Rules,
    answer_layout,
    layout,
    refuse_unwritten,
    size,
)

_NUMBERS = len(Rules.of(1, True).numbers())


class RulesInC(ctypes.Structure):
    """`Rules` of _bank.hpp: numbers, then the local functions of the filters."""

    _fields_ = (
        ("numbers", ctypes.c_double * _NUMBERS),
        ("functions", ctypes.c_void_p * 4),
        ("rate_and_reach", ctypes.c_double * 2),
    )


class BankStreams(ctypes.Structure):
    """`Streams` of _bank.cpp."""

    _fields_ = (("count", ctypes.c_int64), ("table", ctypes.c_void_p), ("rules", ctypes.c_void_p))


_packed = struct.Struct("8q").pack  # `Call` of _bank.cpp: what belongs to a call alone


class Bank(Streams):
    """Bounded memory, local Gaussian processes on it, and carried models, for many streams.

    A stream keeps C samples: the latest `RECENT` and others spread in space. At x a linear model (recursive
    least squares) predicts, and 24 Gaussian processes on k samples correct what it leaves: the k nearest,
    without and with two rates of fading by age, and the k latest, each with three widths and two noises,
    amplitudes y'K^-1 y / k. Beside them stand filters (`LocalFilter`, M = n + 1), `QuadraticModels`,
    `TrackerModels`, that linear model and the last value. `mix` and `judge` say how they are mixed.

    An error of more than ``doubtful`` deviations, by default `Rules`', lets a sample wait for the next one.
    With ``compile`` compiled code runs where there is a compiler; else the definition.
    """

    moves = True

    def __init__(
        self,
        shape: BankShape,
        streams: int,
        scaling: bool,
        doubtful: float | None = None,
        *,
        compile: bool = True,
    ) -> None:
        assert shape.capacity >= RECENT  # a full store gives up a sample that is not recent
        self.shape, self.scaling, self.dtype = shape, scaling, torch.float64
        width = CARRIED_WIDTH * math.sqrt(shape.dim)
        functions = LocalFunctions.of(GaussianKernel(width), CARRIED_RADIUS * width * simplex(shape.dim))
        rules = Rules.of(shape.dim, scaling, doubtful)
        *self._held, rate, reach = functions_in_c(functions)
        self._rules = RulesInC(
            tuple(rules.numbers()), tuple(part.data_ptr() for part in self._held), (float(rate), float(reach))
        )
        self._run = _built(shape) if compile else None
        self.compiled = self._run is not None  # and not the definition
        self.definition = BankDefinition(shape, rules, functions)
        self.table = torch.zeros(0, size(layout(shape)), dtype=torch.float64, device="cpu")
        self.add(streams)

    def add(self, streams: int) -> None:
        """Begin further streams, behind the others."""
        old = len(self.table)
        self.replace(torch.cat((self.table, self.table.new_zeros(streams, self.table.shape[1]))))
        self.clear(torch.arange(old, old + streams, device="cpu"))

    def replace(self, table: Tensor) -> None:
        """Hold these streams, (S, size), instead."""
        self.table = table.contiguous()
        self._streams = BankStreams(len(table), self.table.data_ptr(), ctypes.addressof(self._rules))
        self._reference = ctypes.addressof(self._streams)
        self._forget_answers()

    def _forget_answers(self) -> None:
        self.answers = self.table.new_zeros(len(self.table), size(answer_layout(self.shape)))

    def clear(self, rows: Tensor) -> None:
        """Let the streams with these numbers begin anew."""
        part = self.table.new_zeros(len(rows), self.table.shape[1])  # what was counted included
        for stream in self.definition.each(part, self.answers[rows]):
            self.definition.clear(stream)
        self.table[rows] = part
        self._forget_answers()

    @property
    def count(self) -> int:
        """S."""
        return len(self.table)

    def keep(self, rows: Tensor) -> None:
        """Go on with the streams with these numbers alone."""
        self.replace(self.table[rows])

    def state_dict(self) -> dict[str, Tensor]:
        """A copy of all that learning changes."""
        return {"table": self.table.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take over what `state_dict` of as many streams has; refused where the table has another shape,
        dtype or device, or numbers that no bank has written: compiled code goes by them."""
        table = table_of(state)
        refuse_other({"table": table}, {"table": self.table}, self.table.shape[1], table.shape[1])
        refuse_unwritten(self.shape, table)
        self.replace(table.clone())

    @property
    def learned(self) -> Tensor:
        """Samples learned, (S,) int64."""
        return self.table[:, 4].long()

    @property
    def skipped(self) -> Tensor:
        """Samples skipped, (S,) int64."""
        return self.table[:, 3].long()

    def predict(self, x: Tensor, shape: tuple[int, ...] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the next y at x (S, n), contiguous float64: (S, K) or in ``shape``.

        Nothing of the streams changes. The answers are kept: who learns at this x need not ask again.
        """
        if not x.is_cpu:
            _say_moved()
            mean, deviation = self.predict(x.cpu(), shape)
            return mean.to(x.device), deviation.to(x.device)
        shape = (len(self.table), self.shape.outputs) if shape is None else shape
        mean, deviation, answers = x.new_empty(shape), x.new_empty(shape), torch.empty_like(self.answers)
        if self._run is None:
            for i, stream in enumerate(self.definition.each(self.table, answers.zero_())):
                found = self.definition.predict(stream, x.view(len(self.table), -1)[i])
                mean.view(len(self.table), -1)[i], deviation.view(len(self.table), -1)[i] = found
        else:
            places = x.data_ptr(), 0, 0, mean.data_ptr(), deviation.data_ptr(), answers.data_ptr()
            self._run(_packed(self._reference, 1, *places))
        self.answers = answers
        return mean, deviation

    def learn(self, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        """Learn one sample a stream: (S, n), (S, K), contiguous float64; time since the last sample, (S,)."""
        if not x.is_cpu:
            _say_moved()
            x, y, lapse = x.cpu(), y.cpu(), None if lapse is None else lapse.cpu()
        if self._run is None:
            lapses = [1.0] * len(x) if lapse is None else lapse.tolist()
            streams = self.definition.each(self.table, self.answers)
            for s, *sample in zip(streams, x, y, lapses, strict=True):
                self.definition.learn(s, *sample)
            return
        time = 0 if lapse is None else lapse.data_ptr()
        places = x.data_ptr(), y.data_ptr(), time, 0, 0, self.answers.data_ptr()
        self._run(_packed(self._reference, 2, *places))


_log = logging.getLogger(__name__)


@functools.cache
def _say_moved() -> None:
    _log.warning("MixtureRegressor learns on the CPU: samples on a device are moved there, answers back")


@functools.cache
def _built(shape: BankShape) -> Callable[..., None] | None:
    sizes = f"DIM={shape.dim}", f"COUNT={shape.dim + 1}", f"OUTPUTS={shape.outputs}"
    kept = f"CAPACITY={shape.capacity}", f"NEIGHBOURS={shape.neighbours}"
    trackers = f"TRACKED={TRACKED}", f"SEARCHED={SEARCHED}"
    return compiled(NATIVE / "_bank.cpp", *sizes, *kept, *trackers)


_NAME = "MixtureRegressor"


class MixtureRegressor(StreamEstimator):
    """Online regression by mixing forecasters on remembered samples: accurate, with nothing to tune.

    A stream keeps some samples; where the state comes back, local Gaussian processes take their centers from
    them. These, State Following filters, quadratic models, processes on the whole past, a linear model and
    the last value are mixed by how well they predict (`Bank`). About a tenth of a millisecond a sample;
    thousands of fast streams are the `StaFRegressor`'s.

    No stream influences another. A coordinate of x that is NaN was not measured and is held; a target that is
    NaN is not learned. Any finite number is survived: a stream that jumps starts afresh there.

    Example:
        >>> model = MixtureRegressor(memory=200, neighbours=8)
        >>> x = torch.linspace(0.0, 3.0, 30, dtype=torch.float64).sin()
        >>> model.fit(x[:-1, None], x[1:]).predict(x[-1:]).shape
        torch.Size([])

        Shown by `staf_torch/online/mixture/README.md`.

    Args:
        memory: samples kept of a stream, at least 128.
        neighbours: of them that make a local process, at least 8.
        robust: standard deviations beyond which a sample waits for the next: both are learned if that is as
            far off, else the first is skipped; None takes 30, or 8 for an error of over 12 spreads of y.
        scaling: whether x and y are brought to mean 0 and variance 1, learned from the first 40 samples, and
            again from 80, 160 and 320.

    Attributes:
        n_features_in_: n, from the first sample on.
        n_streams_: S, or None for a single stream without batch dimension.
        n_outputs_: K, or None for y without a dimension of its own.
        n_samples_seen_: samples that each stream has learned from, () or (S,).
        n_skipped_: samples that were not learned, () or (S,). One that waits for the next is in neither.
    """

    def __init__(
        self, memory: int = 1000, neighbours: int = 56, *, robust: float | None = None, scaling: bool = True
    ) -> None:
        super().__init__()
        self.memory = memory
        self.neighbours = neighbours
        self.robust = robust
        self.scaling = scaling

    def tune(self, x: Any, y: Any) -> Self:
        """Check the shapes and change nothing: a mixture has nothing to tune, and what was learned stays.

        Args:
            x: (T, n), one stream in time, or (T, S, n), S streams.
            y: x's shape without n, or with K in place of n for K outputs.
        """
        pair(self._call("tune"), x, y, (2, 3))
        return self

    def _begin(self, streams: int, outputs: int, like: Tensor) -> Bank:
        trailing(_NAME, "x", like, 1, meta=False)
        memory = integer(_NAME, "memory", self.memory, least=2 * RECENT)
        neighbours = integer(_NAME, "neighbours", self.neighbours, least=8)
        robust = None if self.robust is None else positive_real(_NAME, "robust", self.robust)
        shape = BankShape(len(like), outputs, memory, min(neighbours, memory))
        return Bank(shape, streams, flag(_NAME, "scaling", self.scaling), robust)

    def _decisive(self) -> tuple[str, ...]:
        return ("memory", "neighbours", "robust", "scaling")
