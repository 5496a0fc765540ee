"""Tensors that a step finds outside: numbers of a table, of which the text of a program knows nothing.

A width of 0.5 or 0.7 shall be the same machine code. What follows from tensors of outside alone (a Gram
matrix of fixed centers, its factor) is computed by torch while tracing and enters the table; which operations
led there is kept as a recipe, which makes the table again from other tensors in microseconds. What the code
of a step states itself (`torch.eye(3)`), integers and flags are structure and part of the text. To make every
captured number an input would compute the factor in every row and at every time.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from ..dependencies.contents import version

_NO_VALUES = """zeros_like ones_like full_like empty_like rand_like _new_zeros_with_same_feature_meta
    new_zeros new_ones new_full new_empty new_empty_strided lift_fresh lift_fresh_copy"""
_OF_NO_VALUES = frozenset(_NO_VALUES.split())
"""Operations whose result does not depend on the numbers of their arguments."""


Operation = tuple[Any, Sequence[Any], dict[str, Any], Any]
"""A function, its arguments, and what it returned."""


class Recipe(NamedTuple):
    """The recipe by which the numbers of a table follow from the tensors that a step captured."""

    values: Tensor  # the numbers as they were, float64
    operations: list[Operation]
    reads: list[tuple[Tensor, np.ndarray[Any, Any]]]  # a tensor, and which places of its memory
    found: list[Tensor]  # floating-point tensors that were there before
    checks: list[tuple[Tensor, Any]]  # numbers that the step itself read, and depends on; lists of all

    @property
    def repeats(self) -> bool:
        """Return whether other numbers follow from other tensors."""
        return all(tensor.numel() for tensor in self.found)

    def again(self, others: Mapping[int, Tensor]) -> Tensor | None:
        """The numbers with other tensors in place of those found; None where the program would be another."""
        if not self.repeats or any(id(tensor) not in others for tensor in self.found):
            return None
        known = dict(others)
        with torch.no_grad(), torch._C.DisableTorchFunction():  # a default device concerns nothing here
            for operation in self.operations:
                _repeat(operation, known)
            if any(not _same(known.get(id(tensor), tensor), value) for tensor, value in self.checks):
                return None
            return _joined([_read(known.get(id(tensor), tensor), at) for tensor, at in self.reads])


class TableSlopes:
    """Slopes by captured tensors, of those by the numbers of a table that follow from them.

    Attributes:
        runs: of the numbers: where each begins, and its length.
    """

    def __init__(self, recipe: Recipe, of: Sequence[Tensor]) -> None:
        self._found, self._of, start = recipe.found, of, 0
        operations, same = _different(recipe.operations)
        made = {id(tensor) for tensor in of}
        for _, args, kwargs, out in operations:
            if any(id(t) in made for t in tensors((args, kwargs))):
                made.update(id(t) for t in tensors(out))
        self.runs: list[tuple[int, int]] = []
        self._reads: list[tuple[int, Tensor | None]] = []  # of what, and which entries; None for all in order
        for tensor, at in recipe.reads:
            key = same.get(id(tensor), id(tensor))
            if key in made and tensor.is_floating_point():
                whole = np.array_equal(at, np.arange(tensor.numel()))
                self.runs.append((start, len(at)))
                self._reads.append((key, None if whole else torch.from_numpy(at)))
            start += len(at)
        needed, kept = {key for key, _ in self._reads}, []
        for operation in reversed(operations):
            if any(id(t) in needed for t in tensors(operation[3])):
                kept.append(operation)
                needed.update(id(t) for t in tensors(operation[1:3]))
        self._operations = [*reversed(kept)]

    def __call__(self, others: Sequence[Tensor], by_numbers: Sequence[Tensor]) -> list[Tensor]:
        """Return the slopes, with others in place of all tensors that were found, of those by the numbers,
        run by run."""
        known = {id(found): each.detach() for found, each in zip(self._found, others, strict=True)}
        with torch.enable_grad():
            wanted = [known[id(tensor)].requires_grad_() for tensor in self._of]
            for operation in self._operations:
                function, args, _, out = operation
                if function is torch.ops.aten.detach.default:  # of what autograd keeps; the same numbers
                    known[id(out)] = _swapped(args[0], known)
                else:
                    _repeat(operation, known)
            read = [(known[key].reshape(-1), at) for key, at in self._reads]
            numbers = [x if at is None else x[at.to(x.device)] for x, at in read]
            pairs = [(x, s.to(x)) for x, s in zip(numbers, by_numbers, strict=True) if x.requires_grad]
            sums = [torch.dot(x, slope) for x, slope in pairs]  # given slopes, torch imports SymPy
        if not sums:
            return [torch.zeros_like(x) for x in wanted]
        found = torch.autograd.grad(sums, wanted, allow_unused=True)
        return [torch.zeros_like(x) if y is None else y for x, y in zip(wanted, found, strict=True)]


def _repeat(operation: Operation, known: dict[int, Tensor]) -> None:
    """Run an operation with what stands in the place of its arguments, and note what it returned."""
    function, args, kwargs, out = operation
    given = [known.get(id(x), x) if isinstance(x, Tensor) else _swapped(x, known) for x in args]
    result = function(*given, **_swapped(kwargs, known)) if kwargs else function(*given)
    if isinstance(out, Tensor):
        known[id(out)] = result
    else:
        known.update(zip(map(id, tensors(out)), tensors(result), strict=True))


def _different(operations: Sequence[Operation]) -> tuple[list[Operation], dict[int, int]]:
    """Return the operations without those that repeat an earlier one, and what stands for what these made."""
    kept, same, met = list[Operation](), dict[int, int](), dict[Hashable, Any]()
    first: dict[int, Tensor] = {}

    def described(value: Any) -> Hashable:
        if isinstance(value, Tensor):
            return Tensor, same.get(id(value), id(value))
        if isinstance(value, list | tuple):
            return tuple(map(described, value))
        return type(value), value  # 1, 1.0 and True are equal

    for function, args, kwargs, out in operations:
        given, named = _swapped(args, first), _swapped(kwargs, first)
        try:
            earlier = met.setdefault((function, described(given), described((*named.items(),))), out)
        except TypeError:  # an argument that cannot be compared
            earlier = out
        if earlier is out or function._schema.is_mutable:
            kept.append((function, given, named, out))
            continue
        for new, old in zip(tensors(out), tensors(earlier), strict=True):
            same[id(new)], first[id(new)] = id(old), old
    return kept, same


class Captured:
    """Tells numbers that were captured from those that the code of a step states itself.

    What a step makes without a tensor from outside (`torch.eye(3)`, `torch.tensor(0.5)`) is part of its text,
    and so is the structure that integers and flags from outside hold, as indices and masks do. Floating-point
    tensors from outside, and all that follows from them, are numbers of the table.
    """

    def __init__(self) -> None:
        # Storages that the step made, kept as an address is used once, and whether its code states numbers.
        self._made: dict[int, tuple[Any, bool]] = {}
        self._places: dict[tuple[int, str], dict[int, int]] = {}
        self._operations: list[tuple[Any, Sequence[Any], dict[str, Any], Any]] = []
        self._reads: list[tuple[Tensor, np.ndarray[Any, Any]]] = []  # keeps them: an address is used once
        self._values: list[Tensor] = []  # read at once: memory may be written to later
        self._checks: list[tuple[Tensor, Any]] = []
        self._repeats = True
        self._used = set[int]()  # storages that the step made and operations to be repeated read
        self._results: dict[Hashable, int] = {}  # operations that ran, and the storage of what they returned
        self._same: dict[int, int] = {}  # storages, and earlier ones that hold the same numbers
        self.count = 0

    def stated(self, tensor: Tensor) -> bool:
        """Return whether the numbers of a tensor are part of the text."""
        if not _in_memory(tensor):
            return True
        _, stated = self._made.get(address_of(tensor), (None, not tensor.is_floating_point()))
        return stated

    def from_outside(self, tensor: Tensor) -> bool:
        """Return whether a tensor existed before the trace."""
        return _in_memory(tensor) and address_of(tensor) not in self._made

    def ran(self, function: Any, args: Sequence[Any], kwargs: dict[str, Any], out: Any) -> None:
        """Note an operation on tensors of which no row has its own."""
        name = function._schema.name.removeprefix("aten::")
        given = [t for t in tensors((args, kwargs)) if _in_memory(t)]
        if name == "lift_fresh":
            self._written_here(given)
        stated = name in _OF_NO_VALUES or all(self.stated(t) for t in given)
        if not stated:
            if name == "_local_scalar_dense":
                self._checks.append((given[0], out))
            elif not tensors(out):  # read in a way that cannot be checked
                self._repeats = False
            self._operations.append((function, args, kwargs, out))
            self._used.update(map(address_of, given))
        if function._schema.is_mutable:
            for tensor in given:
                self._forget(tensor)
            # What was read before would be read as it is written now.
            self._repeats = self._repeats and stated and self._used.isdisjoint(map(address_of, given))
        before = set(map(address_of, given))
        for tensor in filter(_in_memory, tensors(out)):
            address, storage = address_of(tensor), tensor.untyped_storage()
            known = address in self._made
            if not stated:
                self._made[address] = storage, False
                if not known and not function._schema.is_mutable:
                    self._recognise(address, function, args, kwargs)
            elif not known and address not in before:
                self._made[address] = storage, True

    def taken(self, tensor: Tensor) -> None:
        """Note that numbers leave torch: what the step does with them is part of the text."""
        if not self.stated(tensor):
            self._checks.append((tensor, [tensor.detach().tolist()]))

    def _written_here(self, fresh: Sequence[Tensor]) -> None:
        """Return whether `torch.tensor` just made it of Python's numbers, not of memory of NumPy."""
        for tensor in fresh:
            storage = tensor.untyped_storage()
            if storage.resizable() and self.from_outside(tensor):
                self._made[storage.data_ptr()] = storage, True

    def numbers(self, tensor: Tensor, kind: str, new: Callable[[int], int]) -> np.ndarray[Any, Any]:
        """The nodes of a tensor's entries, one for every place in memory."""
        places = self._places.setdefault((self._first(tensor), kind), {})
        flat, fresh = places_of(tensor).reshape(-1).tolist(), []
        for index, place in enumerate(flat):
            if place not in places:
                places[place] = new(self.count)
                self.count += 1
                fresh.append(index)
        if fresh:
            self._reads.append((tensor, np.array(fresh)))
            self._values.append(_read(tensor, self._reads[-1][1]))
        nodes = np.array([places[place] for place in flat], dtype=np.int64)
        return nodes.reshape(tensor.shape)

    def recipe(self) -> Recipe:
        """Return the recipe of the table, without operations that it does not need."""
        wanted = {id(t) for t, _ in self._reads} | {id(t) for t, _ in self._checks}
        operations, made = [], set[int]()
        for operation in reversed(self._operations):
            out = tensors(operation[3])
            if any(id(t) in wanted for t in out):
                operations.append(operation)
                wanted.update(id(t) for t in tensors(operation[1:3]))
                made.update(id(t) for t in out)
        operations.reverse()
        kept = [t for t, _ in self._reads] + [t for o in operations for t in tensors(o[1:3])]
        kept += [t for t, _ in self._checks]
        found = {id(t): t for t in kept if id(t) not in made and not self._made_inside(t)}
        numbers = [t for t in found.values() if t.is_floating_point()]
        if not self._repeats:  # memory was written to: once more would write twice
            numbers.append(torch.empty(0, dtype=torch.float64, device="cpu"))
        return Recipe(_joined(self._values), operations, self._reads, numbers, self._checks)

    def _made_inside(self, tensor: Tensor) -> bool:
        return not _in_memory(tensor) or self._made.get(address_of(tensor), (None, False))[1]

    def _forget(self, tensor: Tensor) -> None:
        """New numbers stand in this memory."""
        address = address_of(tensor)
        for key in [key for key in self._places if key[0] == address]:
            del self._places[key]
        self._results = {key: result for key, result in self._results.items() if result != address}
        self._same = {new: old for new, old in self._same.items() if address not in (new, old)}

    def _first(self, tensor: Tensor) -> int:
        """The storage of a tensor, or the earlier one that holds the same numbers."""
        return self._same.get(address_of(tensor), address_of(tensor))

    def _recognise(self, address: int, function: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> None:
        """Let what an operation returned be what it returned before, of the same arguments.

        Two of a kernel's methods that both scale the offsets of the centers then read the same numbers of
        the table, and what follows from them in a row is computed once.
        """
        key = function, self._description(args), self._description(tuple(kwargs.items()))
        try:
            first = self._results.setdefault(key, address)
        except TypeError:  # an argument that cannot be compared
            return
        if first != address:
            self._same[address] = first

    def _description(self, value: Any) -> Hashable:
        if isinstance(value, Tensor):
            if not _in_memory(value):
                return id(value)
            form = value.storage_offset(), value.stride(), value.shape, value.dtype
            return (self._first(value), version(value), *form)
        if isinstance(value, list | tuple):
            return tuple(map(self._description, value))
        return type(value), value  # 1, 1.0 and True are equal


def tensors(value: Any) -> list[Tensor]:
    """The tensors in nested lists, tuples and dictionaries."""
    if isinstance(value, Tensor):
        return [value]
    found: list[Tensor] = []
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, (list, tuple)):
        return found
    for part in value:
        if isinstance(part, Tensor):
            found.append(part)
        elif isinstance(part, (list, tuple, dict)):
            found += tensors(part)
    return found


