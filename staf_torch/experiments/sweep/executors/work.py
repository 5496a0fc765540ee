"""One tensor batch: what a worker does, in this process or in another."""

from __future__ import annotations

import contextlib
import logging
import pickle
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig


class Batch(NamedTuple):
    """The jobs of a tensor batch."""

    settings: list[DictConfig]
    directories: list[str]  # of the runs


class Done(NamedTuple):
    """A tensor batch that was computed."""

    outcomes: list[Any]  # one a job: `members.Solved`, `Written`, or the exception that it ended with
    seconds: float


class Written(NamedTuple):
    """A job that cannot share a batch, which ran as a whole in a worker."""

    metrics: dict[str, float | None]
    log: list[tuple[int, str]]  # level, message


def solve(settings: Sequence[DictConfig]) -> Done:
    """What every job of a tensor batch leaves."""
    from ... import members

    start = time.monotonic()
    return Done(list(members.solve(list(settings))), time.monotonic() - start)


def solve_elsewhere(pickled: bytes, path: Sequence[str]) -> bytes:
    """The same in a process that has only just begun.

    Args:
        pickled: a `Batch`.
        path: `sys.path` of the command, which may lead to a user's own modules.
    """
    sys.path[:] = [*path, *(entry for entry in sys.path if entry not in path)]
    from ... import members

    start = time.monotonic()
    with _trusted():
        batch: Batch = pickle.loads(pickled)
        outcomes = solve(batch.settings).outcomes
        for i, outcome in enumerate(outcomes):
            # A job with `members` of its own composes them, which takes the program's Hydra.
            if isinstance(outcome, members.Deferred) and batch.settings[i].get("members") is None:
                outcomes[i] = _run(batch.settings[i], Path(batch.directories[i]))
        portable = [_portable(outcome) for outcome in outcomes]
    return pickle.dumps(Done(portable, time.monotonic() - start))


def pack(batch: Batch) -> tuple[bytes, list[str]]:
    """The arguments of `solve_elsewhere`."""
    return pickle.dumps(batch), list(sys.path)


def unpack(result: bytes) -> Done:
    """What it returned."""
    done: Done = pickle.loads(result)
    return done


def _run(cfg: DictConfig, directory: Path) -> Written | Exception:
    """A job that takes no part in batches: its experiment runs here, and its log is handed back."""
    directory.mkdir(parents=True, exist_ok=True)
    log = _Kept()
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.addHandler(log)
    from ... import members

    try:
        with warnings.catch_warnings():
            warnings.showwarning = log.warn
            return Written(members.run(cfg, directory), log.lines)
    except Exception as error:
        return error
    finally:
        root.removeHandler(log)


class _Kept(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.lines: list[tuple[int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((record.levelno, record.getMessage()))

    def warn(self, message: Warning | str, *_: Any, **__: Any) -> None:
        self.lines.append((logging.WARNING, str(message)))


def _portable(outcome: Any) -> Any:
    """The outcome, or for an exception that does not survive the way, its words."""
    if not isinstance(outcome, BaseException):
        return outcome
    try:
        pickle.loads(pickle.dumps(outcome))
    except Exception:
        return RuntimeError(f"{type(outcome).__name__}: {outcome}")
    return outcome


@contextlib.contextmanager
def _trusted() -> Iterator[None]:
    """Hydra 1.4 instantiates only what the program trusts, and this process is not the program."""
    try:
        from hydra._internal.execution_policy import execution_whitelist
    except ImportError:
        yield
        return
    with execution_whitelist(("staf_torch.*",)):
        yield
