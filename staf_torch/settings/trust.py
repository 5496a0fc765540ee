"""What settings of unknown origin may build: the library's own parts, of plain arguments, of modest size.

`instantiate` calls whatever `_target_` names, and interpolations can hide the name. So the settings of a run
that is loaded are resolved here first, by references alone, and only then looked at.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import inspect
import math
import re
import resource
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

from .. import adp, kernels, optim, systems, targets
from .._renamed import new_name
from ..adp import ActorCriticLaw, Controller, Cost, Extrapolation, Gains, ValueBasis
from ..engine import predictors
from ..engine.predictors import Predictor
from ..kernels import Kernel
from ..optim import UpdateLaw
from ..results.settings_file import SettingsFile
from ..systems import ControlAffineSystem
from . import config_directory

_TARGET = re.compile(r"_target_: *(staf_torch\.[\w.]+)")
_NOT_PARTS = (
    "staf_torch.settings.chase.load",  # imports what it is told
    "staf_torch.systems.MujocoPlant",  # reads any file, by a parser that no limit here can stop
    "staf_torch.sweeps.",  # end of runs
)
_REFERENCE = re.compile(r"\$\{([A-Za-z_][\w.]*)\}")
_MOST_NODES, _MOST_TEXT, _DEEPEST = 20_000, 1000, 30
_SIZES: Mapping[str, float] = {
    **dict.fromkeys(("seed", "duration", "settle_time"), math.inf),
    **dict.fromkeys(("trajectories", "inner_steps", "record_every"), 1e6),
}
_MOST_STEPS = 1e7  # of a trajectory
_SIZE = 1000  # of any other whole number: counts of centers, orders, degrees, points
_MOST_ENTRIES = 1000  # of a list
_MEMORY, _SECONDS = 256 * 2**20, 4.0  # of building, beyond what the process had
_LOOK = 0.05  # s between two looks at the time of another thread
_SPECIAL = {"_target_", "_partial_", "_convert_", "_recursive_"}


@functools.cache
def constructors() -> frozenset[str]:
    """Return the dotted paths that settings may name without trust: parts that are made of plain values.

    They are what the package's own `conf/` names, and the other classes of the same kinds.
    """
    kinds = (
        *(Kernel, UpdateLaw, ControlAffineSystem, Predictor),
        *(ActorCriticLaw, Controller, Cost, Extrapolation, Gains, ValueBasis, adp.LQR, adp.RolloutPolicy),
        *(targets.Paper, targets.Quadratic, targets.Cosine),
    )
    rooms = {
        **dict.fromkeys(("staf_torch.kernels", "staf_torch"), kernels),
        "staf_torch.optim": optim,
        "staf_torch.systems": systems,
        "staf_torch.targets": targets,
        "staf_torch.adp": adp,
        **dict.fromkeys(("staf_torch.predictors", "staf_torch.engine.predictors"), predictors),
    }
    found = {
        target
        for path in Path(config_directory()).rglob("*.yaml")
        for target in _TARGET.findall(path.read_text(encoding="utf-8"))
        if not target.startswith(_NOT_PARTS)
    }
    for room, module in rooms.items():
        for name, part in vars(module).items():
            if inspect.isclass(part) and issubclass(part, kinds) and not inspect.isabstract(part):
                found |= {f"{room}.{name}", f"{part.__module__}.{name}"}
    return frozenset(found)


def checked(settings: SettingsFile, place: str) -> dict[str, Any]:
    """Return the settings of a run, resolved, if they build nothing but `constructors` of modest size.

    Args:
        settings: as they are in the file.
        place: of the file, for the message.

    Raises:
        ValueError: if they ask for more; the message shows the line.
    """

    def refuse(key: str, why: str) -> ValueError:
        line = settings.line(key)
        return ValueError(f"{place}:{line}\n  {why}: add --trust if you know who wrote these settings.")

    tree = _Resolved(settings.tree, refuse).tree
    if not isinstance(tree, dict):
        raise refuse("", "must be settings by name")
    for key, value in _leaves(tree):
        name = key.rpartition(".")[2]
        if name == "_target_" and value is not None and not _ours(value):
            raise refuse(key, f"names {value!r}, which may run code of somebody else")
        if name.startswith("_") and name.endswith("_") and name not in _SPECIAL:
            raise refuse(key, f"has {name}, which the library never writes")
        if isinstance(value, list) and len(value) > _MOST_ENTRIES:
            raise refuse(key, f"lists {len(value)} entries, and {_MOST_ENTRIES} are the most")
        most = _SIZES.get(name, _SIZE if isinstance(value, int) else math.inf)
        if isinstance(value, int | float) and not isinstance(value, bool) and not abs(value) <= most:
            raise refuse(key, f"asks for {value!r}, and {most:g} is the most")
    duration, dt = tree.get("duration"), tree.get("dt")
    steps = duration / dt if isinstance(duration, int | float) and isinstance(dt, int | float) and dt else 0
    if not abs(steps) <= _MOST_STEPS:
        raise refuse("dt", f"asks for {steps:.3g} steps, and {_MOST_STEPS:g} are the most")
    return tree


def _ours(target: object) -> bool:
    named = str(target)
    return named in constructors() or new_name(named) in constructors()


class _Resolved:
    """A tree of settings in which `${a.b}` is replaced by the value of that key, and nothing else happens."""

    def __init__(self, tree: Any, refuse: Any) -> None:
        self._root, self._refuse, self._left = tree, refuse, _MOST_NODES
        self.tree = self._of(tree, "", 0)

    def _of(self, value: Any, key: str, depth: int) -> Any:
        self._left -= 1
        if self._left < 0 or depth > _DEEPEST:
            raise self._refuse(key, "grows without end when its references are followed")
        prefix = f"{key}." if key else ""
        if isinstance(value, dict):
            if any("$" in str(name) for name in value):
                raise self._refuse(key, "has an interpolation for a name")
            return {name: self._of(inner, f"{prefix}{name}", depth + 1) for name, inner in value.items()}
        if isinstance(value, list):
            return [self._of(inner, f"{prefix}{n}", depth + 1) for n, inner in enumerate(value)]
        if not isinstance(value, str):
            return value
        if "$" not in value:
            if len(value) > _MOST_TEXT:
                raise self._refuse(
                    key, f"is a text of {len(value)} characters, and {_MOST_TEXT} are the most"
                )
            return value
        named = _REFERENCE.fullmatch(value)
        if named is None:
            raise self._refuse(key, "has an interpolation that is no plain reference")
        return self._of(self._at(named[1], key), key, depth + 1)

    def _at(self, path: str, key: str) -> Any:
        found = self._root
        for part in path.split("."):
            if not isinstance(found, dict) or part not in found:
                raise self._refuse(key, f"refers to {path}, which there is not")
            found = found[part]
        return found


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Every value with its dotted key; lists as a whole, and then each of their entries."""
    prefix = f"{key}." if key else ""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, f"{prefix}{name}")
        return
    yield key, value
    if isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _leaves(inner, f"{prefix}{number}")


