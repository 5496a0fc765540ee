"""A mutant in a process that has imported the package: its functions get the changed code."""

from __future__ import annotations

import functools
import gc
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

Key = tuple[str, str, int]


class Functions:
    """Functions of a package that are alive, by file, name and first line of their code."""

    def __init__(self, package: Path) -> None:
        """Look for them in a package's folder, and for every cache of a function."""
        self._alive: dict[Key, list[FunctionType]] = defaultdict(list)
        self._caches: list[Any] = []
        gc.unfreeze()  # what is frozen is not told
        for each in gc.get_objects():  # whose own types are asked: some warn where their class is
            if type(each) is FunctionType and each.__code__.co_filename.startswith(str(package)):
                code = each.__code__
                self._alive[code.co_filename, code.co_qualname, code.co_firstlineno].append(each)
            elif type(each) is functools._lru_cache_wrapper:
                self._caches.append(each)
        gc.freeze()

    def change(self, file: Path, was: str, now: str, line: int) -> bool:
        """Give the changed code to all functions around a line; False where that cannot be done."""
        before, after = (list(_codes(compile(text, str(file), "exec"))) for text in (was, now))
        if len(before) != len(after):
            return False
        changed = 0
        for old, new in zip(before, after, strict=True):
            if old.co_name == "<module>" or not old.co_firstlineno <= line <= _last_line(old):
                continue
            for each in self._alive.get((str(file), old.co_qualname, old.co_firstlineno), ()):
                try:
                    each.__code__ = new
                except ValueError:
                    return False
                changed += 1
        for each in self._caches:
            each.cache_clear()
        return changed > 0


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for each in code.co_consts:
        if isinstance(each, CodeType):
            yield from _codes(each)


def _last_line(code: CodeType) -> int:
    return max(line or 0 for each in _codes(code) for _, _, line in each.co_lines())
