"""Numbers of a row's own: a mass, a width, a gain that differs from row to row of a batch.

A tensor (B, ...) that `rows` has marked looks, to every function, like the number of one row, (...): code is
written for one plant and means B of them. What a function computes with it is `torch.func.vmap` over the
rows. Three readers give it a value. A program that is traced asks for one row's number and gets an input of
its own, a column (B, ...) of every call. Plain torch of an engine (`over_rows`) runs under one `vmap` over
the numbers and the rows of its inputs. Elsewhere, as in the constructor of a module, every operation is a
`vmap` by itself and returns numbers of rows again. To find the numbers by reading objects would miss what a
function looks up; they announce themselves.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map, tree_unflatten

from .tree import Shared, Tree, flatten, unflatten

Some = TypeVar("Some")
Resolve = Callable[["RowNumbers"], Tensor]
_active, _first = threading.local(), threading.Lock()
_STRUCTURE_NAMES = """dim ndimension size numel nelement is_floating_point is_complex is_signed stride
    element_size
    __len__ is_contiguous storage_offset get_device type is_pinned is_inference is_conj is_neg"""
_STRUCTURE = frozenset(_STRUCTURE_NAMES.split())
"""Methods that answer alike for all rows."""
_ATTRIBUTES_NAMES = """shape dtype device layout ndim itemsize nbytes is_cpu is_cuda is_meta is_sparse
    is_quantized
    is_nested is_mkldnn is_mps is_xpu names _version"""
_ATTRIBUTES = frozenset(_ATTRIBUTES_NAMES.split())
_OF_ALL = frozenset(["requires_grad", "grad", "grad_fn", "is_leaf", "retains_grad", "output_nr"])
"""Attributes of the numbers of all rows together."""
_READS_NAMES = """__bool__ __float__ __int__ __index__ __complex__ __contains__ item tolist numpy __array__
    equal
    allclose is_nonzero data_ptr"""
_READS = frozenset(_READS_NAMES.split())
_MAKES = ("tensor", "as_tensor", "asarray")  # of numbers, also those of tensors in lists
_ENTRYWISE = frozenset(f"aten::{name}" for name in ("_to_copy", "detach", "clone", "alias", "lift_fresh"))


class RowsMetError(BaseException):  # no handler of errors in a user's code is meant
    """The signal that a function read numbers of rows where nobody had said whose."""

    def __init__(self, numbers: RowNumbers) -> None:
        super().__init__()
        self.numbers = numbers


class RowNumbers(Tensor):
    """A tensor of which every row of a batch has its own entry; `rows` makes it."""

    full: Tensor
    made = False  # whether a process has any
    prepare: ClassVar[list[Callable[[], None]]] = []  # called before the first is made

    @staticmethod
    def __new__(cls, full: Tensor) -> RowNumbers:
        if not RowNumbers.made:
            with _first:
                for each in RowNumbers.prepare if not RowNumbers.made else ():
                    each()
                RowNumbers.made = True
        one = full.detach()[0]
        numbers: RowNumbers = Tensor._make_wrapper_subclass(
            cls, one.shape, strides=one.stride(), dtype=full.dtype, device=full.device, requires_grad=False
        )
        numbers.full = full
        return numbers

    @classmethod
    def __torch_function__(
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        resolve: Resolve | None = getattr(_active, "resolve", None)
        if resolve is None or (resolve is refuse and _asks_structure(func)):
            return _operation(func, args, kwargs)
        if kwargs or any(isinstance(x, list | tuple) for x in args):
            args, kwargs = tree_map(lambda x: resolve(x) if isinstance(x, RowNumbers) else x, (args, kwargs))
            return func(*args, **kwargs)
        return func(*[resolve(x) if isinstance(x, RowNumbers) else x for x in args])

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _below(func, args, kwargs or {})

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"rows({self.full!r})"

    def __format__(self, form: str) -> str:
        resolve: Resolve | None = getattr(_active, "resolve", None)
        if resolve is None or not (form or resolve is not refuse):
            return repr(self)
        return format(resolve(self), form)

    def __deepcopy__(self, memo: dict[int, Any]) -> RowNumbers:
        if id(self) not in memo:
            memo[id(self)] = RowNumbers(copy.deepcopy(self.full, memo))
        copied: RowNumbers = memo[id(self)]
        return copied

    def __reduce_ex__(self, protocol: Any) -> Any:
        return RowNumbers, (self.full,)


def _tried() -> bool:
    return getattr(_active, "resolve", None) is refuse


def in_use() -> bool:
    """Return whether numbers of rows may be met where nobody has said whose."""
    return RowNumbers.made and getattr(_active, "resolve", None) is None


def anybodys() -> bool:
    """Return whether nobody has said whose numbers of rows are meant, nor of which rows a batch consists."""
    return getattr(_active, "resolve", None) is None and getattr(_active, "chosen", None) is None


def nonzero(number: Any) -> bool:
    """Return whether a number is not 0; numbers of rows count as such, as a row may have another."""
    return isinstance(number, RowNumbers) or bool(number)


def all_rows(tensor: Tensor) -> Tensor:
    """Return the memory of a tensor: (B, ...) of numbers of rows, itself of others."""
    return tensor.full if isinstance(tensor, RowNumbers) else tensor


def value_of(tensor: Tensor) -> Tensor:
    """Return the number of the row whose turn it is: for transforms of `torch.func`, which do not look."""
    resolve: Resolve | None = getattr(_active, "resolve", None)
    return tensor if resolve is None or not isinstance(tensor, RowNumbers) else resolve(tensor)


@contextmanager
def resolving(resolve: Resolve | None) -> Iterator[None]:
    """Numbers of rows have, within the block and on this thread, the value that ``resolve`` gives them.

    With None what follows from them is numbers of rows, too, for a decision that all rows share.
    """
    before, _active.resolve = getattr(_active, "resolve", None), resolve
    try:
        yield
    finally:
        _active.resolve = before


@contextmanager
def some_rows(chosen: Tensor | None) -> Iterator[None]:
    """Batches of the block hold these rows (R,) of those that numbers were given for, in this order.

    With None they hold all of them, whatever was chosen outside.
    """
    if not RowNumbers.made:  # nor does `points_of_rows` choose any: inside it are more rows than outside
        yield
        return
    before = getattr(_active, "chosen", None)
    _active.chosen = chosen if before is None or chosen is None else before[chosen.to(before.device)]
    try:
        yield
    finally:
        _active.chosen = before


@contextmanager
def points_of_rows(count: int, points: int) -> Iterator[None]:
    """Batches of the block hold so many points of each of ``count`` rows, row after row."""
    if not RowNumbers.made:
        yield
        return
    before = getattr(_active, "whole", None)
    if getattr(_active, "chosen", None) is None:
        _active.whole = count
    try:
        with some_rows(torch.arange(count, device="cpu").repeat_interleave(points)):
            yield
    finally:
        _active.whole = before


def columns(numbers: Sequence[RowNumbers], count: int | None) -> list[Tensor]:
    """Return the numbers (B, ...) of the rows of a batch, of ``count`` rows where it is stated.

    Raises:
        ValueError: if the batch has another number of rows.
    """
    chosen = getattr(_active, "chosen", None)
    whole: int | None = None if chosen is None else getattr(_active, "whole", None)
    for each in numbers:
        if whole is not None and len(each.full) != whole:
            raise _other_count(each.full, whole)
    found = [each.full if chosen is None else each.full[chosen] for each in numbers]
    for each, column in zip(numbers, found, strict=True):
        if count is not None and len(column) != count:
            if _tried():  # somebody outside knows better whose the numbers are
                raise RowsMetError(each)
            raise _other_count(column, count)
    return found


def over_rows(function: Callable[..., Some], *given: Tree) -> Some:
    """function(*given), trees (B, ...) to (B, ...) or of `Shared` tensors, where the function may read
    numbers of a row's own, and no row sees another.

    It runs once with all rows where it meets none. Else it runs under `torch.func.vmap`, each row with its
    own numbers and a batch of one; row by row where it decides by values.
    """
    if not RowNumbers.made or (getattr(_active, "resolve", None) is not None and not _tried()):
        return function(*given)  # there are none, or somebody outside has said whose
    try:
        with resolving(refuse):
            found = function(*given)
    except RowsMetError as met:
        return _mapped(function, given, met.numbers)
    if any(isinstance(leaf, RowNumbers) for leaf in flatten(found)[0]):
        raise ValueError(
            "numbers of `rows(...)` were read in another thread than the call's, where no row is chosen: "
            "compute with them in the thread that calls the function."
        )
    return found


def column_of(count: int) -> Callable[[RowNumbers], Tensor]:
    """Return what gives the numbers (B, ...) of so many rows, whatever rows are chosen later."""
    chosen = getattr(_active, "chosen", None)

    def column(numbers: RowNumbers) -> Tensor:
        found = numbers.full if chosen is None else numbers.full[chosen]
        if len(found) != count:
            raise _other_count(found, count)
        return found

    return column


def over_some_rows(function: Callable[..., Some], chosen: Tensor, *given: Tree) -> Some:
    """function(*given) as of `over_rows`, where ``given`` is of these rows (R,) of all."""
    with some_rows(chosen):
        return over_rows(function, *given)


def one_by_one() -> int:
    """Return how many rows run one after the other here, as they decide by values; else 1."""
    apart: int = getattr(_active, "apart", 1)
    return apart


def refuse(numbers: RowNumbers) -> Tensor:
    raise RowsMetError(numbers)


def _mapped(function: Callable[..., Some], given: tuple[Tree, ...], met: RowNumbers) -> Some:
    leaves, structure = flatten(given)
    own = [leaf for leaf in leaves if not isinstance(leaf, Shared)]
    count = len(own[0]) if own else len(columns([met], None)[0])
    columns([met], count)
    column = column_of(count)  # whatever rows the function chooses
    where = own[0].device if own else met.device  # numbers of rows follow the points
    indices, shape = torch.arange(count, device=where), None

    def one(index: Tensor, *parts: Tensor) -> tuple[Tensor, ...]:
        nonlocal shape
        rest = iter(parts)
        alone = [leaf if isinstance(leaf, Shared) else next(rest).unsqueeze(0) for leaf in leaves]
        known: dict[int, Tensor] = {}

        def resolve(numbers: RowNumbers) -> Tensor:
            if id(numbers) not in known:
                known[id(numbers)] = column(numbers).to(where)[index]
            return known[id(numbers)]

        with resolving(resolve):
            ends, shape = flatten(function(*unflatten(structure, iter(alone))))
        return tuple(end.squeeze(0) for end in ends)

    found = _at_once(lambda: torch.func.vmap(one, randomness="different")(indices, *own))
    if found is None:
        each, before = [], one_by_one()
        _active.apart = before * count
        try:
            for index in indices:
                with some_rows(index.view(1)):  # of compiled calls inside
                    each.append(one(index, *(leaf[int(index)] for leaf in own)))
        finally:
            _active.apart = before
        found = tuple(torch.stack(column) for column in zip(*each, strict=True))
    some: Some = unflatten(shape, iter(found))
    return some


def _at_once(mapped: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...] | None:
    """Return mapped(); None where a function reads values, but for those that `torch.tensor` makes one of."""
    for inside in (contextlib.nullcontext(), _Makes()):
        try:
            with inside:
                return mapped()
        except (RuntimeError, ValueError) as error:
            if not _decides(error):
                raise
    return None


class _Makes(TorchFunctionMode):
    """Context in which `torch.tensor([a, 1.0])` of a row's number a is a stack, as it is in compiled code."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        made = made_of_list(func, args, kwargs or {})
        return func(*args, **(kwargs or {})) if made is None else made


