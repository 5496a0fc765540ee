"""Tensor batches on clusters, by submitit (SLURM) and by Ray; and the choice among all executors."""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from ..numerics.checks import choice
from ..signs import Progress
from .batching import Batch, Done
from .executors import Executor, GivenUpError, Inline, Process, pack, solve_elsewhere, unpack
from .workers import LostError, beginning, check, end_with

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


class Submitit(Executor):
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

    def close(self, *, failed: bool) -> None:
        for job in self._running.values():
            with contextlib.suppress(OSError):
                job.cancel(check=False)
        self._running = {}

    def submit(self, batch: Batch, progress: Progress) -> Any:
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


class Ray(Executor):
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
