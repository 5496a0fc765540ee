"""Where the tensor batches of a sweep are computed: in this process, in others, on a cluster, by Ray."""

from __future__ import annotations

import abc
import contextlib
import logging
import os
import pickle
import sys
import time
import warnings
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from ..experiments.registry import experiment
from ..numerics.checks import choice, integer
from ..results.progress import SHOWN, Progress
from .batching import Batch, Deferred, Done, Failed, Outcome, Written, batches, solve
from .hydra_compat import env_override, trusted, trusted_packages
from .workers import LostError, Worker, ready

_log = logging.getLogger(__name__)
EXECUTORS = ("inline", "process", "submitit", "ray")
_EXTRAS = {"submitit": "slurm", "ray": "ray"}
_POLL_LOCAL, _POLL = 0.2, 10.0  # s


def executor(name: object, workers: int | None, arguments: Mapping[str, Any], directory: Path) -> Executor:
    """Return the executor of that name in `hydra.launcher.executor`.

    Args:
        name: one of `EXECUTORS`.
        workers: tensor batches at once; None for as many as suit the executor.
        arguments: of the libraries behind them, by the name of the executor.
        directory: of the sweep.

    Raises:
        ValueError: for another name, or where the library behind it is not installed.
    """
    choice("hydra.launcher", "executor", name, EXECUTORS)
    try:
        if name == "submitit":
            return Submitit(workers, directory / ".submitit", arguments["submitit"])
        if name == "ray":
            return Ray(workers, arguments["ray"])
    except ImportError as error:
        extra = _EXTRAS[str(name)]
        raise ValueError(
            f"`hydra.launcher.executor={name}` needs the extra: pip install 'staf_torch[{extra}]' ({error})."
        ) from error
    return Process(workers) if name == "process" else Inline(workers)


class Executor(abc.ABC):
    """Tensor batches, some at once. A context: leaving it ends what still runs.

    Args:
        workers: batches at once; None for as many as suit the executor.
    """

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
                    yield number, _failed(batches[number], f"no worker could begin ({_words(error)})")
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
    """One line of at most 200 characters."""
    said = " ".join(str(error).split())
    said = said if isinstance(error, LostError | GivenUpError) else f"{type(error).__name__}: {said}"
    return said if len(said) <= 200 else f"{said[:197]}..."


class Inline(Executor):
    """One tensor batch after the other, in this process, each with all the threads of torch."""

    @property
    def workers(self) -> int:
        return 1

    def close(self, *, failed: bool) -> None:
        return None

    def submit(self, batch: Batch, progress: Progress) -> Done:
        start = time.monotonic()
        return Done(solve(batch.settings, progress), time.monotonic() - start)

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


class Submitit(Executor):
    """One job of a SLURM cluster, or of this machine, a tensor batch.

    Args:
        workers: jobs at once; None for one a core on this machine, and any number on a cluster.
        folder: of submitit's files.
        arguments: of `submitit.AutoExecutor.update_parameters`; also `cluster`, which is `slurm` where
            there is one, else `local`.
    """

    def __init__(self, workers: int | None, folder: Path, arguments: Mapping[str, Any]) -> None:
        super().__init__(workers)
        import submitit

        parameters = dict(arguments)
        place = parameters.pop("cluster", None)
        self._executor = submitit.AutoExecutor(folder=parameters.pop("folder", folder), cluster=place)
        self._executor.update_parameters(**{"name": "staf", "timeout_min": 24 * 60, **parameters})
        self._local = self._executor.cluster in ("local", "debug")
        self._jobs: list[Any] = []

    @property
    def workers(self) -> int:
        return super().workers if self._asked or self._local else 10**6

    @property
    def pieces(self) -> int:
        return self.workers if self._asked or self._local else 1

    def close(self, *, failed: bool) -> None:
        if failed:
            for job in self._jobs:
                job.cancel(check=False)

    def submit(self, batch: Batch, progress: Progress) -> Any:
        job = self._executor.submit(solve_elsewhere, *pack(batch))
        self._jobs.append(job)
        return job

    def wait(self, handles: dict[int, Any]) -> list[int]:
        while True:
            ended = [number for number, job in handles.items() if job.done()]
            if ended:
                return ended
            time.sleep(_POLL_LOCAL if self._local else _POLL)

    def result(self, handle: Any) -> Done:
        return unpack(handle.result())


