"""The streams of a filter: their states, their units, and how they come and go."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from ..numerics.angles import turned
from .compiled_filter import CompiledFilter, DirectCalls, KernelFilter
from .kalman_filter import STREAK, LocalFilter
from .local_functions import OwnFunctions
from .stream_state import StreamState

LEARNED_AT = (2, 5, 10, 20, 40)  # samples after which the units are learned
OUTLYING = 30.0  # median deviations beyond which a value has no say in them
FAR = 1e3  # spreads from the center where units say nothing: a stream that stays there learns new ones
GROWN = 3.0  # times its unit: a coordinate whose latest samples spread so far gets a larger one
LOOKED_AT = 10  # samples after which that is looked at again


class Streams(Protocol):
    """Streams side by side, none of which influences another: `FilterStreams`, or the `Bank` of a mixture."""

    dtype: torch.dtype
    compiled: bool  # tensors of this dtype are read in place by compiled code
    moves: bool  # samples of any device to where the streams are, and what is predicted back

    @property
    def count(self) -> int: ...  # S
    @property
    def learned(self) -> Tensor: ...  # samples, (S,) int64
    @property
    def skipped(self) -> Tensor: ...
    def predict(  # mean and deviation of the next y at x (S, n), in a shape
        self, x: Tensor, shape: tuple[int, ...] | None = None
    ) -> tuple[Tensor, Tensor]: ...
    def learn(self, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None: ...
    def clear(self, rows: Tensor) -> None: ...  # these streams begin anew
    def add(self, streams: int) -> None: ...  # behind the others
    def keep(self, rows: Tensor) -> None: ...  # these alone
    def state_dict(self) -> dict[str, Tensor]: ...
    def load_state_dict(self, state: dict[str, Tensor]) -> None: ...
    def stretch(self, x: Tensor, y: Tensor, lapse: Tensor) -> bool:
        """Learn a stretch in one call, (T, S, n), (T, S, K), (T, S); False where it is sample by sample."""
        return False

    def direct(self, shape: tuple[int, ...], targets: tuple[int, ...]) -> DirectCalls | None:
        """Return the calls that need no lock, of samples of these shapes; None where there are none."""
        return None


class FilterStreams(Streams):
    """S streams that a `LocalFilter` filters, with ``scaling`` in units learned from their first samples.

    ``units``, centers and spreads (S, 2 (n + K)), are known instead, NaN where they are not; learned spreads
    are multiplied by ``stretch`` (S, n + K). Units of coordinates with 1 in ``may_grow`` (S, n) grow with
    what they move by: by default all that are learned. ``periodic`` coordinates, angles in rad, are turned
    by whole turns to within pi of the latest x: centers follow it, and forget what was a turn before.
    """

    moves = False

    def __init__(
        self,
        definition: LocalFilter,
        state: StreamState,
        scaling: bool,
        units: Tensor | None = None,
        stretch: Tensor | None = None,
        may_grow: Tensor | None = None,
        periodic: tuple[int, ...] = (),
    ) -> None:
        self.periodic = periodic
        self.latest = state.blocks.new_full((state.streams, state.dim), torch.nan)
        self.scaling = scaling
        self.dtype = state.dtype
        size, wide = state.streams, state.dim + state.outputs
        like = state.blocks.new_zeros(0, dtype=torch.float64)
        self.units = like.new_zeros(size, 2 * wide)  # centers, spreads
        self._stretch = self.units.new_ones(size, wide) if stretch is None else stretch.double()
        self._known = torch.full_like(self.units, torch.nan) if units is None else units.double()
        self.first = like.new_zeros(size, LEARNED_AT[-1] if scaling else 0, wide + 1)  # samples and lapses
        # Of first samples; behind them, of far ones in a row. Then the place of the oldest of the latest.
        self.clock, self.turn = (torch.zeros(size, dtype=torch.int64, device=like.device) for _ in range(2))
        grows = self.units.new_full((size, state.dim), float(units is None))
        self._may_grow = grows if may_grow is None else may_grow.double()
        self._begin(torch.arange(size, device=like.device))
        self._hold(definition, state)

    def _begin(self, rows: Tensor) -> None:
        """Streams with these numbers know no units but those that they were given."""
        wide, known = self.units.shape[1] // 2, self._known[rows]
        given = known.isfinite().all(1)
        unit = torch.arange(2 * wide, device=self.units.device) >= wide
        self.units[rows] = torch.where(given[:, None], known, unit.double())
        self.clock[rows] = torch.where(given, LEARNED_AT[-1], 0)
        self.first[rows] = 0.0
        self.first[rows, :, :-1] = torch.nan
        self.turn[rows] = 0

    def _hold(self, definition: LocalFilter, state: StreamState) -> None:
        """Filter these streams from now on."""
        self.definition, self.state = definition, state
        self._filter = CompiledFilter.build(definition, state)
        self.compiled = isinstance(self._filter, CompiledFilter) and not self.scaling
        self._center, self._spread = self.units.to(self.dtype).split(state.dim + state.outputs, dim=1)
        self._calm, self._even = False, 0  # until `_see`

    def direct(self, shape: tuple[int, ...], targets: tuple[int, ...]) -> DirectCalls | None:
        if (
            self.scaling
            or self.periodic
            or not isinstance(self._filter, CompiledFilter)
            or not self._filter.short
        ):
            return None
        return DirectCalls(self._filter, self.dtype, shape, targets)

    @property
    def count(self) -> int:
        """Return S."""
        return self.state.streams

    @property
    def learned(self) -> Tensor:
        """Samples learned, (S,) int64."""
        return self.state.counts[0]

    @property
    def skipped(self) -> Tensor:
        """Samples skipped, (S,) int64."""
        return self.state.counts[1]

    def predict(self, x: Tensor, shape: tuple[int, ...] | None = None) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the next y at x (S, n): (S, K), or in ``shape``."""
        x = self._near(x)
        if not self.scaling:
            if isinstance(self._filter, CompiledFilter):
                return self._filter.predict(self.state, x, shape)
            mean, deviation = self._filter.predict(self.state, x)
            return (mean, deviation) if shape is None else (mean.view(shape), deviation.view(shape))
        n = self.state.dim
        mean, deviation = self._filter.predict(self.state, (x - self._center[:, :n]) / self._spread[:, :n])
        return mean * self._spread[:, n:] + self._center[:, n:], deviation * self._spread[:, n:]

    def stretch(self, x: Tensor, y: Tensor, lapse: Tensor) -> bool:
        if self.scaling or self.periodic or not isinstance(self._filter, KernelFilter):
            return False
        self._filter.stretch(self.state, x, y, lapse)
        return True

    def learn(self, x: Tensor, y: Tensor, lapse: Tensor | None = None) -> None:
        """Learn one sample a stream: (S, n), (S, K), (S,)."""
        x = self._near(x)
        if self.scaling and not x.is_meta:  # without numbers there are no units to learn
            self._learn_in_units(x, y, lapse)
        else:
            self._filter.learn(self.state, x, y, lapse)
        if self.periodic:
            rows = x.reshape(self.latest.shape)
            self.latest = torch.where(torch.isfinite(rows), rows, self.latest)

    def _learn_in_units(self, x: Tensor, y: Tensor, lapse: Tensor | None) -> None:
        n, both = self.state.dim, torch.cat((x, y), 1).double()
        calm = self._calm and bool(both.isfinite().all()) and not self._far(both)
        due = None
        if not calm:
            self._leave(x, both)
            due = self._remember(both, lapse)
        rest = (y - self._center[:, n:]) / self._spread[:, n:]
        if due is not None:
            rest = torch.where(due.unsqueeze(1), torch.nan, rest)
        self._filter.learn(self.state, (x - self._center[:, :n]) / self._spread[:, :n], rest, lapse)
        if due is None:  # no stream is young and all of the sample is measured
            self.first[:, self._even, :-1] = both
            self.first[:, self._even, -1] = 1.0 if lapse is None else lapse
            self._even = (self._even + 1) % LEARNED_AT[-1]
            self.turn.fill_(self._even)
        elif bool(due.any()):
            self.state.counts[1] -= due.long()  # not skipped: it is learned with the others
            self._learn_units(due)
        if not calm or self._even % LOOKED_AT == 0:
            self._grow()
            self._see()

    def _near(self, x: Tensor) -> Tensor:
        """x (S, n), angles turned to the latest where there is one."""
        if not self.periodic:
            return x
        latest = self.latest.reshape(x.shape)
        return torch.where(latest.isnan() | x.isnan(), x, turned(x, latest, self.periodic))

    def _see(self) -> None:
        """Note whether all streams have their units and are at the same place of their latest samples: the
        next sample then costs a few operations."""
        self._even = int(self.turn[0])
        self._calm = bool((self.clock == LEARNED_AT[-1]).all()) and bool((self.turn == self._even).all())
        self._reach = FAR * self.units.chunk(2, dim=1)[1]
        self._watched = not bool(self._known.isfinite().all(1).any())

    def _far(self, both: Tensor) -> bool:
        """Return whether a stream is so far from the samples of its units that these say nothing."""
        away = (both - self.units[:, : both.shape[1]]).abs()
        return not self._watched or bool((away > self._reach).any())

    def _remember(self, both: Tensor, lapse: Tensor | None) -> Tensor:
        """Keep the latest samples of every stream; which streams learn their units from the first, (S,)."""
        n, kept = self.state.dim, LEARNED_AT[-1]
        seen = ~both.isnan()
        usable = seen[:, :n].any(1) & seen[:, n:].any(1) & ~both.isinf().any(1)
        young = self.clock < kept
        place = torch.where(young, self.clock, self.turn)
        every = torch.arange(len(place), device=place.device)
        lapses = torch.ones_like(both[:, 0]) if lapse is None else lapse
        waited = torch.where(young, self.first[every, place, -1], 0.0)  # since the last usable one
        self.first[every, place, -1] = waited + lapses
        rows = usable.nonzero().squeeze(1)
        self.first[rows, place[rows], :-1] = self._with_held(both[rows], rows)
        self.turn = torch.where(usable & ~young, (self.turn + 1) % kept, self.turn)
        self.clock += usable & young
        return usable & young & torch.isin(self.clock, self.clock.new_tensor(LEARNED_AT))

    def _with_held(self, both: Tensor, rows: Tensor) -> Tensor:
        """Put what a stream holds in place of coordinates that no kept sample has: (R, n + K) of these rows.

        They were measured in samples that were not kept, having no target; who learns the kept ones again
        would not know them.
        """
        n = self.state.dim
        lost = both[:, :n].isnan()
        if not bool(lost.any()):  # costs time alone
            return both
        held = self.state.parts(self.state.table[:, rows].double()).last.mT
        held = held * self._spread[rows, :n] + self._center[rows, :n]
        lost &= self.first[rows, :, :n].isnan().all(1)
        return torch.cat((torch.where(lost, held, both[:, :n]), both[:, n:]), 1)

    def _grow(self) -> None:
        """Give a coordinate that moves by far more than its unit a larger one, and learn the latest again."""
        n, wide = self.state.dim, self.units.shape[1] // 2
        looks = (self.clock == LEARNED_AT[-1]) & (self.turn % LOOKED_AT == 0) & self._may_grow.any(1)
        rows = looks.nonzero().squeeze(1)
        latest, unit = self.first[rows, :, :n], self.units[rows, wide : wide + n]
        # No spread is larger than half of what lies between the extremes, which are found in no time.
        lowest, highest = latest.nan_to_num(nan=torch.inf).amin(1), latest.nan_to_num(nan=-torch.inf).amax(1)
        wide_enough = 0.5 * (highest - lowest) * self._stretch[rows, :n] > GROWN * unit
        some = wide_enough.any(1)
        if not bool(some.any()):  # costs time alone
            return
        rows, latest, unit = rows[some], latest[some], unit[some]
        moves = units_of(latest.transpose(0, 1).flatten(1))[1].unflatten(0, (len(rows), n))
        still = (latest.isnan() | (latest == latest[:, :1])).all(1)  # has the spread 1
        told = (~latest.isnan()).sum(1) >= LEARNED_AT[-1] // 2
        moves = torch.where(told & ~still, moves * self._stretch[rows, :n], 0.0)
        grown = (moves > GROWN * unit) & (self._may_grow[rows] > 0)
        some = grown.any(1)
        if not bool(some.any()):  # costs time alone
            return
        rows = rows[some]
        self.units[rows, wide : wide + n] = torch.where(grown, moves, unit)[some]
        places = torch.arange(LEARNED_AT[-1], device=self.turn.device)
        order = (self.turn[rows, None] + places) % LEARNED_AT[-1]
        self._relearn(rows, self.first[rows[:, None], order])

    def _leave(self, x: Tensor, both: Tensor) -> None:
        """Let streams learn new units that have been far from what these were learned from for long."""
        settled = (self.clock >= LEARNED_AT[-1]) & ~self._known.isfinite().all(1)
        if not bool(settled.any()):
            return
        center, spread = self.units.chunk(2, dim=1)
        far = ((both - center).abs() > FAR * spread).any(1) & torch.isfinite(x).all(1)
        clock = torch.where(far, self.clock + 1, LEARNED_AT[-1])
        self.clock = torch.where(settled & ~both.isnan().any(1), clock, self.clock)
        gone = (self.clock >= LEARNED_AT[-1] + STREAK).nonzero().squeeze(1)
        if len(gone):
            counts = self.state.counts[:2, gone].clone()
            self.clear(gone)
            self.state.counts[:2, gone] = counts

    def _learn_units(self, due: Tensor) -> None:
        """Take the units of some streams from their first samples, and learn these again."""
        for count in LEARNED_AT:
            rows = (due & (self.clock == count)).nonzero().squeeze(1)
            if len(rows):
                samples = self.first[rows, :count]
                center, spread = (
                    part.unflatten(0, (len(rows), -1))
                    for part in units_of(samples[..., :-1].transpose(0, 1).flatten(1))
                )
                self.units[rows] = torch.cat((center, spread * self._stretch[rows]), 1)
                self._relearn(rows, samples, added=1)

    def _relearn(self, rows: Tensor, samples: Tensor, added: int = 0) -> None:
        """Let streams (R,) forget all but these samples and their lapses, (R, N, n + K + 1), oldest
        first, in their units; ``added`` is 1 where the latest of them has not been counted yet."""
        wide, n = self.state.dim + self.state.outputs, self.state.dim
        self._center, self._spread = self.units.to(self.dtype).split(wide, dim=1)
        center, spread = self.units[rows].unsqueeze(1).split(wide, dim=-1)
        u = ((samples[..., :wide] - center) / spread).to(self.dtype)
        alone = StreamState.empty(self.state.blocks, len(rows), *self.state.sizes)
        law = self.definition.of_rows(rows)
        filter_ = CompiledFilter.build(law, alone)
        for k in range(u.shape[1]):
            before = alone.counts[0].clone()
            at, lapse = u[:, k], samples[:, k, -1].clone()
            filter_.learn(alone, at[:, :n].contiguous(), at[:, n:].contiguous(), lapse)
        latest = alone.counts[0] - before  # 1 if the latest sample was learned
        counts = self.state.counts[:2, rows].clone()
        self.state.replace(rows, alone)
        self.state.counts[0, rows] = torch.maximum(counts[0] + added * latest, alone.counts[0])
        self.state.counts[1, rows] = counts[1] + added * (1 - latest)

    def units_for(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Centers and spreads (S, n + K) for a whole record (T, S, n + K): from all of it, or as known."""
        wide = self.units.shape[1] // 2
        if not self.scaling or bool((self.clock >= LEARNED_AT[-1]).all()):
            return self.units[:, :wide], self.units[:, wide:]
        found = [units_of(torch.where(row.isfinite(), row, torch.nan)) for row in samples.unbind(1)]
        spreads = torch.stack([pair[1] for pair in found]) * self._stretch
        return torch.stack([pair[0] for pair in found]), spreads

    def clear(self, rows: Tensor) -> None:
        """Let the streams with these numbers begin anew."""
        fresh = StreamState.empty(self.state.blocks, len(rows), *self.state.sizes)
        self.state.replace(rows, fresh)
        self._begin(rows)
        self.latest[rows] = torch.nan
        self._center, self._spread = self.units.to(self.dtype).chunk(2, dim=1)
        self._calm = False

    def add(self, streams: int) -> None:
        """Begin further streams, behind the others; refused where the streams have numbers of their own."""
        if isinstance(self.definition.functions, OwnFunctions):
            raise ValueError("streams with numbers of `rows(...)` are as many as these: none can be added.")
        fresh = StreamState.empty(self.state.blocks, streams, *self.state.sizes)
        table = torch.cat((self.state.table, fresh.table), 1)
        state = self.state.with_table(table, torch.cat((self.state.counts, fresh.counts), 1))
        new = self.units.new_full((streams, self.units.shape[1]), torch.nan)
        self.units, self._known = torch.cat((self.units, new)), torch.cat((self._known, new))
        unseen = self.latest.new_full((streams, self.state.dim), torch.nan)
        self.latest = torch.cat((self.latest, unseen))
        self.first = torch.cat((self.first, self.first.new_zeros(streams, *self.first.shape[1:])))
        self.clock, self.turn = (torch.cat((a, a.new_zeros(streams))) for a in (self.clock, self.turn))
        self._may_grow, self._stretch = (_joined(a, streams) for a in (self._may_grow, self._stretch))
        self._begin(torch.arange(self.count, self.count + streams, device=self.clock.device))
        law = (_joined(a, streams) for a in (self.definition.ratio, self.definition.forgetting))
        self._hold(self.definition.with_law(*law), state)

    def keep(self, rows: Tensor) -> None:
        """Go on with the streams with these numbers alone."""
        state = self.state.with_table(self.state.table[:, rows], self.state.counts[:, rows])
        for name in ("units", "first", "clock", "turn", "latest", "_known", "_stretch", "_may_grow"):
            setattr(self, name, getattr(self, name)[rows])
        self._hold(self.definition.of_rows(rows), state)

    def state_dict(self) -> dict[str, Any]:
        """Copies of all tensors that learning changes, and what the local functions are told by."""
        return {name: tensor.clone() for name, tensor in (self._learned() | self._fixed()).items()}

    def _fixed(self) -> dict[str, Tensor]:
        """Return the tensors that a loaded state must share: the centers, and the kernel at them."""
        return self.definition.functions.fixed()

    def _learned(self) -> dict[str, Tensor]:
        """All tensors that learning changes."""
        names = ("units", "clock", "turn", "first", *(["latest"] if self.periodic else []))
        own = {name: getattr(self, name) for name in names}
        law = {"ratio": self.definition.ratio, "forgetting": self.definition.forgetting}
        return {"table": self.state.table, "counts": self.state.counts} | own | law

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` of as many streams has; refused where a tensor has another shape,
        dtype or device, since compiled code goes by these, or kernel or centers are others."""
        given_table = table_of(state)
        refuse_other(state, self._learned(), self.state.blocks.shape[1], given_table.shape[0])
        for name, own in self._fixed().items():
            given = state.get(name)
            like = isinstance(given, Tensor) and given.shape == own.shape and given.dtype == own.dtype
            if given is None or not like or not torch.allclose(given, own, rtol=1e-9):
                told = "must have the kernel, radius and centers of this regressor"
                raise ValueError(f"`load_state_dict(state=...)` {told}; {name!r} differs.")
        kept = self.state.with_table(state["table"], state["counts"].clone())
        for name in {"units", "clock", "first", "turn", "latest"} & {*self._learned()}:
            setattr(self, name, state[name].clone())
        self._hold(self.definition.with_law(state["ratio"].clone(), state["forgetting"].clone()), kept)


def _joined(values: Tensor, streams: int) -> Tensor:
    """With the lower median of every column for streams that are added: (S, ...) -> (S + streams, ...)."""
    return torch.cat((values, values.median(0).values.expand(streams, *values.shape[1:])))


def table_of(state: dict[str, Any]) -> Tensor:
    """The table of a saved state, of two dimensions; raises where it has none."""
    table = state.get("table")
    if not isinstance(table, Tensor) or table.dim() != 2:
        raise ValueError("`load_state_dict(state=...)` must have a tensor 'table' of two dimensions.")
    return table


def refuse_other(state: dict[str, Any], own: dict[str, Tensor], expected: int, given: int) -> None:
    """Refuse a saved state with other tensors than a new one's ``own``, by name, or other numbers a
    stream."""
    name = "`load_state_dict(state=...)` must have"
    if given != expected:
        told = f"{expected} numbers a stream, as this version and these arguments have; got {given}"
        raise ValueError(f"{name} {told}.")
    for key, tensor in own.items():
        found = state.get(key)
        like = tuple(tensor.shape), tensor.dtype, tensor.device
        its = (tuple(found.shape), found.dtype, found.device) if isinstance(found, Tensor) else found
        if its != like:
            raise ValueError(
                f"{name} a tensor {key!r} of shape {like[0]}, {like[1]} on {like[2]}; got {its!r}."
            )


def total(values: Tensor) -> Tensor:
    """Sum over the first dimension, of which each column's bits do not depend on how many stand beside it."""
    return values.cumsum(0)[-1]


def units_of(samples: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of every column of (N, D) but for NaN and outlying values; 0, 1 of none."""
    middle = samples.nanmedian(0).values
    away = (samples - middle).abs()
    typical = away.nanmedian(0).values
    usual = ~samples.isnan() & ((typical == 0) | (away <= OUTLYING * typical))
    count = usual.sum(0).clamp(min=1)
    mean = total(torch.where(usual, samples, 0.0) / count)
    apart = torch.where(usual, samples - mean, 0.0)
    largest = apart.abs().amax(0)  # its square may be no number
    part = torch.where(largest > 0, apart / largest, 0.0)
    spread = largest * (total(part.square()) / count).sqrt()
    return mean, torch.where(spread > 1e-12 * mean.abs(), spread, 1.0)
