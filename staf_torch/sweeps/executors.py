"""Executors of tensor batches: in this process, in others of this machine, by submitit (SLURM), by Ray."""

from __future__ import annotations

import abc
import contextlib
import itertools
import logging
import os
import signal
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from ..numerics.checks import choice, integer
from ..settings.plain import ManySettings
from ..signs import Progress
from .hydra_compat import env_override
from .job import Batch, Done, Failed, Flat, LostError, Outcome, batches, solve
from .workers import (
    Worker,
    beginning,
    check,
    end_with,
    give_memory_back,
    pack,
    ready,
    solve_elsewhere,
    unpack,
)

_log = logging.getLogger(__name__)
_MOST = 300  # characters of what is said of a lost worker
EXECUTORS = ("inline", "process", "submitit", "ray")
_EXTRAS = {"submitit": "slurm", "ray": "ray"}
_LOOK = 0.5  # s between two looks for results
_FINAL = {  # states that nobody should try again, and what they mean
    "CANCELLED": "was cancelled",
    "TIMEOUT": "ran into its time limit: give it more by hydra.launcher.submitit.timeout_min",
    "DEADLINE": "did not end before its deadline",
    "OUT_OF_MEMORY": "had too little memory: give it more by hydra.launcher.submitit.mem_gb",
}


def executor(name: object, workers: int | None, arguments: Mapping[str, Any], directory: Path) -> Executor:
    """Return the executor of a name of `EXECUTORS`, as `hydra.launcher.executor` has it.

    ``workers`` are tensor batches at once, None for as many as suit it, ``arguments`` those of the libraries,
    by the executor's name. Raises ValueError for another name, or where the library is not installed.
    """
    choice("hydra.launcher", "executor", name, EXECUTORS)
    try:
        if name == "submitit":
            return Submitit(workers, directory, arguments["submitit"])
        if name == "ray":
            return Ray(workers, arguments["ray"])
    except ImportError as error:
        extra = _EXTRAS[str(name)]
        raise ValueError(
            f"`hydra.launcher.executor={name}` needs the extra: pip install 'staf_torch[{extra}]' ({error})."
        ) from error
    return Process(workers) if name == "process" else Inline(workers)


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
        most, measured: as in `batches`.
        tell: is told how many jobs are computed, with fractions while this process computes a batch.
    """
    planned = batches(flat, least=workers.pieces, most=most, measured=measured)
    del flat  # half of the memory that settings take
    planned = [batch for batch in planned if not set(finished).issuperset(batch)]
    level = logging.DEBUG if measured else logging.INFO
    _log.log(level, "%d jobs in %d tensor batches", len(settings), len(planned))
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

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027 (there may be nothing)
        """Give back what the executor holds, and end what still runs."""

    @abc.abstractmethod
    def map(self, batches: Sequence[Batch], progress: Progress) -> Iterator[tuple[int, Done]]:
        """Yield the number of a batch and what it left, as they end; the share that is done of one goes to
        ``progress`` where this process computes it."""


class Inline(Executor):
    """Compute the tensor batches one after the other in this process, each with all the threads of torch."""

    @property
    def workers(self) -> int:
        return 1

    def map(self, batches: Sequence[Batch], progress: Progress) -> Iterator[tuple[int, Done]]:
        for number, batch in enumerate(batches):
            start = time.monotonic()
            outcomes = solve(batch.settings, progress)
            give_memory_back()
            yield number, Done(outcomes, time.monotonic() - start)


class Elsewhere(Executor):
    """Compute tensor batches in other processes.

    A batch whose worker was lost is tried once more, and then fails alone.
    """

    @abc.abstractmethod
    def submit(self, batch: Batch) -> Any:
        """Begin a tensor batch and return a handle on it."""

    @abc.abstractmethod
    def wait(self, handles: dict[int, Any]) -> list[int]:
        """Block until one of the batches has ended; return the keys of all that have."""

    @abc.abstractmethod
    def result(self, handle: Any) -> Done:
        """Return what a batch left that has ended. Raises where the worker itself was lost."""

    def map(self, batches: Sequence[Batch], progress: Progress) -> Iterator[tuple[int, Done]]:
        running: dict[int, Any] = {}
        waiting = list(range(len(batches)))[::-1]
        lost: set[int] = set()
        while waiting or running:
            while waiting and len(running) < self.workers:
                number = waiting.pop()
                try:
                    running[number] = self.submit(batches[number])
                except Exception as error:
                    why = f"no worker process could be started ({_words(error)})"
                    yield number, _failed(batches[number], why)
            for number in self.wait(running) if running else ():
                handle = running.pop(number)
                try:
                    done = self.result(handle)
                except Exception as error:
                    if number not in lost and not isinstance(error, GivenUpError):
                        lost.add(number)
                        _log.warning("a worker was lost: %s; its batch is tried once more", _words(error))
                        waiting.append(number)
                        continue
                    twice = " twice" if number in lost else ""
                    done = _failed(batches[number], f"the worker was lost{twice} ({_words(error)})")
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


class Process(Elsewhere):
    """Fresh processes of this machine, which share the cores between them and end with this one."""

    def __init__(self, workers: int | None = None) -> None:
        super().__init__(workers)
        self._idle: list[Worker] = []
        self._all: list[Worker] = []

    def close(self) -> None:
        for worker in self._all:
            worker.end()

    def submit(self, batch: Batch) -> Worker:
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


class Submitit(Elsewhere):
    """Run a tensor batch as a job of SLURM, or as a process of this machine (``cluster=local``).

    Jobs at once are one a core on this machine and any number on a cluster, unless ``workers`` says so;
    submitit keeps its files in `.submitit` of the sweep's directory. ``arguments`` are those of
    `submitit.AutoExecutor.update_parameters`, and `cluster` and `folder`.
    """

    def __init__(self, workers: int | None, directory: Path, arguments: Mapping[str, Any]) -> None:
        super().__init__(workers)
        import submitit

        parameters = dict(arguments)
        place, folder = parameters.pop("cluster", None), parameters.pop("folder", None)
        self._executor = submitit.AutoExecutor(folder=_fresh(folder, directory), cluster=place)
        self._executor.update_parameters(**{"name": "staf", "timeout_min": 24 * 60, **parameters})
        self._local = self._executor.cluster in ("local", "debug")
        self._task = Task((os.getpid(), beginning(os.getpid())) if self._local else None)
        self._running: dict[str, Any] = {}

    @property
    def workers(self) -> int:
        return super().workers if self._asked or self._local else 10**6

    @property
    def pieces(self) -> int:
        return self.workers if self._asked or self._local else 1

    def close(self) -> None:
        for job in self._running.values():
            with contextlib.suppress(OSError):
                job.cancel(check=False)

    def submit(self, batch: Batch) -> Any:
        job = self._executor.submit(self._task, *pack(batch))
        self._running[job.job_id] = job
        return job

    def wait(self, handles: dict[int, Any]) -> list[int]:
        while True:
            ended = [number for number, job in handles.items() if job.done()]
            if ended:
                return ended
            check()  # nobody else does as long as no job ends
            time.sleep(_LOOK)

    def result(self, handle: Any) -> Done:
        del self._running[handle.job_id]
        written = handle.paths.result_pickle.exists
        who = f"{'the process' if self._local else 'SLURM job'} {handle.job_id}"
        try:
            if self._local and not written():  # submitit waits a quarter of a minute for a file
                raise LostError("no file")
            return unpack(handle.result())
        except Exception as error:
            said = _last_of_trace(str(error)) if written() else None
            state = "TIMEOUT" if said and "timed-out" in said else str(handle.state).partition(" ")[0]
            why = _FINAL.get(state) or said or f"ended without a result ({state})"
            kind = GivenUpError if state in _FINAL else LostError
            raise kind(f"{who} {why}; its log: {handle.paths.stderr}") from error


def _fresh(wanted: str | None, directory: Path) -> Path:
    """Make a fresh folder: SLURM before 23.02 makes none for its logs, and what an earlier start, or a
    stranger, left under the number of a job would be read as its result."""
    above = directory / ".submitit" if wanted is None else Path(str(wanted).partition("%")[0])
    above.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(dir=above))


class Task:
    """Solves a batch within a job, which ends with its parent: the process of the command on the same
    machine, and its `beginning`."""

    def __init__(self, parent: tuple[int, str] | None) -> None:
        self._parent = parent

    def __call__(self, pickled: bytes, path: Sequence[str], packages: Sequence[str] = ()) -> bytes:
        """Return what `solve_elsewhere` returns."""
        if self._parent is not None:
            end_with(*self._parent)
        with _ended_by_signals():
            return solve_elsewhere(pickled, path, packages)


class _SignalledError(BaseException):
    """An error that a handler of submitit raised within a batch, which is no error of the batch."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let submitit's handler of a time limit end the job, whatever catches errors in it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGUSR2)}
    ours = {number: handler for number, handler in before.items() if callable(handler)}

    def handle(number: int, frame: FrameType | None) -> None:
        try:
            ours[signal.Signals(number)](number, frame)
        except Exception as error:
            raise _SignalledError(error) from None

    for number in ours:
        signal.signal(number, handle)
    try:
        yield
    except _SignalledError as signalled:
        raise signalled.error from None
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)