def made_of_list(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Tensor | None:
    """Return what `torch.tensor` makes of lists with tensors, by operations; None of another function."""
    if getattr(func, "__name__", "") not in _MAKES or not args or not isinstance(args[0], list | tuple):
        return None
    leaves = tree_flatten(args[0])[0]
    held = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    if not held:
        return None
    dtypes = (torch.as_tensor(x, device=getattr(x, "device", "cpu")).dtype for x in leaves)
    dtype = kwargs.get("dtype") or functools.reduce(torch.promote_types, dtypes)
    device = next((leaf.device for leaf in held if leaf.device.type != "cpu"), held[0].device)
    return torch.as_tensor(_stacked(args[0], dtype, device), device=kwargs.get("device"))


def _stacked(parts: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return nested lists of numbers and tensors as a tensor, of which operations are seen."""
    if isinstance(parts, list | tuple):
        return torch.stack([_stacked(part, dtype, device) for part in parts])
    if isinstance(parts, Tensor):
        return parts.to(device, dtype)
    return torch.as_tensor(parts, dtype=dtype, device=device)


def _decides(error: Exception) -> bool:
    """Return whether a function read a value under `vmap`, which its rows alone may do."""
    text = str(error)
    if "storage of BatchedTensorImpl" in text or "data pointer of Tensor that doesn't have storage" in text:
        return True  # a Python number or an array of NumPy is wanted
    signs = ("data-dependent", ".item()", "dynamic shape", "as under `torch.func.vmap`")
    return "vmap" in text and any(sign in text for sign in signs)


def _operation(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Apply an operation to numbers of rows outside of a batch; the result is numbers of rows, too."""
    name = getattr(func, "__name__", "")
    if (
        args
        and isinstance(args[0], RowNumbers)
        and (name in _STRUCTURE or (name == "__get__" and func.__self__.__name__ in _ATTRIBUTES))
    ):
        return func(args[0].full.detach()[0], *args[1:], **kwargs)
    leaves, spec = tree_flatten((args, kwargs))
    at = [k for k, leaf in enumerate(leaves) if isinstance(leaf, RowNumbers)]
    full = [leaves[k].full for k in at]
    if name in ("__get__", "__set__"):
        attribute = func.__self__.__name__
        if attribute == "data":
            return RowNumbers(full[0].data) if name == "__get__" else setattr(args[0], "full", full[-1])
        if attribute in _OF_ALL or name == "__set__":
            return func(full[0], *args[1:])
    if name == "_has_compatible_shallow_copy_type":  # a module makes a new parameter then
        return False
    if name in _READS:
        raise _no_single_value(f"Tensor.{name}")
    if name == "requires_grad_":
        full[0].requires_grad_(*args[1:], **kwargs)
        return leaves[at[0]]
    counts = {len(column) for column in full}
    if len(counts) > 1:
        raise ValueError(
            f"`rows(...)` of {' and '.join(map(str, sorted(counts)))} rows meet in `{name}`: "
            "all must have as many rows."
        )

    def one(*parts: Tensor) -> Any:
        inside = list(leaves)
        for k, part in zip(at, parts, strict=True):
            inside[k] = part
        positional, named = tree_unflatten(inside, spec)
        return func(*positional, **named)

    found = torch.func.vmap(one, randomness="different")(*full)
    return tree_map(lambda x: RowNumbers(x) if isinstance(x, Tensor) else x, found)


def _asks_structure(func: Any) -> bool:
    """Return whether a function of torch answers alike for all rows."""
    name = getattr(func, "__name__", "")
    return name in _STRUCTURE or (name == "__get__" and func.__self__.__name__ in _ATTRIBUTES | _OF_ALL)


def _below(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Apply an operation that no Python function of torch has seen (`torch.as_tensor`), without `vmap`."""
    resolve: Resolve | None = getattr(_active, "resolve", None)
    if resolve is not None:
        args, kwargs = tree_map(lambda x: resolve(x) if isinstance(x, RowNumbers) else x, (args, kwargs))
        return func(*args, **kwargs)
    if func._schema.name in _ENTRYWISE:
        return RowNumbers(func(args[0].full, *args[1:], **kwargs))
    leaves, spec = tree_flatten((args, kwargs))
    count = next(len(leaf.full) for leaf in leaves if isinstance(leaf, RowNumbers))
    each = []
    for k in range(count):
        inside = [leaf.full[k] if isinstance(leaf, RowNumbers) else leaf for leaf in leaves]
        positional, named = tree_unflatten(inside, spec)
        each.append(func(*positional, **named))
    if isinstance(each[0], Tensor):
        return RowNumbers(torch.stack(each))
    if any(one != each[0] for one in each):
        raise _no_single_value(func._schema.name)
    return each[0]


def _no_single_value(name: str) -> ValueError:
    return ValueError(
        f"`{name}` of `rows(...)`: a number that differs from row to row has no single value; "
        "compute with it in torch, or read `.full`, (B, ...)."
    )


def _other_count(column: Tensor, count: int) -> ValueError:
    return ValueError(
        f"a batch of {count} rows met `rows(...)` of {len(column)} rows: both must have as many rows."
    )