class Ray(Executor):
    """One task of Ray a tensor batch and one core a task, on this machine or on a Ray cluster.

    Args:
        workers: tasks at once; None for as many as Ray has cores.
        arguments: of `ray.init`.
    """

    def __init__(self, workers: int | None, arguments: Mapping[str, Any]) -> None:
        super().__init__(workers)
        import ray

        self._ray = ray
        self._ours = not ray.is_initialized()
        if self._ours:
            ray.init(**{"log_to_driver": False, "include_dashboard": False, **arguments})
        self._solve = ray.remote(solve_elsewhere)

    @property
    def workers(self) -> int:
        return self._asked or max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def close(self, *, failed: bool) -> None:
        if self._ours:
            self._ray.shutdown()

    def submit(self, batch: Batch, progress: Progress) -> Any:
        return self._solve.remote(*pack(batch))

    def wait(self, handles: dict[int, Any]) -> list[int]:
        ready, _ = self._ray.wait(list(handles.values()), num_returns=1)
        return [number for number, handle in handles.items() if handle in ready]

    def result(self, handle: Any) -> Done:
        return unpack(self._ray.get(handle))


def compute(
    settings: Sequence[DictConfig],
    directories: Sequence[Path],
    workers: Executor,
    *,
    finished: Collection[int] = frozenset(),
    most: int | None = None,
    tell: Callable[[float], None],
) -> Generator[tuple[int, Outcome, float], None, None]:
    """Yield index, outcome and seconds of every job that is not finished, as the tensor batches end.

    A batch of which some jobs are finished is computed as a whole: rounding depends on the others in it, and
    a sweep that was interrupted ends with the very numbers that it would have had.

    Args:
        settings: of every job.
        directories: of every run.
        workers: compute the batches.
        finished: indices of jobs that need no outcome.
        most: jobs of a batch at most.
        tell: is told how many jobs are computed, with fractions while this process computes a batch.
    """
    done = 0
    planned = batches(settings, least=workers.pieces, most=most)
    planned = [batch for batch in planned if not set(finished).issuperset(batch)]
    _log.info("%d jobs in %d tensor batches", len(settings), len(planned))
    given = [Batch([settings[i] for i in b], [str(directories[i]) for i in b]) for b in planned]
    wanted = [[i for i in batch if i not in finished] for batch in planned]
    left = [len(batch) for batch in wanted]
    listening = Progress(lambda share: tell(done + share * next(filter(None, left), 0)))
    for number, (outcomes, seconds) in workers.map(given, listening):
        done, left[number] = done + left[number], 0
        tell(done)
        found = dict(zip(planned[number], outcomes, strict=True))
        for index in wanted[number]:
            yield index, found[index], seconds / len(outcomes)


# In a worker process


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
            # A job with `members` of its own composes them, which takes the program's Hydra.
            if isinstance(outcome, Deferred) and cfg.get("members") is None:
                outcomes[i] = _run_whole(cfg, Path(batch.directories[i]))
        portable = [_portable(outcome) for outcome in outcomes]
    return pickle.dumps(Done(portable, time.monotonic() - start))


def _run_whole(cfg: DictConfig, directory: Path) -> Outcome:
    """Run an experiment that takes no part in batches, and keep its log for the parent."""
    directory.mkdir(parents=True, exist_ok=True)
    with _kept_log() as lines:
        try:
            return Written(experiment(cfg.task)(cfg, directory, SHOWN), lines)
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
