"""Texts of a step, C++ for the processor or a kernel for a device, and what is built of them.

Traces in the user's cache, so that what another process wrote down is not traced again.

A trace is pickled without the numbers of the step's tensors, which are given again when it is read. Reading
runs no code: classes are those of an allow-list, operations those of torch's own namespaces, and a file ends
with its digest. It spares a process .1 to .5 s a program.
"""

from __future__ import annotations

import functools
import hashlib
import io
import pickle
import platform
import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from operator import is_
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .adjoint.carries import carried
from .adjoint.steps import ReversedStep
from .calls.inputs import Given
from .calls.planned_call import Compiled
from .compilation.cache import cache, found, keep, kept
from .compilation.compiler import REVERSED
from .dependencies.contents import Contents
from .dependencies.walk import is_users
from .emit.cpp import emit
from .emit.cuda import Dtypes, emit_cuda
from .emit.tables import Text
from .row_numbers import RowNumbers
from .trace.captured_tensors import Recipe
from .trace.captured_tensors import tensors as tensors_of
from .trace.step import Step, Traced, trace
from .trace.tracer import NotLoweredError
from .tree import plain

Form = int | torch.device
"""Of compiled code: how many vectors of rows advance side by side, or the device whose kernel it is."""


class Built(NamedTuple):
    """The record of a program that was built."""

    compiled: Compiled
    trace: Trace  # from which it was made
    followed: bool = False  # whether the trace is of the program that this one follows

    @classmethod
    def of(cls, made: Trace, call: Any, given: Given) -> Built:
        """Return the record of a trace and of the code of its text, for the numbers that it was made with."""
        table = made.text.numbers(made.recipe.values, made.real)
        shapes = tuple((leaf.shape[1:], leaf.dtype) for leaf in given.carry)
        return cls(Compiled(call, table, made.real, shapes, made.outputs, made.structure, made.rows), made)

    def with_others(
        self, others: Mapping[int, Tensor], in_place_of: Callable[[Tensor], Tensor]
    ) -> Built | None:
        """Return the built code with a table of the numbers of other tensors, None where its text differs."""
        numbers = self.trace.recipe.again(others)
        if numbers is None:
            return None
        table = self.trace.text.numbers(numbers, self.compiled.real)
        given = [in_place_of(each) for each in self.trace.rows]
        rows = tuple(each for each in given if isinstance(each, RowNumbers))
        if len(rows) < len(given):
            return None
        return self._replace(compiled=self.compiled._replace(table=table, rows=rows))


def known(step: Step, described: tuple[bytes, Sequence[Tensor]] | None, given: Given, form: Form) -> Trace:
    """Return the trace of a step with a single row, from the cache where it has been traced before."""
    shapes = None if described is None else Contents(given.key()).signature()
    if described is None or shapes is None or not unpatched():
        return written(step, given, form)
    by, tensors = described
    path = place(by, shapes, form)
    found = load(path, tensors)
    if found is None:
        found = written(step, given, form)
        save(path, found, tensors)
    return found


def written(step: Step, given: Given, form: Form) -> Trace:
    """Return the trace of a step with a single row."""
    real = given.real
    if not isinstance(form, int):
        traced = _traced(step, given)
        return _record(kernel(traced, given), traced, real)
    try:
        traced = _traced(step, given)
        text = emit(*traced.program, form)
    except NotLoweredError:
        if real == torch.float64:
            raise
        # float64 within a program of float32: all of it in double, rounded where it ends.
        real, traced = torch.float64, _traced(step, given, widened=True)
        text = emit(*traced.program, form)
    if isinstance(step, ReversedStep):
        text = text._replace(source=f"{REVERSED}\n{text.source}")
    return _record(text, traced, real)


def _traced(step: Step, given: Given, *, widened: bool = False) -> Traced:
    if isinstance(step, ReversedStep):
        return step.traced(given, widened=widened)
    return trace(step, given, widened=widened)


def _record(text: Text, traced: Traced, real: torch.dtype) -> Trace:
    graph, _, following, outputs = traced.program
    times, where = graph.slots("now", [*following, *outputs]), carried(*traced.program)
    return Trace(text, traced.recipe, real, traced.outputs, traced.structure, traced.rows, times, where)


def kernel(traced: Traced, given: Given) -> Text:
    rows = [*(plain(leaf).dtype for leaf in given.row), *(numbers.dtype for numbers in traced.rows)]
    nows, carries = ([plain(leaf).dtype for leaf in leaves] for leaves in (given.now, given.carry))
    return emit_cuda(*traced.program, Dtypes(rows, nows, carries, [dtype for _, dtype in traced.outputs]))


