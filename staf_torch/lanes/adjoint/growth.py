"""The line of the log on gradients in which rounding has grown over the times until nothing else is left."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

_GROWN = 1e12  # times what a gradient is of, from which on it is reported
_log = logging.getLogger(__name__)
_said: set[str] = set()  # programs of which it was


class Slope(NamedTuple):
    """A gradient by one of the quantities of a program."""

    quantity: str
    value: Tensor  # (B, ...), or (...) where it is summed over the rows
    by_row: bool


def grown(program: str, ends: Sequence[Tensor], found: Sequence[Tensor]) -> bool:
    """Return whether gradients that are made from ``ends``, (B, ...), are beyond all proportion, and nobody
    has said so of the program of that name.

    On a device, and in `torch.func`, nobody looks: a number would have to be waited for.
    """
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor
    if program in _said or not ends or any(x.is_meta or not x.is_cpu or wrapped(x) for x in (*ends, *found)):
        return False
    rows = max(1, len(ends[0]))
    came = sum([float(torch.linalg.vector_norm(end, 1)) for end in ends])
    if came != came:
        came = sum([float(end.abs().nansum()) for end in ends])
    most = _GROWN * came / rows
    return came > 0 and any(_beyond(part, most) for part in found if part.numel())


def say_grown(program: str, ends: Sequence[Tensor], slopes: Sequence[Slope]) -> None:
    """Log, once a program, the first row whose gradient is beyond all proportion, and by what.

    Proportion is to the ``ends``, (B, ...), that gradients are made from.
    """
    came = torch.stack([_by_row(end, 1) for end in ends]).nansum(0)
    rows = [(name, _by_row(value, math.inf)) for name, value, by_row in slopes if by_row and value.numel()]
    beyond = [((came > 0) & (size > _GROWN * came)).nonzero() for _, size in rows]
    first = min([int(found[0]) for found in beyond if len(found)], default=None)
    if first is None:
        total = float(came.sum())
        sums = [(name, float(value.abs().max())) for name, value, by_row in slopes if not by_row]
        name, most = max(sums, key=lambda pair: pair[1], default=("", 0.0))
        where = f"by {name}, summed over {len(came)} rows"
        if not most > _GROWN * total:
            return
    else:
        name, most = max([(name, float(size[first])) for name, size in rows], key=lambda pair: pair[1])
        where, total = f"by its {name} in row {first}", float(came[first])
    _said.add(program)
    told = (
        "%s: a gradient of %.1e %s, %.1e times what it is the gradient of, is made of rounding: the "
        "recursion amplifies small changes from time to time. Take a law that comes nearer in a step, "
        "more inner steps, or fewer times (`detach` between them). Said once."
    )
    _log.warning(told, program, most, where, most / total)


def _beyond(x: Tensor, most: float) -> bool:
    """Return whether an entry is larger, whatever others are NaN."""
    size = float(torch.linalg.vector_norm(x, math.inf))
    return size > most or (size != size and bool((x.abs() > most).any()))


def _by_row(x: Tensor, order: float) -> Tensor:
    """Return a norm of each row: (B, ...) -> (B,)."""
    x = x.detach().double()
    return x.abs() if x.dim() == 1 else torch.linalg.vector_norm(x, order, dim=tuple(range(1, x.dim())))
