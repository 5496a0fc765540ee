"""Resolved settings as plain Python objects, for jobs of many members: OmegaConf's take milliseconds each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, overload

from omegaconf import DictConfig


class PlainSettings(dict[str, Any]):
    """Settings by name, nested, that are read as a `DictConfig` is: ``cfg.kernel``, ``cfg.get("dt")``.

    Members share what is equal in their settings, so that nobody may change them.
    """

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(name) from error

    @classmethod
    def of(cls, tree: Mapping[Any, Any]) -> PlainSettings:
        """Return a tree of dictionaries as settings."""
        return cls({str(k): cls.of(v) if isinstance(v, dict) else v for k, v in tree.items()})


class ManySettings(Sequence[DictConfig]):
    """The settings of many members: plain where that is possible, and Hydra's own when they are asked for.

    Args:
        plain: of every member, None where only Hydra can make them.
        flat: the same by dotted keys, as a run records them.
        make: makes Hydra's own for a member, by its number.
    """

    def __init__(
        self,
        plain: Sequence[PlainSettings | None],
        flat: Sequence[Mapping[str, Any]],
        make: Callable[[int], DictConfig],
    ) -> None:
        self._plain, self.flat, self._make = plain, flat, make
        self._made: dict[int, DictConfig] = {}

    def __len__(self) -> int:
        return len(self._plain)

    @overload
    def __getitem__(self, index: int) -> DictConfig: ...

    @overload
    def __getitem__(self, index: slice) -> ManySettings: ...

    def __getitem__(self, index: int | slice) -> DictConfig | ManySettings:
        if isinstance(index, slice):
            return self.of(range(*index.indices(len(self))))
        index = range(len(self))[index]
        if index not in self._made:
            self._made[index] = self._make(index)
        return self._made[index]

    def of(self, indices: Sequence[int]) -> ManySettings:
        """Return those of some members."""
        plain, flat = [self._plain[i] for i in indices], [self.flat[i] for i in indices]
        return ManySettings(plain, flat, lambda i: self._make(indices[i]))

    def read(self) -> list[DictConfig | PlainSettings]:
        """Return the settings of every member, plain where that is possible."""
        return [self[i] if plain is None else plain for i, plain in enumerate(self._plain)]


def to_read(cfgs: Sequence[DictConfig]) -> Sequence[DictConfig | PlainSettings]:
    """Return settings that are only read: plain ones where somebody has them."""
    return cfgs.read() if isinstance(cfgs, ManySettings) else cfgs
