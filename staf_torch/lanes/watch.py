"""Whether objects, and what the functions in them read, are as they were."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from operator import is_
from typing import Any

from .content import inside_classes, written
from .surroundings import content_of, is_users


class Watch:
    """Says whether objects are as they were: nothing inside of them has been put in the place of another.

    Args:
        objects: as of `skeleton`.
        surroundings: whether only what functions and classes of a user read beside the objects is watched.

    Attributes:
        tensors: inside of them.
        blind: whether something inside cannot be watched.
    """

    def __init__(self, *objects: Any, surroundings: bool = False) -> None:
        writer = written(objects)
        if isinstance(writer, str):
            self.blind = True
            return
        self.blind = writer.blind_around if surroundings else writer.blind
        first = writer.inside if surroundings else (0,) * len(writer.inside)
        held = [part[k:] for part, k in zip(writer.held(), first, strict=True)]
        self._dicts, self._lists, sets, arrays, tensors, others = held
        self.tensors = [*tensors, *others]
        self._versions = [tensor._version for tensor in self.tensors]
        self._sets = [(part, set(part)) for part in sets]
        self._arrays = [(array, array.tobytes()) for array in arrays]
        classes = [each for each in writer.kept if isinstance(each, type)]
        self._code = inside_classes([each for each in classes if is_users(each)] if surroundings else classes)
        self._lookups, self._cells, self._functions = writer.lookups, writer.cells, writer.functions
        self._lengths, self._inside = self._look()

    def unchanged(self) -> bool:
        """Return whether nothing has changed since."""
        if self.blind:
            return False
        lengths, inside = self._look()  # all at once: a hundred containers in ten microseconds
        if lengths != self._lengths or not all(map(is_, inside, self._inside)):
            return False
        if any(now != then for now, then in self._sets):
            return False
        if any(now.tobytes() != then for now, then in self._arrays):
            return False
        return [tensor._version for tensor in self.tensors] == self._versions

    def _look(self) -> tuple[list[int], list[Any]]:
        """The lengths of all containers, and what is in them."""
        parts: list[Iterable[Any]] = [part.values() for part in self._dicts]
        parts += [part.values() for part in self._code]  # a method may be replaced
        parts += self._lists
        parts.append(lookup.value for lookup in self._lookups)
        parts.append(map(content_of, self._cells))
        parts += ((part.__code__, part.__defaults__) for part in self._functions)  # an editor may reload them
        return [*map(len, self._dicts), *map(len, self._code), *map(len, self._lists)], [
            *chain.from_iterable(parts)
        ]
