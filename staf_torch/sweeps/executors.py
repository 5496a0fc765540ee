"""Executors of a sweep's tensor batches: in this process or in others; `clusters` has the rest."""

from __future__ import annotations

import abc
import contextlib
import itertools
import logging
import os
import pickle
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from ..figures.style import FigurePaper, in_a_sweep, printed_on
from ..numerics.checks import integer
from ..settings.plain import ManySettings
from ..signs import SHOWN, Progress
from .batching import (
    DEFERRED,
    Batch,
    Computed,
    Deferred,
    Done,
    Failed,
    Flat,
    Outcome,
    Written,
    batches,
    completion,
    solve,
)
from .hydra_compat import env_override, trusted, trusted_packages
from .workers import LostError, Worker, give_memory_back, ready

_log = logging.getLogger(__name__)
_MOST = 300  # characters of what is said of a lost worker


def compute(
    settings: ManySettings,
    flat: Sequence[Flat],
    directories: Callable[[int], Path],
    workers: Executor,
    *,
    finished: Collection[int] = frozenset(),
    most: int | None = None,
    measured: bool = False,
    tell: Callable[[float], None],
) -> Iterator[tuple[int, Outcome, float]]:
    """Return index, outcome and seconds of every job that is not finished, as the tensor batches end.

    A batch of which some jobs are finished is computed as a whole: rounding depends on the others in it, and
    a sweep that was interrupted ends with the very numbers that it would have had.

    Args:
        settings: of every job; ``flat`` has the same by dotted keys.
        directories: of every run, by its index.
        workers: compute the batches.
        finished: indices of jobs that need no outcome.
        most: jobs of a batch at most.
        measured: whether metrics are all that is wanted of a job in a batch.
        tell: is told how many jobs are computed, with fractions while this process computes a batch.
    """
    planned = batches(flat, least=workers.pieces, most=most, measured=measured)
    del flat  # half of the memory that settings take
    planned = [batch for batch in planned if not set(finished).issuperset(batch)]
    _log.log(
        logging.DEBUG if measured else logging.INFO,
        "%d jobs in %d tensor batches",
        len(settings),
        len(planned),
    )
    # Absolute, since a worker may have another working directory.
    made = [
        Batch(settings.of(jobs), [os.path.abspath(directories(i)) for i in jobs], measured)
        for jobs in planned
    ]
    wanted = [[i for i in batch if i not in finished] for batch in planned]
    done, left = 0, [len(batch) for batch in wanted]
    listening = Progress(lambda share: tell(done + share * next(filter(None, left), 0)))

    def ended(batch: tuple[int, Done]) -> list[tuple[int, Outcome, float]]:
        nonlocal done
        number, (outcomes, seconds) = batch
        done, left[number] = done + left[number], 0
        tell(done)
        found = dict(zip(planned[number], outcomes, strict=True))
        return [(index, found[index], seconds / len(outcomes)) for index in wanted[number]]

    return itertools.chain.from_iterable(map(ended, workers.map(made, listening)))


class Executor(abc.ABC):
    """Tensor batches, some at once (None: as many as suit it). A context: leaving it ends what still runs."""

    def __init__(self, workers: int | None = None) -> None:
        if workers is not None:
            integer("hydra.launcher", "workers", workers, least=1)
        self._asked = workers

    @property
    def workers(self) -> int:
        """Batches at once."""
        return self._asked or os.cpu_count() or 1

    @property
    def pieces(self) -> int:
        """Tensor batches that a sweep should at least make, to keep everyone busy."""
        return self.workers

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(failed=kind is not None)

    @abc.abstractmethod
    def close(self, *, failed: bool) -> None:
        """Give back what the executor holds; where the sweep has failed, end what still runs."""

    @abc.abstractmethod
    def submit(self, batch: Batch, progress: Progress) -> Any:
        """Begin a tensor batch and return a handle on it; ``progress`` is of use in this process alone."""

    @abc.abstractmethod
    def wait(self, handles: dict[int, Any]) -> list[int]:
        """Block until one of the batches has ended; return the keys of all that have."""

    @abc.abstractmethod
    def result(self, handle: Any) -> Done:
        """Return what a batch left that has ended. Raises where the worker itself was lost."""

    def map(self, batches: Sequence[Batch], progress: Progress) -> Iterator[tuple[int, Done]]:
        """Yield the number of a batch and what it left, as they end.

        A batch whose worker was lost is tried once more, and then fails alone.
        """
        running: dict[int, Any] = {}
        waiting = list(range(len(batches)))[::-1]
        lost: dict[int, str] = {}
        while waiting or running:
            while waiting and len(running) < self.workers:
                number = waiting.pop()
                try:
                    running[number] = self.submit(batches[number], progress)
                except Exception as error:
                    yield (
                        number,
                        _failed(batches[number], f"no worker process could be started ({_words(error)})"),
                    )
            for number in self.wait(running) if running else ():
                handle = running.pop(number)
                try:
                    done = self.result(handle)
                except Exception as error:
                    if number not in lost and not isinstance(error, GivenUpError):
                        lost[number] = _words(error)
                        _log.warning("a worker was lost: %s; its batch is tried once more", lost[number])
                        waiting.append(number)
                        continue
                    said = "the worker was lost twice" if number in lost else "the worker was lost"
                    done = _failed(batches[number], f"{said} ({_words(error)})")
                yield number, done