def places_of(tensor: Tensor) -> np.ndarray[Any, Any]:
    """The places in memory of the entries."""
    at = np.full(tuple(tensor.shape), int(tensor.storage_offset()), dtype=np.int64)
    for axis, (size, stride) in enumerate(zip(tensor.shape, tensor.stride(), strict=True)):
        at += (np.arange(size) * stride).reshape([-1] + [1] * (tensor.dim() - axis - 1))
    return at


def _read(tensor: Tensor, at: np.ndarray[Any, Any]) -> Tensor:
    with _disable_current_modes():  # the tracer itself among them
        return tensor.detach().double().reshape(-1)[at].cpu()


def _joined(parts: Sequence[Tensor]) -> Tensor:
    return torch.cat(list(parts)) if parts else torch.zeros(0, dtype=torch.float64, device="cpu")


def address_of(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _in_memory(tensor: Tensor) -> bool:
    return tensor.numel() > 0 and not tensor._is_zerotensor()  # forward mode has zeros without memory


def _swapped(value: Any, known: Mapping[int, Tensor]) -> Any:
    if isinstance(value, Tensor):
        return known.get(id(value), value)
    if isinstance(value, list | tuple):
        return type(value)(_swapped(part, known) for part in value)
    if isinstance(value, dict):
        return {name: _swapped(part, known) for name, part in value.items()}
    return value


def _same(tensor: Tensor, value: Any) -> bool:
    if isinstance(value, list):
        return [tensor.tolist()] == value
    return tensor.numel() == 1 and bool(tensor.item() == value)
