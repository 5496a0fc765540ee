"""A tensor batch in a worker process: what goes there, what it does, and what comes back."""

from __future__ import annotations

import contextlib
import logging
import pickle
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from omegaconf import DictConfig

from ...experiments.registry import Experiment, experiment
from ...results.progress import SHOWN
from ..batching import Batch, Deferred, Done, Failed, Outcome, Written, solve
from ..hydra_compat import trusted, trusted_packages


def pack(batch: Batch) -> tuple[bytes, list[str], list[str]]:
    """Return the arguments of `solve_elsewhere`."""
    return pickle.dumps(batch), list(sys.path), trusted_packages()


def unpack(pickled: bytes) -> Done:
    """Unpickle what `solve_elsewhere` returned."""
    done: Done = pickle.loads(pickled)
    return done


def solve_elsewhere(pickled: bytes, path: Sequence[str], packages: Sequence[str] = ()) -> bytes:
    """Compute a tensor batch in a process that has only just begun, and return the pickled `Done`.

    Args:
        pickled: a `Batch`.
        path: `sys.path` of the command, which may lead to a user's own modules.
        packages: those whose objects the command's settings may name.
    """
    sys.path[:] = [*path, *(entry for entry in sys.path if entry not in path)]
    start = time.monotonic()
    with trusted(packages):
        batch: Batch = pickle.loads(pickled)
        outcomes = solve(batch.settings, SHOWN)
        for i, (outcome, cfg) in enumerate(zip(outcomes, batch.settings, strict=True)):
            if isinstance(outcome, Deferred):
                whole = batch.whole[i] if batch.whole else None
                outcomes[i] = _run_whole(cfg, Path(batch.directories[i]), whole or experiment(cfg.task))
        portable = [_portable(outcome) for outcome in outcomes]
    return pickle.dumps(Done(portable, time.monotonic() - start))


def _run_whole(cfg: DictConfig, directory: Path, whole: Experiment) -> Outcome:
    """Run an experiment that takes no part in batches, and keep its log for the parent."""
    directory.mkdir(parents=True, exist_ok=True)
    with _kept_log() as lines:
        try:
            return Written(whole(cfg, directory, SHOWN), lines)
        except Exception as error:
            return Failed(error)


@contextlib.contextmanager
def _kept_log() -> Iterator[list[tuple[int, str]]]:
    """Collect level and text of log messages and warnings in a list."""
    lines: list[tuple[int, str]] = []
    handler, root = _Collecting(lambda level, text: lines.append((level, text))), logging.getLogger()
    root.setLevel(logging.INFO)
    root.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: lines.append((logging.WARNING, str(message)))
            yield lines
    finally:
        root.removeHandler(handler)


class _Collecting(logging.Handler):
    def __init__(self, take: Callable[[int, str], None]) -> None:
        super().__init__()
        self._take = take

    def emit(self, record: logging.LogRecord) -> None:
        self._take(record.levelno, record.getMessage())


def _portable(outcome: Outcome) -> Outcome:
    """Return the outcome; an exception that cannot be pickled is replaced by one with its words."""
    if not isinstance(outcome, Failed):
        return outcome
    try:
        pickle.loads(pickle.dumps(outcome))
    except Exception:
        return Failed(RuntimeError(f"{type(outcome.error).__name__}: {outcome.error}"))
    return outcome
