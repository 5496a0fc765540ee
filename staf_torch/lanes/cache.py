"""The user's cache: libraries, and traces, so that what another process wrote down is not traced again.

A trace is pickled without the numbers of the step's tensors, which are given again when it is read. Reading
runs no code: classes are those of an allow-list, operations those of torch's own namespaces, and a file ends
with its digest. It spares a process .1 to .5 s a program; a library one to thirty seconds.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import io
import logging
import os
import pickle
import platform
import shutil
import stat
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from operator import is_
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .emit.tables import Text
from .lookups import is_users
from .row_numbers import RowNumbers
from .trace.captured_tensors import Recipe
from .trace.captured_tensors import tensors as tensors_of

try:
    import fcntl
except ImportError:  # no POSIX
    fcntl = None  # type: ignore[assignment]

_log = logging.getLogger(__name__)
LARGEST = 2**30
"""Bytes that the cache may hold: a trace is some 15 kilobytes, a library 30."""
_SCRATCH = tempfile.gettempprefix()  # of names under which a file is written at first
_BEGUN, _HOUR, _DAY = 1.0, 3600.0, 86_400.0
_LONGEST_UNUSED = 60 * _DAY
_temporary: dict[int, Path] = {}  # caches, by the process that made them
_FOLDER = Path(__file__).parent.parent
_DIGEST = 32
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
        content = path.read_bytes()
        used(path)
        if content[-_DIGEST:] != hashlib.sha256(content[:-_DIGEST]).digest():
            return None
        trace = Trace(*_TraceReader(io.BytesIO(zlib.decompress(content[:-_DIGEST])), tensors).load())
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
        content = zlib.compress(file.getvalue(), level=1)  # 100 kilobytes to 15
        # Under a name of its own first: another process may be writing the same.
        with scratch(path.parent) as folder:
            (folder / path.name).write_bytes(content + hashlib.sha256(content).digest())
            publish(folder / path.name, path)
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


def cache() -> Path:
    """Return the folder to which libraries and traces are written: in `XDG_CACHE_HOME`, else in ``~/.cache``.

    Where nothing may be written there, or somebody else may write, a folder that goes with the process.
    """
    folder = _home()
    if folder is None or not os.access(folder, os.W_OK):
        return _cache_of_the_process()
    _pruned(folder)
    return folder


def found(pattern: str) -> Iterator[Path]:
    """Yield the files of a name, or a pattern of names, that may be read from the caches, in their order."""
    for folder in filter(None, (_home(), _temporary.get(os.getpid()))):
        for path in sorted(folder.glob(pattern)):
            if not _refused(path):
                yield path


def _home() -> Path | None:
    """Return the user's own cache, None where there is none, or somebody else may write to it."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = Path(home if os.path.isabs(home) else Path.home() / ".cache") / "staf_torch"
        with contextlib.suppress(OSError):  # it may be there and not ours to write
            folder.mkdir(mode=_OURS, parents=True, exist_ok=True)
        return None if not folder.is_dir() or _refused(folder) else folder
    except (OSError, RuntimeError):  # a folder that may not be looked into, a user without a home
        return None


def _refused(path: Path) -> bool:
    """Return whether somebody but this user and root may have written a file or folder, and say so."""
    if not hasattr(os, "geteuid"):
        return False
    try:
        state = path.stat()
    except OSError:
        return True
    wrong = f"it belongs to user {state.st_uid}" if state.st_uid not in (os.geteuid(), 0) else ""
    if state.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        wrong = f"others than its owner may write to it (mode {stat.S_IMODE(state.st_mode):o})"
    if wrong and path not in _told:
        _told.add(path)
        told = "%s is not used, as machine code is run from there: %s. Remove it, or set XDG_CACHE_HOME"
        _log.warning(told, path, wrong)
    return bool(wrong)


_told: set[Path] = set()
_OURS = 0o755  # also where the user's umask lets a group write


@contextlib.contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """Context: a folder in a cache where a file is made; it is gone in the end, at the latest for `prune`.

    It is locked as long as this process lives: one that nobody locks was left by a process that was killed.
    """
    with tempfile.TemporaryDirectory(dir=folder) as place:
        lock = os.open(place, os.O_RDONLY)
        try:
            _lock(lock)
            yield Path(place)
        finally:
            os.close(lock)


def publish(made: Path, path: Path) -> None:
    """Give a file its name in the cache, where nobody else may write to it."""
    made.chmod(_OURS & (made.stat().st_mode | stat.S_IWUSR))
    os.replace(made, path)


def _lock(file: int) -> bool | None:
    """Lock an open file or folder: False where somebody else has, None where the file system cannot."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _left_over(path: Path, age: float) -> bool:
    """Return whether the process that made a scratch folder or file has been killed."""
    if not path.is_dir() or age < _BEGUN:
        return age > _HOUR
    file = os.open(path, os.O_RDONLY)
    try:
        free = _lock(file)
    finally:
        os.close(file)
    return age > _DAY if free is None else free


def used(path: Path) -> None:
    """Note that a file of the cache is in use now, which `prune` goes by."""
    with contextlib.suppress(OSError):  # there is none, or it belongs to somebody else
        os.utime(path)


def prune(folder: Path, *, now: float | None = None, largest: int = LARGEST) -> None:
    """Delete files of the cache that nobody has used for long, and the oldest while there are too many bytes.

    What was used within a day stays in any case: another process may be about to load it. A library that a
    process has loaded stays with that process. Names that this library did not give are left alone. What a
    compiler or a process has left that was killed goes at once.

    Args:
        folder: of the cache.
        now: in seconds; the present by default.
        largest: bytes that may stay.
    """
    now = time.time() if now is None else now
    found = list[tuple[float, int, Path]]()
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith((".so", ".cubin")) or entry.name.startswith(("trace-", _SCRATCH)):
                with contextlib.suppress(OSError):  # deleted by another process
                    state = entry.stat()
                    found.append((state.st_mtime, state.st_size, Path(entry.path)))
    kept = sum(size for _, size, _ in found)
    for last_use, size, path in sorted(found):
        unused = now - last_use
        if path.name.startswith(_SCRATCH):
            with contextlib.suppress(OSError):
                if not _left_over(path, unused):
                    continue
        elif unused <= _LONGEST_UNUSED and (unused <= _DAY or kept <= largest):
            continue
        kept -= size
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


@functools.cache
def _pruned(folder: Path) -> None:
    """Prune a cache once in a process."""
    try:
        prune(folder)
    except OSError as error:
        _log.debug("the cache %s was not pruned: %s", folder, error)


def _cache_of_the_process() -> Path:
    """Return a folder for this process alone, which is removed with it."""
    process = os.getpid()
    folder = _temporary.get(process)
    if folder is None or not folder.is_dir():  # somebody may have tidied up
        folder = _temporary[process] = Path(tempfile.mkdtemp(prefix="staf_torch-"))
        atexit.register(_remove, folder, process)
    return folder


def _remove(folder: Path, process: int) -> None:
    """Remove a folder where its process ends; a fork of it ends by itself."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


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
