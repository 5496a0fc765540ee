"""Rows that differ in more than numbers: objects of several kinds beside each other, each for its rows.

A constructor that decides differently for some rows (a relative degree, a number of integration steps) makes
an object for all rows that decide alike. What holds all of them evaluates, for every row, that of its kind.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..dependencies.walk import BOUND
from ..row_numbers import RowNumbers, columns, in_use, some_rows
from ..trace.loops import where_rows
from ..tree import flatten
from .decisions import changed
from .objects import Merge


class Kind(NamedTuple):
    """An object of some rows that are alike in all but numbers."""

    rows: Tensor  # (R,)
    object: Any  # with the numbers of all B rows, of which those of other rows are the first one's


def kinds_of_rows(objects: Sequence[Any], rows: Sequence[Tensor], count: int) -> list[Kind]:
    """Return objects of one class, each of rows (R,) of ``count``, merged where they are alike in all but
    numbers."""
    groups = list[tuple[list[Any], list[Tensor], Any]]()
    for one, part in sorted(zip(objects, rows, strict=True), key=lambda pair: int(pair[1][0])):
        for k, (several, parts, _) in enumerate(groups):
            with contextlib.suppress(ValueError):
                joined = Merge([*parts, part], count).of([*several, one], type(one).__name__)
                groups[k] = ([*several, one], [*parts, part], joined)
                break
        else:
            groups.append(([one], [part], None))
    return [
        Kind(torch.cat(parts), joined if len(parts) > 1 else _spread(several[0], parts[0], count))
        for several, parts, joined in groups
    ]


def of_kinds(kinds: Sequence[Kind]) -> Any:
    """Return a copy of the first kind's module that has all of them as ``kinds``, and as its buffer ``kind``
    which of them a row is."""
    first, count = kinds[0].object, sum(len(kind.rows) for kind in kinds)
    made = object.__new__(type(first))
    vars(made).update({name: copy.copy(value) for name, value in vars(first).items() if name != BOUND})
    which = torch.zeros(count, dtype=torch.float64, device="cpu")
    for k, kind in enumerate(kinds):
        which[kind.rows] = float(k)
    made.kinds = nn.ModuleList(kind.object for kind in kinds)
    made.register_buffer("kind", RowNumbers(which))
    return made


def whichever(kind: Tensor, bodies: Sequence[Callable[[Any], Any]], given: Any, like: Any) -> Any:
    """Return what the function of a row's kind returns: trees (B, ...) to (B, ...), in place of ``like``."""
    count = len(flatten(given)[0][0])
    for k, body in enumerate(bodies):
        like = where_rows((kind == k).expand(count), body, given, like)
    return like


def by_kind(kind: Tensor, methods: Sequence[Callable[[Tensor], Tensor]], x: Tensor, like: Tensor) -> Tensor:
    """Return `whichever` of a batch, (B, ..., n) to (B, ...); a method is called once, for all of its rows.

    Raises:
        ValueError: if the numbers are of another count of rows.
    """
    if not in_use():  # somebody has said whose numbers they are: one row, or a program
        found: Tensor = whichever(kind, methods, x, like)
        return found
    assert isinstance(kind, RowNumbers)
    own = columns([kind], len(x))[0]
    for k, method in enumerate(methods):
        rows = (own == k).nonzero().flatten()
        if len(rows):
            with some_rows(rows.cpu()):
                like = like.index_copy(0, rows.to(x.device), method(x[rows.to(x.device)]))
    return like


def _spread(value: Any, rows: Tensor, count: int) -> Any:
    """Return an object of these rows (R,) as one of all rows: the others have the first's numbers."""
    place = torch.zeros(count, dtype=torch.int64, device="cpu")
    place[rows] = torch.arange(len(rows), device="cpu")

    def change(part: Any) -> Any:
        if not isinstance(part, RowNumbers) or len(part.full) != len(rows):
            return part
        return RowNumbers(part.full[place.to(part.full.device)])

    return value if len(rows) == count else changed(value, change)
