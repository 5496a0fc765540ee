"""A step of one row as C: traced with its numbers apart, which stand in a table by their names.

A table has by default what torch computes of captured tensors alone, -1 / (2 width^2) where the text reads
that. Who calibrates a controller by hand has the width. Where all that follows from a tensor is arithmetic of
which C has every bit, the table has the tensor and the text the arithmetic: a compiler does it once as long
as the table is constant. Factors, sums and functions of math.h would take a microcontroller's time in every
call, and have other last digits: such numbers stay those that torch computes.
"""

from __future__ import annotations

import itertools
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..calls.inputs import Given
from ..dependencies.contents import Contents, leads_by_copies, told_copies
from ..dependencies.walk import BOUND, EMPTY, Derived, content_of
from ..trace.captured_tensors import Recipe, address_of, places_of, tensors
from ..trace.decompositions import MOVEMENTS
from ..trace.graph import WIDE
from ..trace.step import Step, Traced, trace
from ..trace.tracer import LARGE, NotLoweredError
from ..tree import labels
from .c import CTable, Names, c_text

_log = logging.getLogger(__name__)
_LED = "; others here follow from it"
_ASKED = "; the text was written for this value"
_MOST = 3  # names of what a number follows from
_OF_MODULES = frozenset(vars(nn.Module()))
_FREE = re.compile(r"[^\w.\[\], ]")  # nothing that ends a comment
_EXACT = """add sub rsub mul div neg abs sqrt reciprocal minimum maximum clamp clamp_min clamp_max where
    lt le gt ge eq ne clone detach lift_fresh"""
_ALLOWED = frozenset(_EXACT.split()) | MOVEMENTS

_IN_ORDER = 3


class RowC(NamedTuple):
    """A step of a single row, traced for C."""

    traced: Traced
    given: Given  # of which the first row's carry is that of the start
    table: CTable  # its numbers; none where they are part of the text

    @classmethod
    def of(
        cls, step: Step, given: Given, parts: Sequence[Any] = (), make: Callable[..., Step] | None = None
    ) -> RowC:
        """Trace a step.

        Args:
            step: of a program.
            given: examples of its inputs.
            parts: all that the step reads, where that is known.
            make: the step of the parts, whose floats are then numbers of the table, too.

        Raises:
            NotLoweredError: if an operation has no scalar form.
        """
        why = "it has float64 inside of float32"
        for known, names in _spelled(step, parts, make):
            try:
                traced = _kept(known, given)
            except NotLoweredError as error:
                why = str(error)
                continue
            if not traced.rows and not wide(traced):
                values = [float(x) for x in traced.recipe.values.tolist()]
                return cls(traced, given, CTable(values, said(traced.recipe, named_tensors(names))))
        traced = trace(step, given, folded=True)
        _log.warning("C with its numbers in the text, not in a table that can be changed: %s", why)
        return cls(traced, given, CTable())

    def text(self, name: str, outputs: Sequence[str] | None = None, note: str = "") -> str:
        """Return the header, as `Program.c_source`."""
        traced, kinds = self.traced, self.given.structures
        rows, nows, carries = (labels(kinds[kind], kind) for kind in ("row", "now", "carry"))
        ends = labels(traced.structure, "out") if outputs is None else outputs
        start = [float(x) for leaf in self.given.carry for x in leaf[0].reshape(-1).tolist()]
        names = Names(rows, nows, carries, ends)
        return c_text(*traced.program, name=name, names=names, start=start, note=note, numbers=self.table)


def wide(traced: Traced) -> bool:
    """Return whether a program of float32 has float64 inside."""
    graph = traced.program[0]
    return graph.single and WIDE in graph.type


def _spelled(
    step: Step, parts: Sequence[Any], make: Callable[..., Step] | None
) -> Iterator[tuple[Step, dict[str, Any]]]:
    """Yield the step with floats of the library's objects as tensors, where it can be, and as it is."""
    given = tuple(parts)
    names = [""] if len(given) == 1 else [f"part{k}" for k in range(len(given))]
    if make is not None:
        read = Contents(*given, telling=True, watched=False)
        if read.told and read.key is not None and leads_by_copies(read, given):
            copies = told_copies(read.told, given)
            yield make(*copies), dict(zip(names, copies, strict=True))
    yield step, dict(zip(names, given, strict=True)) or {"": step}


def _kept(step: Step, given: Given) -> Traced:
    """Trace a step, once more where captured numbers can stay what they are."""
    traced = trace(step, given)
    stay = kept(traced.recipe, given.real)
    if stay:
        try:
            return trace(step, given, kept=stay)
        except NotLoweredError:  # it asks for a value that follows from them
            pass
    return traced


def sources(recipe: Recipe) -> dict[int, frozenset[int]]:
    """Return, by the addresses of tensors of a recipe, those of the found ones that they follow from."""
    known = {id(tensor): frozenset([id(tensor)]) for tensor in recipe.found}
    for _, args, kwargs, out in recipe.operations:
        from_all = _united(known, tensors((args, kwargs)))
        known |= {id(tensor): from_all for tensor in tensors(out)}
    return known