@contextlib.contextmanager
def limited(what: str) -> Iterator[None]:
    """Let what is built here take a quarter of a gigabyte and four seconds of CPU time at most.

    Sizes multiply in more ways than `checked` knows. Memory is limited on Linux alone, and time while Python
    code runs: a single call of a library in C ends first.

    Raises:
        ValueError: where that is exceeded.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    most = _data_bytes() + _MEMORY
    main = threading.current_thread() is threading.main_thread()
    try:
        if most > _MEMORY:
            resource.setrlimit(resource.RLIMIT_DATA, (most if hard < 0 else min(most, hard), hard))
        with _stopped_by_signal() if main else _stopped_by_thread():
            yield
    except _TooLongError as error:
        raise ValueError(f"{what} takes more than {_SECONDS:g} s to build: add --trust to wait.") from error
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "memory" in str(error):
            raise ValueError(
                f"{what} takes more memory to build than {_MEMORY} bytes: add --trust."
            ) from error
        raise
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


class _TooLongError(Exception):
    """The time is over."""


@contextlib.contextmanager
def _stopped_by_signal() -> Iterator[None]:
    """Raise `_TooLongError` in the main thread when the process has used its time."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise _TooLongError

    before = signal.signal(signal.SIGPROF, stop)
    try:
        signal.setitimer(signal.ITIMER_PROF, _SECONDS)
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@contextlib.contextmanager
def _stopped_by_thread() -> Iterator[None]:
    """Raise `_TooLongError` in a thread that is not the main one and gets no signals; a third one watches."""
    watched = threading.get_ident()
    clock = time.pthread_getcpuclockid(watched)
    until = time.clock_gettime(clock) + _SECONDS
    ended, lock = threading.Event(), threading.Lock()

    def watch() -> None:
        while not ended.wait(_LOOK):
            with lock:
                if not ended.is_set() and time.clock_gettime(clock) > until:
                    raised = ctypes.py_object(_TooLongError)
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(watched), raised)
                    return

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    finally:
        with lock:  # from here on nothing is raised that has not been
            ended.set()


def _data_bytes() -> int:
    """Memory of this process that counts against RLIMIT_DATA; 0 where that cannot be told."""
    with contextlib.suppress(OSError), open("/proc/self/status", encoding="utf-8") as lines:
        for line in lines:
            if line.startswith("VmData:"):
                return int(line.split()[1]) * 1024
    return 0
