"""The inputs of a call of a program."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .combinators import Tree
from .plan import ordinary
from .tree import Shared, flatten, plain, unflatten


class Given(NamedTuple):
    """The inputs of a call as lists."""

    carry: list[Tensor]
    now: list[Any]
    row: list[Any]
    structures: dict[str, Any]
    rows: int
    times: int

    @classmethod
    def of(cls, carry: Tree, now: Tree, row: Tree, steps: int | None) -> Given:
        leaves, structures = {}, {}
        for name, tree in (("carry", carry), ("now", now), ("row", row)):
            leaves[name], structures[name] = flatten(tree)
        own = [leaf for name in ("carry", "now", "row") for leaf in leaves[name] if isinstance(leaf, Tensor)]
        if not own:
            raise ValueError(
                "`Program(...)` must be given at least one tensor with a dimension of rows; got none."
            )
        if leaves["now"]:
            first = leaves["now"][0]
            steps = len(first.tensor) if isinstance(first, Shared) else first.shape[1]
        if steps is None:
            raise ValueError("`Program(steps=...)` must be given where no input has times; got None.")
        return cls(**leaves, structures=structures, rows=own[0].shape[0], times=steps)

    @property
    def real(self) -> torch.dtype:
        floats = [plain(leaf).dtype for leaf in (*self.carry, *self.now, *self.row)]
        return torch.float64 if torch.float64 in floats or torch.float32 not in floats else torch.float32

    def trees(self) -> Tree:
        """The trees (row, now, carry)."""
        return tuple(self.tree(name, getattr(self, name)) for name in ("row", "now", "carry"))

    def tree(self, name: str, leaves: Sequence[Any]) -> Tree:
        return unflatten(self.structures[name], iter(leaves))

    def key(self) -> Hashable:
        parts: list[Hashable] = [(leaf.shape[1:], leaf.dtype) for leaf in self.carry]
        for skip, leaves in ((2, self.now), (1, self.row)):
            for leaf in leaves:
                shared = isinstance(leaf, Shared)
                tensor = plain(leaf)
                parts.append((tensor.shape[skip - shared :], tensor.dtype, shared))
        return tuple(parts), tuple(self.structures.values())

    def ordinary(self) -> bool:
        """Whether all tensors are ordinary ones on the CPU of which nobody wants a derivative."""
        if self.rows == 0 or self.times == 0:
            return False
        return ordinary((*self.carry, *self.now, *self.row))
