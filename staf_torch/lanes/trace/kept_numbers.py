"""Captured numbers that stay numbers of a C text: what follows from them is computed there, to the bit.

A table has by default what torch computes of captured tensors alone, -1 / (2 width^2) where the text reads
that. Who calibrates a controller by hand has the width. Where all that follows from a tensor is arithmetic of
which C has every bit, the table has the tensor and the text the arithmetic: a compiler does it once as long
as the table is constant. Factors, sums and functions of math.h would take a microcontroller's time in every
call, and have other last digits: such numbers stay those that torch computes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .captured_tensors import Recipe, tensors
from .indexing import MOVEMENTS
from .tracer import LARGE

_EXACT = """add sub rsub mul div neg abs sqrt reciprocal minimum maximum clamp clamp_min clamp_max where
    lt le gt ge eq ne clone detach lift_fresh"""
_ALLOWED = frozenset(_EXACT.split()) | MOVEMENTS

_IN_ORDER = 3


def sources(recipe: Recipe) -> dict[int, frozenset[int]]:
    """Return, by the addresses of tensors of a recipe, those of the found ones that they follow from."""
    known = {id(tensor): frozenset([id(tensor)]) for tensor in recipe.found}
    for _, args, kwargs, out in recipe.operations:
        from_all = _united(known, tensors((args, kwargs)))
        known |= {id(tensor): from_all for tensor in tensors(out)}
    return known


def kept(recipe: Recipe, real: torch.dtype) -> list[Tensor]:
    """Return the found tensors of which all that follows is exact arithmetic of few numbers.

    Args:
        recipe: of a table.
        real: dtype of the program.
    """
    if not recipe.repeats:
        return []
    known, read, folded = sources(recipe), set[int](), set[int]()
    for function, args, kwargs, out in recipe.operations:
        given = tensors((args, kwargs))
        exact = _exact(function, args, kwargs, out) and _small([*given, *tensors(out)], real)
        (read if exact else folded).update(_united(known, given))
    folded |= _united(known, [tensor for tensor, _ in recipe.checks])
    addresses = [tensor.untyped_storage().data_ptr() for tensor in recipe.found]
    alone = [
        tensor
        for tensor, address in zip(recipe.found, addresses, strict=True)
        if addresses.count(address) == 1 and tensor.dtype == real
    ]
    return [tensor for tensor in alone if id(tensor) in read - folded]


def _united(known: dict[int, frozenset[int]], of: Sequence[Tensor]) -> frozenset[int]:
    return frozenset[int]().union(*(known.get(id(tensor), ()) for tensor in of))


def _exact(function: Any, args: Sequence[Any], kwargs: dict[str, Any], out: Any) -> bool:
    """Return whether C does the same to the bit, which torch does not where it adds products in one step."""
    name = function._schema.name.removeprefix("aten::")
    if name == "pow":
        return len(args) == 2 and not isinstance(args[1], Tensor) and args[1] == 2
    if name == "sum":  # more than three it adds in another order
        return bool(args[0].numel() <= _IN_ORDER * max(out.numel(), 1))
    if function._schema.is_mutable or kwargs.get("alpha", 1) != 1 or kwargs.get("rounding_mode"):
        return False
    return name in _ALLOWED or bool(function.is_view)


def _small(parts: Sequence[Tensor], real: torch.dtype) -> bool:
    floats = [part for part in parts if part.is_floating_point()]
    return all(part.dtype == real for part in floats) and all(part.numel() <= LARGE for part in parts)