def kept(recipe: Recipe, real: torch.dtype) -> list[Tensor]:
    """Return the found tensors of a table's recipe of which all that follows is exact arithmetic of few
    numbers, in the program's dtype."""
    if not recipe.repeats:
        return []
    known, read, folded = sources(recipe), set[int](), set[int]()
    for function, args, kwargs, out in recipe.operations:
        given = tensors((args, kwargs))
        exact = _exact(function, args, kwargs, out) and _small([*given, *tensors(out)], real)
        (read if exact else folded).update(_united(known, given))
    folded |= _united(known, [tensor for tensor, _ in recipe.checks])
    addresses = [*map(address_of, recipe.found)]
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


def named_tensors(roots: Mapping[str, Any]) -> dict[int, tuple[str, Tensor]]:
    """Return tensors that objects lead to by the addresses of their memory, with the shortest name of each.

    The name of an only object may be "".
    """
    found: dict[int, tuple[str, Tensor]] = {}
    met, waiting = set[int](), [*roots.items()]
    while waiting:
        name, value = waiting.pop(0)
        if isinstance(value, Tensor):
            found.setdefault(address_of(value), (_FREE.sub("?", name), value))
        elif id(value) not in met:
            met.add(id(value))
            waiting += _parts(name, value)
    return found


def said(recipe: Recipe, known: Mapping[int, tuple[str, Tensor]]) -> list[str]:
    """Return what every number of a table is called: its name, or those of what it follows from."""
    ends, found = sources(recipe), {id(tensor): tensor for tensor in recipe.found}
    made = {id(tensor) for *_, out in recipe.operations for tensor in tensors(out)}

    def origins(tensor: Tensor) -> set[int]:
        """The memory of the found tensors that one follows from."""
        return {address_of(found[key]) for key in ends.get(id(tensor), ()) if key in found}

    def named(tensor: Tensor) -> bool:
        return address_of(tensor) in known or id(tensor) not in made

    led = set[int]().union(*(origins(tensor) for tensor, _ in recipe.reads if not named(tensor)))
    asked = set[int]().union(*(origins(tensor) for tensor, _ in recipe.checks))
    told = list[str]()
    for tensor, at in recipe.reads:
        if not named(tensor):
            names = [known[address][0] for address in origins(tensor) if address in known]
            told += [f"follows from {_some(names)}"] * len(at)
            continue
        name, whole = known.get(address_of(tensor), ("without a name", tensor))
        more = _LED * (address_of(tensor) in led) + _ASKED * (address_of(tensor) in asked)
        index = {place: k for k, place in enumerate(places_of(whole).reshape(-1).tolist())}
        places = places_of(tensor).reshape(-1)[at].tolist()
        told += [_entry(name, whole, index.get(place)) + more for place in places]
    return told


def _some(names: Sequence[str]) -> str:
    listed = sorted(names, key=lambda name: ("._" in name, name))
    more = f" and {len(listed) - _MOST} more" if len(listed) > _MOST else ""
    return ", ".join(listed[:_MOST]) + more or "numbers without a name"


def _entry(name: str, whole: Tensor, place: int | None) -> str:
    if whole.dim() == 0 or place is None:
        return name
    return f"{name}[{', '.join(map(str, np.unravel_index(place, tuple(whole.shape))))}]"


def _parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield what an object leads to, by names."""
    dot = f"{name}." if name else ""
    if isinstance(value, list | tuple):
        fields = getattr(value, "_fields", None)
        named = [f"{name}[{k}]" for k in range(len(value))] if fields is None else [dot + f for f in fields]
        yield from zip(named, value, strict=True)
    elif isinstance(value, dict):
        yield from ((f"{name}[{key}]", part) for key, part in value.items())
    elif isinstance(value, FunctionType):
        yield from _read_by(dot, value)
    elif isinstance(value, MethodType):
        yield name, value.__self__
    elif not isinstance(value, type | ModuleType | Derived | str | int | float | None):
        held = getattr(value, "__dict__", {})
        inside = [held.get(each) or {} for each in ("_parameters", "_buffers", "_modules")]
        own = [(k, v) for k, v in held.items() if k not in _OF_MODULES and k != BOUND]
        own.sort(key=lambda each: each[0].startswith("_"))  # the names that a user knows come first
        everything = itertools.chain(*(part.items() for part in inside), own)
        yield from ((dot + key, part) for key, part in everything)


def _read_by(dot: str, function: FunctionType) -> Iterator[tuple[str, Any]]:
    code = function.__code__
    for key, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        if (content := content_of(cell)) is not EMPTY:
            yield dot + key, content
    for key in code.co_names:
        if isinstance(part := function.__globals__.get(key), Tensor | nn.Module):
            yield dot + key, part