_FOLDER = Path(__file__).parents[1]  # of the package
_NUMPY = [(f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")]
_NUMPY += [(f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")]
_ALLOWED = {("torch", "Size"), ("torch", "device"), ("numpy", "dtype"), ("numpy", "ndarray"), *_NUMPY}
_ALLOWED |= {("builtins", name) for name in ("slice", "tuple", "complex")}
_NAMED = (torch.dtype, torch.memory_format, torch.layout)
_NAMESPACES = ("aten", "prims")
_DAMAGED = (
    OSError,
    pickle.UnpicklingError,
    AttributeError,
    EOFError,
    LookupError,
    ValueError,
    TypeError,
    zlib.error,
)


class Trace(NamedTuple):
    """The record of a traced step."""

    text: Text
    recipe: Recipe
    real: torch.dtype
    outputs: tuple[tuple[torch.Size, torch.dtype], ...]
    structure: Any
    rows: tuple[RowNumbers, ...]
    times: tuple[int, ...]  # inputs of a time that anything depends on
    carried: tuple[tuple[str, int], ...]  # of every leaf of the carry: where else its numbers are


def place(*described: object) -> Path:
    """Return the file of a trace, by all that it depends on beside this package, torch and Python."""
    around = _package(), torch.__version__, platform.python_version(), str(torch.get_default_dtype())
    digest = hashlib.sha256(repr((*around, *described)).encode()).hexdigest()
    return cache() / f"trace-{digest[:24]}"


def load(path: Path, tensors: Sequence[Tensor]) -> Trace | None:
    """Return a trace with the numbers that follow from other tensors, as `save` had them; None without."""
    try:
        path = next(found(path.name), path)
        content = kept(path)
        if content is None:
            return None
        trace = Trace(*_TraceReader(io.BytesIO(zlib.decompress(content)), tensors).load())
    except _DAMAGED:
        return None
    numbers = trace.recipe.again({id(tensor): tensor for tensor in tensors})
    return None if numbers is None else trace._replace(recipe=trace.recipe._replace(values=numbers))


def save(path: Path, trace: Trace, tensors: Sequence[Tensor]) -> None:
    """Write a trace, unless its numbers follow from more than these tensors."""
    places = {id(tensor): k for k, tensor in enumerate(tensors)}
    if any(id(tensor) not in places for tensor in (*trace.recipe.found, *trace.rows)):
        return
    file = io.BytesIO()
    try:
        numberless = trace.recipe._replace(values=torch.empty(0, dtype=torch.float64, device="cpu"))
        _TraceWriter(file, places, numberless).dump(tuple(trace._replace(recipe=numberless)))
        keep(path, zlib.compress(file.getvalue(), level=1))  # 100 kilobytes to 15
    except (OSError, pickle.PicklingError, TypeError, AttributeError):
        return  # it is traced again another time


@functools.cache
def _package() -> str:
    """A digest of the source of this package."""
    digest = hashlib.sha256()
    for path in sorted(_FOLDER.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


class _TraceWriter(pickle.Pickler):
    """Writes tensors of the step as their numbers, those that follow from them by the order they came in."""

    def __init__(self, file: io.BytesIO, places: dict[int, int], recipe: Recipe) -> None:
        super().__init__(file, protocol=5)
        self._places = places
        made = [tensor for operation in recipe.operations for tensor in tensors_of(operation[3])]
        self._made = {id(tensor): k for k, tensor in enumerate(made)}

    def persistent_id(self, value: Any) -> Any:
        if isinstance(value, torch._ops.OpOverload):
            return "operation", value._schema.name, value._overloadname
        if isinstance(
            value, _NAMED
        ):  # pickle names the first module that has imported torch, perhaps a user's
            return "named", str(value).removeprefix("torch.")
        if not isinstance(value, Tensor):
            return None
        if id(value) in self._places:
            return "given", self._places[id(value)]
        if id(value) in self._made:
            return "made", self._made[id(value)]
        return "value", value.detach().cpu().numpy().copy(), str(value.device)


class _TraceReader(pickle.Unpickler):
    """Reads what `_TraceWriter` writes, and refuses every other class or function: a file is no program."""

    def __init__(self, file: io.BytesIO, tensors: Sequence[Tensor]) -> None:
        super().__init__(file)
        self._given, self._made = tensors, dict[int, Tensor]()

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return super().find_class(module, name)
        there: Any = sys.modules.get(module)  # nothing is imported here
        for part in name.split("."):
            there = getattr(there, part, None)
        if module.partition(".")[0] == _FOLDER.name and isinstance(there, type) and issubclass(there, tuple):
            return there  # named tuples, which structures of outputs are
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed in a cached trace")

    def persistent_load(self, name: Any) -> Any:
        kind, value = name[0], name[1]
        if kind == "operation":
            namespace, _, operation = value.partition("::")
            if namespace not in _NAMESPACES:
                raise pickle.UnpicklingError(f"operations of {namespace} are not allowed in a cached trace")
            packet = getattr(getattr(torch.ops, namespace), operation)
            return getattr(packet, name[2] or "default")
        if kind == "named":
            there = getattr(torch, value, None)
            if not isinstance(there, _NAMED):
                raise pickle.UnpicklingError(f"torch.{value} is not allowed in a cached trace")
            return there
        if kind == "given":
            return self._given[value]
        if kind == "made":  # stands for what the operation will make: its identity alone matters
            return self._made.setdefault(value, torch.empty(0, dtype=torch.float64, device="cpu"))
        return torch.from_numpy(value).to(name[2])


def unpatched() -> bool:
    """Return whether no function of a user, nor a mock, stands in a module or class of this package.

    No other process sees what was put there (`kernels.GaussianKernel.core = mine`), so that nothing may be
    read from the cache or written to it.
    """
    global _last
    spaces = list[Mapping[str, Any]]()
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] == _FOLDER.name:
            spaces.append(vars(module))
            kinds = (value for value in vars(module).values() if isinstance(value, type))
            spaces += [vars(kind) for kind in kinds if kind.__module__ == name]
    values = [*chain.from_iterable(space.values() for space in spaces)]
    seen, own = _last
    if len(values) != len(seen) or not all(
        map(is_, values, seen)
    ):  # looked at again only if something is new
        known = {id(value) for value in seen} if own else set[int]()  # all alive, as `seen` holds them
        own = not any(_foreign(value) for value in values if id(value) not in known)
        _last = values, own
    return own


_last: tuple[list[Any], bool] = [], True


def _foreign(value: Any) -> bool:
    while isinstance(value, property | staticmethod | classmethod | functools.partial):
        inner = (getattr(value, name, None) for name in ("fget", "__func__", "func"))
        value = next(filter(None, inner), None)
    if isinstance(value, FunctionType):
        return is_users(value)
    return type(value).__module__.partition(".")[0] == "unittest"
