"""The streams of a filter: their states, their units, and how they come and go."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .compiled_filter import CompiledFilter
from .kalman_filter import STREAK, LocalFilter, StreamState

LEARNED_AT = (2, 5, 10, 20, 40)  # samples after which the units are learned
OUTLYING = 30.0  # median deviations beyond which a value has no say in them
FAR = 1e3  # spreads from the center where units say nothing: a stream that stays there learns new ones


class FilterStreams:
    """S streams that a `LocalFilter` filters, in their own units where these are learned.

    Args:
        definition: the filter; its ratio and forgetting have an entry a stream, or one for all.
        state: of the streams.
        scaling: whether the units of x and y are learned from the first samples of each stream.
        units: centers and spreads (S, 2 (n + K)) that are known instead, NaN where they are not.
        stretch: by which learned spreads are multiplied, (S, n + K), ones by default.
    """

    def __init__(
        self,
        definition: LocalFilter,
        state: StreamState,
        scaling: bool,
        units: Tensor | None = None,
        stretch: Tensor | None = None,
    ) -> None:
        self.scaling = scaling
        self.dtype = state.dtype
        size, wide = state.streams, state.dim + state.outputs
        like = state.blocks.new_zeros(0, dtype=torch.float64)
        self.units = like.new_zeros(size, 2 * wide)  # centers, spreads
        self._stretch = self.units.new_ones(size, wide) if stretch is None else stretch.double()
        self._known = torch.full_like(self.units, torch.nan) if units is None else units.double()
        self.first = like.new_zeros(size, LEARNED_AT[-1] if scaling else 0, wide + 1)  # samples and lapses
        self.clock = torch.zeros(
            size, dtype=torch.int64
        )  # of first samples; behind them, of far ones in a row
        self._begin(torch.arange(size))
        self._hold(definition, state)

    def _begin(self, rows: Tensor) -> None:
        """Streams with these numbers know no units but those that they were given."""
        wide, known = self.units.shape[1] // 2, self._known[rows]
        given = known.isfinite().all(1)
        unit = torch.arange(2 * wide) >= wide
        self.units[rows] = torch.where(given[:, None], known, unit.double())
        self.clock[rows] = torch.where(given, LEARNED_AT[-1], 0)
        self.first[rows] = 0.0

    def _hold(self, definition: LocalFilter, state: StreamState) -> None:
        """Filter these streams from now on."""
        self.definition, self.state = definition, state
        self.count = state.streams
        self._filter = CompiledFilter.build(definition, state)
        self.compiled = isinstance(self._filter, CompiledFilter) and not self.scaling
        self._center, self._spread = self.units.to(self.dtype).split(state.dim + state.outputs, dim=1)

    @property
    def learned(self) -> Tensor:
        """Samples learned, (S,) int64."""
        return self.state.counts[0]

    @property
    def skipped(self) -> Tensor:
        """Samples skipped, (S,) int64."""
        return self.state.counts[1]

    def predict(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the next y at x (S, n): (S, K), (S, K)."""
        if not self.scaling:
            return self._filter.predict(self.state, x)
        n = self.state.dim
        mean, deviation = self._filter.predict(self.state, (x - self._center[:, :n]) / self._spread[:, :n])
        return mean * self._spread[:, n:] + self._center[:, n:], deviation * self._spread[:, n:]

    def learn(self, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        """Learn one sample a stream: (S, n), (S, K), (S,)."""
        if not self.scaling:
            self._filter.learn(self.state, x, y, lapse)
            return
        n = self.state.dim
        self._leave(x, y)
        young = self.clock < LEARNED_AT[-1]
        complete = torch.isfinite(x).all(1) & torch.isfinite(y).all(1) & young
        due = torch.zeros_like(complete)
        if bool(young.any()):
            rows = young.nonzero().squeeze(1)
            lapses = torch.ones_like(rows, dtype=torch.float64) if lapse is None else lapse[rows]
            self.first[rows, self.clock[rows], -1] += lapses  # since the last complete one
            rows = complete.nonzero().squeeze(1)
            self.first[rows, self.clock[rows], :-1] = torch.cat((x, y), 1)[rows].double()
            self.clock[rows] += 1
            due = complete & torch.isin(self.clock, torch.tensor(LEARNED_AT))
        rest = torch.where(due.unsqueeze(1), torch.nan, (y - self._center[:, n:]) / self._spread[:, n:])
        self._filter.learn(self.state, (x - self._center[:, :n]) / self._spread[:, :n], rest, lapse)
        if bool(due.any()):
            self.state.counts[1] -= due.long()  # not skipped: it is learned with the others
            for row in due.nonzero().squeeze(1).tolist():
                self._rescale(row)

    def _leave(self, x: Tensor, y: Tensor) -> None:
        """Let streams learn new units that have been far from what these were learned from for long."""
        settled = (self.clock >= LEARNED_AT[-1]) & ~self._known.isfinite().all(1)
        if not bool(settled.any()):
            return
        center, spread = self.units.chunk(2, dim=1)
        both = torch.cat((x, y), 1).double()
        far = ((both - center).abs() > FAR * spread).any(1) & torch.isfinite(x).all(1)
        clock = torch.where(far, self.clock + 1, LEARNED_AT[-1])
        self.clock = torch.where(settled & ~both.isnan().any(1), clock, self.clock)
        gone = (self.clock >= LEARNED_AT[-1] + STREAK).nonzero().squeeze(1)
        if len(gone):
            counts = self.state.counts[:2, gone].clone()
            self.clear(gone)
            self.state.counts[:2, gone] = counts

    def _rescale(self, row: int) -> None:
        """Take the units of a stream from its first samples, and learn these again."""
        wide, n = self.state.dim + self.state.outputs, self.state.dim
        samples = self.first[row, : self.clock[row]]
        center, spread = units_of(samples[:, :wide])
        spread = spread * self._stretch[row]
        self.units[row] = torch.cat((center, spread))
        self._center, self._spread = self.units.to(self.dtype).split(wide, dim=1)
        u = ((samples[:, :wide] - center) / spread).to(self.dtype)
        alone = StreamState.empty(self.state.blocks, 1, n, self.state.count, self.state.outputs)
        law = self.definition.with_law(
            self.definition.ratio[row, None], self.definition.forgetting[row, None]
        )
        filter_ = CompiledFilter.build(law, alone)
        for k in range(len(u)):
            filter_.learn(
                alone, u[k : k + 1, :n].contiguous(), u[k : k + 1, n:].contiguous(), samples[k, -1:].clone()
            )
        counts = self.state.counts[:2, row].clone()
        table = self.state.table
        table[:, row] = alone.table[:, 0]
        self.state.put(table)
        self.state.counts[:, row] = alone.counts[:, 0]
        self.state.counts[0, row] = torch.maximum(counts[0] + 1, alone.counts[0, 0])
        self.state.counts[1, row] = counts[1]

    def units_for(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Centers and spreads (S, n + K) for a whole record (T, S, n + K): from all of it, or as known."""
        wide = self.units.shape[1] // 2
        if not self.scaling or bool((self.clock >= LEARNED_AT[-1]).all()):
            return self.units[:, :wide], self.units[:, wide:]
        found = [units_of(row[torch.isfinite(row).all(1)]) for row in samples.unbind(1)]
        spreads = torch.stack([pair[1] for pair in found]) * self._stretch
        return torch.stack([pair[0] for pair in found]), spreads

    def clear(self, rows: Tensor) -> None:
        """Let the streams with these numbers begin anew."""
        fresh = StreamState.empty(self.state.blocks, len(rows), *self.state.sizes)
        table = self.state.table
        table[:, rows], self.state.counts[:, rows] = fresh.table, fresh.counts
        self.state.put(table)
        self._begin(rows)
        self._center, self._spread = self.units.to(self.dtype).chunk(2, dim=1)

    def add(self, streams: int) -> None:
        """Begin further streams, behind the others."""
        fresh = StreamState.empty(self.state.blocks, streams, *self.state.sizes)
        table = torch.cat((self.state.table, fresh.table), 1)
        state = self.state.with_table(table, torch.cat((self.state.counts, fresh.counts), 1))
        new = self.units.new_full((streams, self.units.shape[1]), torch.nan)
        self.units, self._known = torch.cat((self.units, new)), torch.cat((self._known, new))
        self.first = torch.cat((self.first, self.first.new_zeros(streams, *self.first.shape[1:])))
        self.clock = torch.cat((self.clock, self.clock.new_zeros(streams)))
        self._stretch = torch.cat((self._stretch, _typical(self._stretch).expand(streams, -1)))
        self._begin(torch.arange(self.count, self.count + streams))
        old = self.definition
        ratio, forgetting = (torch.cat((a, _typical(a).expand(streams))) for a in (old.ratio, old.forgetting))
        self._hold(old.with_law(ratio, forgetting), state)

    def keep(self, rows: Tensor) -> None:
        """Go on with the streams with these numbers alone."""
        state = self.state.with_table(self.state.table[:, rows], self.state.counts[:, rows])
        self.units, self.first, self.clock = self.units[rows], self.first[rows], self.clock[rows]
        self._known, self._stretch = self._known[rows], self._stretch[rows]
        old = self.definition
        self._hold(old.with_law(old.ratio[rows], old.forgetting[rows]), state)

    def state_dict(self) -> dict[str, Any]:
        """Copies of all tensors that learning changes, and what the local functions are told by."""
        return {name: tensor.clone() for name, tensor in (self._learned() | self._fixed()).items()}

    def _fixed(self) -> dict[str, Tensor]:
        """What must not be another one: the centers, and the kernel at them."""
        functions = self.definition.functions
        zero, offsets = torch.zeros_like(functions.offsets[0]), functions.offsets
        return {"offsets": offsets, "gram": functions.kernel.core(zero, offsets, offsets).detach()}

    def _learned(self) -> dict[str, Tensor]:
        """All tensors that learning changes."""
        kept = {
            "table": self.state.table,
            "counts": self.state.counts,
            "units": self.units,
            "clock": self.clock,
        }
        law = {"first": self.first, "ratio": self.definition.ratio, "forgetting": self.definition.forgetting}
        return kept | law

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` of as many streams has.

        Raises:
            ValueError: if a tensor has another shape, dtype or device, since compiled code goes by these, or
                if kernel or centers are others.
        """
        if not isinstance(state.get("table"), Tensor):
            raise ValueError("`StaFRegressor.load_state_dict(state=...)` must have a tensor 'table'.")
        refuse_other(state, self._learned(), self.state.blocks.shape[1], state["table"].shape[0])
        for name, own in self._fixed().items():
            given = state.get(name, own)  # which older versions did not save
            like = given.shape == own.shape and given.dtype == own.dtype
            if not like or not torch.allclose(given, own, rtol=1e-9):
                told = "must have the kernel, radius and centers of this regressor"
                raise ValueError(f"`StaFRegressor.load_state_dict(state=...)` {told}; {name!r} differs.")
        kept = self.state.with_table(state["table"], state["counts"].clone())
        self.units, self.clock, self.first = (state[name].clone() for name in ("units", "clock", "first"))
        self._hold(self.definition.with_law(state["ratio"].clone(), state["forgetting"].clone()), kept)


def _typical(values: Tensor) -> Tensor:
    """The lower median of every column, which streams that are added begin with: (S, ...) -> (1, ...)."""
    return values.median(0).values[None]


def refuse_other(state: dict[str, Any], own: dict[str, Tensor], expected: int, given: int) -> None:
    """Raise where a saved state has other tensors than a new one.

    Args:
        state: that was saved.
        own: tensors of the new one, by name.
        expected: numbers a stream of the new one.
        given: numbers a stream of the saved table.
    """
    name = "`StaFRegressor.load_state_dict(state=...)`"
    if given != expected:
        told = f"must have {expected} numbers a stream, as this version and these arguments have; got {given}"
        raise ValueError(f"{name} {told}.")
    for key, tensor in own.items():
        found = state.get(key)
        if not isinstance(found, Tensor):
            raise ValueError(f"{name} must have a tensor {key!r}; got {found!r}.")
        if (found.shape, found.dtype, found.device) != (tensor.shape, tensor.dtype, tensor.device):
            told = f"must have {key!r} of shape {tuple(tensor.shape)}, {tensor.dtype} on {tensor.device}"
            raise ValueError(f"{name} {told}; got {tuple(found.shape)}, {found.dtype} on {found.device}.")


def units_of(samples: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of every column of (N, D), outlying values aside."""
    middle = samples.median(0).values
    away = (samples - middle).abs()
    typical = away.median(0).values
    usual = (typical == 0) | (away <= OUTLYING * typical)
    count = usual.sum(0)
    mean = (torch.where(usual, samples, 0.0) / count).sum(0)
    apart = torch.where(usual, samples - mean, 0.0)
    largest = apart.abs().amax(0)  # its square may be no number
    part = torch.where(largest > 0, apart / largest, 0.0)
    spread = largest * (part.square().sum(0) / count).sqrt()
    return mean, torch.where(spread > 1e-12 * mean.abs(), spread, 1.0)
