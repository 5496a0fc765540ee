"""Tables common to C++ and CUDA: captured numbers, and slots of the carry that are arrays."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..trace.graph import Graph, Sizes
from ..trace.tracer import LARGE
from .matrices import MatrixWriter
from .schedule import Schedule, ends_with, taken_over


class Text(NamedTuple):
    """A program and the numbers that it reads from a table, so that other numbers need no other program."""

    source: str
    table: list[float]
    parameters: list[tuple[int, int]]  # places in the table, and the parameters of the graph that stand there

    def numbers(self, parameters: Tensor, real: torch.dtype) -> Tensor:
        """The table with these parameters, float64, in the program's dtype."""
        table = torch.tensor(self.table or [0.0], dtype=torch.float64, device="cpu")
        if self.parameters:
            places, numbers = zip(*self.parameters, strict=True)
            table[list(places)] = parameters[list(numbers)]
        return table.to(real)


class TableWriter(MatrixWriter):
    """A writer of programs that run for many rows and times.

    Attributes:
        table, parameters: of the `Text`.
    """

    def __init__(
        self, graph: Graph, schedule: Schedule, layout: Sizes, types: dict[str, str], copies: int = 1
    ) -> None:
        super().__init__(graph, schedule, layout, types, copies)
        self._in_memory = {slot for slot, size in enumerate(layout.carries) if size > LARGE}
        self._taken_over = taken_over(graph, schedule)
        self._ends = dict[int, int]()  # slots that a map makes where they were
        self.table: list[float] = []
        self.parameters: list[tuple[int, int]] = []

    def _slots(self, following: Sequence[int]) -> list[tuple[int, int, Sequence[int]]]:
        """Every slot of the carry, where it starts, and what it becomes."""
        starts = self._starts["state"]
        return [(k, a, following[a:b]) for k, (a, b) in enumerate(itertools.pairwise(starts))]

    def _find_ends(self, slots: Sequence[tuple[int, int, Sequence[int]]]) -> None:
        """Find the maps that make a slot in memory where it was."""
        for slot, _, nodes in slots:
            if slot in self._in_memory:
                node = ends_with(self.graph, self.schedule, self._taken_over, slot, nodes)
                if node is not None:
                    self._ends[slot] = node
                    self._taken_over.add(node)

    def _follow(self, slots: Sequence[tuple[int, int, Sequence[int]]]) -> None:
        """The carry becomes what follows, all at once: what lies in memory is copied last."""
        late = list[tuple[int, str, int]]()
        for slot, _, nodes in slots:
            own = [("state", (slot, k)) for k in range(len(nodes))]
            if slot not in self._in_memory or [(self.graph.op[n], self.graph.aux[n]) for n in nodes] == own:
                continue
            if slot in self._ends:
                continue
            self._line(f"{self._type(nodes[0])} next{slot}[{len(nodes) * self.copies}];")
            self._fill(f"next{slot}", nodes)
            late.append((slot, f"next{slot}", len(nodes) * self.copies))
        short = [(start, nodes) for slot, start, nodes in slots if slot not in self._in_memory]
        self._assign([(f"s{k}", node) for start, nodes in short for k, node in enumerate(nodes, start)])
        for slot, name, size in late:
            self._line(f"for (int p = 0; p < {size}; ++p) S{slot}[p] = {name}[p];")
        for slot, node in self._ends.items():
            self._entries(node, f"S{slot}")

    def _entry(self, node: int) -> int:
        """The place of a number in the table."""
        key = ("entry", node)
        if key not in self._index:
            self._index[key] = len(self.table)
            self._enter(node)
        return self._index[key]

    def _enter(self, node: int) -> None:
        if self.graph.op[node] == "param":
            self.parameters.append((len(self.table), self.graph.aux[node]))
        self.table.append(float(self.graph.value(node) or 0.0))

    def _entries_of(self, pack: int) -> int:
        """The place in the table where the numbers of an array begin."""
        key = ("pack", pack)
        if key not in self._index:
            self._index[key] = len(self.table)
            for node in self.graph.args[pack]:
                self._enter(node)
        return self._index[key]