class GivenUpError(Exception):
    """A worker that was ended by somebody who does not want it tried again."""


def _failed(batch: Batch, why: str) -> Done:
    return Done([Failed(LostError(why))] * len(batch.settings), 0.0)


def _words(error: Exception) -> str:
    """Shorten to one line of at most a few hundred characters."""
    said = " ".join(str(error).split())
    said = said if isinstance(error, LostError | GivenUpError) else f"{type(error).__name__}: {said}"
    return said if len(said) <= _MOST else f"{said[: _MOST - 3]}..."


class Inline(Executor):
    """Compute the tensor batches one after the other in this process, each with all the threads of torch."""

    @property
    def workers(self) -> int:
        return 1

    def close(self, *, failed: bool) -> None:
        return None

    def submit(self, batch: Batch, progress: Progress) -> Done:
        start = time.monotonic()
        outcomes = solve(batch.settings, progress)
        give_memory_back()
        return Done(outcomes, time.monotonic() - start)

    def wait(self, handles: dict[int, Done]) -> list[int]:
        return list(handles)

    def result(self, handle: Done) -> Done:
        return handle


class Process(Executor):
    """Fresh processes of this machine, which share the cores between them and end with this one."""

    def __init__(self, workers: int | None = None) -> None:
        super().__init__(workers)
        self._idle: list[Worker] = []
        self._all: list[Worker] = []

    def close(self, *, failed: bool) -> None:
        for worker in self._all:
            worker.end()
        self._all, self._idle = [], []

    def submit(self, batch: Batch, progress: Progress) -> Worker:
        self._idle = [worker for worker in self._idle if worker.alive()]
        if not self._idle:
            threads = max(1, (os.cpu_count() or 1) // self.workers)
            with env_override({"OMP_NUM_THREADS": str(threads)}):
                self._all.append(Worker(solve_elsewhere))
                self._idle.append(self._all[-1])
        worker = self._idle.pop()
        worker.begin(*pack(batch))
        return worker

    def wait(self, handles: dict[int, Worker]) -> list[int]:
        return ready(handles)

    def result(self, handle: Worker) -> Done:
        done = unpack(handle.result())
        self._idle.append(handle)
        return done


def pack(batch: Batch) -> tuple[bytes, list[str], list[str]]:
    """Return the arguments of `solve_elsewhere`."""
    return pickle.dumps(batch), list(sys.path), trusted_packages()


def unpack(pickled: bytes) -> Done:
    """Unpickle what `solve_elsewhere` returned."""
    done: Done = pickle.loads(pickled)
    return done


def solve_elsewhere(pickled: bytes, path: Sequence[str], packages: Sequence[str] = ()) -> bytes:
    """Compute a pickled `Batch` in a process that has only just begun, and return the pickled `Done`.

    It gets the command's `sys.path`, which may lead to a user's own modules, and the packages whose objects
    the command's settings may name.
    """
    sys.path[:] = [*path, *(entry for entry in sys.path if entry not in path)]
    start = time.monotonic()
    with trusted(packages):
        batch: Batch = pickle.loads(pickled)
        outcomes = solve(batch.settings, SHOWN)
        for i, outcome in enumerate(outcomes):
            if isinstance(outcome, Deferred):
                outcomes[i] = _run_whole(batch.settings[i], Path(batch.directories[i]))
            elif isinstance(outcome, Computed) and batch.measured:
                outcomes[i] = Written(outcome.metrics, ())
        portable = [_portable(outcome) for outcome in outcomes]
    give_memory_back()
    return pickle.dumps(Done(portable, time.monotonic() - start))


def _run_whole(cfg: DictConfig, directory: Path) -> Outcome:
    """Run an experiment that takes no part in batches, and keep its log for the parent."""
    directory.mkdir(parents=True, exist_ok=True)
    with _kept_log() as lines, in_a_sweep():
        try:
            with printed_on(FigurePaper.of(cfg.get("figures", True))):
                return Written(completion(cfg, DEFERRED)(cfg, directory, SHOWN), lines)
        except Exception as error:
            return Failed(error)


@contextlib.contextmanager
def _kept_log() -> Iterator[list[tuple[int, str]]]:
    """Collect level and text of log messages and warnings in a list."""
    lines: list[tuple[int, str]] = []
    handler, root = logging.Handler(), logging.getLogger()
    handler.emit = lambda record: lines.append((record.levelno, record.getMessage()))  # type: ignore[method-assign]
    root.setLevel(logging.INFO)
    root.addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: lines.append((logging.WARNING, str(message)))
            yield lines
    finally:
        root.removeHandler(handler)


def _portable(outcome: Outcome) -> Outcome:
    """Return the outcome; an exception that cannot be pickled is replaced by one with its words."""
    if not isinstance(outcome, Failed):
        return outcome
    try:
        pickle.loads(pickle.dumps(outcome))
    except Exception:
        return Failed(RuntimeError(f"{type(outcome.error).__name__}: {outcome.error}"))
    return outcome