def _last_of_trace(said: str) -> str:
    """Return the last line of a job's traceback, which submitit frames by dashes, with its logs below."""
    lines = said.partition("You can check full logs")[0].splitlines()
    return next(
        (line.strip() for line in reversed(lines) if line.strip(" -")), "ended without a result or an error"
    )


class Ray(Elsewhere):
    """Run a tensor batch as a task of Ray with one core, on this machine or on a Ray cluster; as many at once
    as Ray has cores, unless ``workers`` says so."""

    def __init__(self, workers: int | None, arguments: Mapping[str, Any]) -> None:
        super().__init__(workers)
        import ray

        self._ray: Any = ray
        self._ours = not ray.is_initialized()
        if self._ours:
            try:
                ray.init(**{"log_to_driver": False, "include_dashboard": False, **arguments})
            except Exception as error:  # Ray raises plain ones where a daemon of its ends as it begins
                said = " ".join(str(error).split())
                raise LostError(f"Ray could not be started ({type(error).__name__}: {said})") from error
        self._solve = ray.remote(max_retries=0)(solve_elsewhere)  # `map` tries once more

    @property
    def workers(self) -> int:
        return self._asked or max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def close(self) -> None:
        if self._ours:
            self._ray.shutdown()

    def submit(self, batch: Batch) -> Any:
        return self._solve.remote(*pack(batch))

    def wait(self, handles: dict[int, Any]) -> list[int]:
        ready, _ = self._ray.wait(list(handles.values()), num_returns=1)
        return [number for number, handle in handles.items() if handle in ready]

    def result(self, handle: Any) -> Done:
        return unpack(self._ray.get(handle))
