"""Tensor batches as jobs of SLURM, with or without its accounting, or of this machine, by submitit."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from ...results.progress import Progress
from ..batching import Batch, Done
from ..lock import NAME
from ..workers import LostError, beginning, end_with, end_with_file
from .base import Executor, GivenUpError
from .controller import Controller
from .remote import pack, solve_elsewhere, unpack

_LOOK = 0.5  # s between two looks for results
_REQUEUES = 3  # times that a job asks to be put into the queue again
_GRACE = 20.0  # s that a result may take from another machine to here
_GOES_ON = {
    *("PENDING", "RUNNING", "SUSPENDED", "COMPLETING", "CONFIGURING", "RESIZING", "STOPPED", "SIGNALING"),
    *("REQUEUED", "REQUEUE_FED", "REQUEUE_HOLD", "SPECIAL_EXIT", "STAGE_OUT", "POWER_UP_NODE"),
}
_FINAL = {  # states that nobody should try again, and what they mean
    "CANCELLED": "was cancelled",
    "TIMEOUT": "ran into its time limit: give it more by hydra.launcher.submitit.timeout_min",
    "DEADLINE": "did not end before its deadline",
    "OUT_OF_MEMORY": "had too little memory: give it more by hydra.launcher.submitit.mem_gb",
}


class Task:
    """What a job computes. SLURM puts it into the queue again where a job runs out of time or is preempted.

    Args:
        parent: host, process and beginning of the command, which a job on the same machine ends with; None:
            the job ends when the lock of the sweep is not touched any more.
        lock: file that the command touches; None: there is none.
    """

    def __init__(self, parent: tuple[str, int, str] | None, lock: Path | None) -> None:
        self._parent, self._lock = parent, lock

    def __call__(self, pickled: bytes, path: Sequence[str], packages: Sequence[str] = ()) -> bytes:
        """Return what `solve_elsewhere` returns."""
        if self._parent is not None and self._parent[0] == socket.gethostname():
            end_with(self._parent[1], self._parent[2])
        elif self._lock is not None and self._lock.parent.exists():  # machines may not share that disk
            end_with_file(self._lock)  # which has gone where the job was waiting when the command ended
        with _ended_by_signals():
            return solve_elsewhere(pickled, path, packages)

    def checkpoint(self, *arguments: Any) -> Any:
        """Begin the batch anew: its rounding depends on all of its jobs. Other batches keep theirs."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, *arguments)


class _SignalledError(BaseException):
    """What a handler of submitit raised: no error of the batch in which it happened to be raised."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let submitit's handlers of a time limit and of preemption end the job, whatever catches errors in it.

    At a time limit SLURM may end the very `scontrol` that puts the job into the queue again: it is started
    anew.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGUSR2)}
    ours = {number: handler for number, handler in before.items() if callable(handler)}

    def handle(number: int, frame: FrameType | None) -> None:
        for left in reversed(range(_REQUEUES)):
            try:
                ours[signal.Signals(number)](number, frame)
                return
            except Exception as error:
                if not left or not isinstance(error, subprocess.SubprocessError):
                    raise _SignalledError(error) from error

    try:
        for number in ours:
            signal.signal(number, handle)
        yield
    except _SignalledError as told:
        raise told.error from None
    finally:
        for number, handler in ours.items():
            signal.signal(number, handler)


class Submitit(Executor):
    """One job of a SLURM cluster, or of this machine, a tensor batch.

    Args:
        workers: jobs at once; None for one a core on this machine, and any number on a cluster.
        directory: of the sweep.
        arguments: of `submitit.AutoExecutor.update_parameters`; also `cluster`, which is `slurm` where
            there is one, else `local`, `folder` of submitit's files, and `slurm_max_num_timeout`, how often
            a job that runs out of time begins anew.
    """

    def __init__(self, workers: int | None, directory: Path, arguments: Mapping[str, Any]) -> None:
        super().__init__(workers)
        import submitit

        parameters = dict(arguments)
        place = parameters.pop("cluster", None)
        folder = self._folder(parameters.pop("folder", None), directory)
        starts = "slurm_max_num_timeout"  # an argument of the constructor
        again = {starts: parameters.pop(starts)} if starts in parameters else {}
        self._executor = submitit.AutoExecutor(folder=folder, cluster=place, **again)
        self._executor.update_parameters(**{"name": "staf", "timeout_min": 24 * 60, **parameters})
        self._local = self._executor.cluster in ("local", "debug")
        parent = (socket.gethostname(), os.getpid(), beginning(os.getpid())) if self._local else None
        lock = (directory / NAME).absolute()
        self._task = Task(parent, lock if lock.exists() and not self._local else None)
        self._controller = Controller()
        self._running: dict[str, Any] = {}
        self._states: dict[str, str] = {}
        self._ended_at: dict[str, float] = {}  # when a job was first seen to have ended without a result

    @staticmethod
    def _folder(wanted: str | None, directory: Path) -> Path:
        """Make a fresh folder.

        SLURM before 23.02 makes none for its logs; and what an earlier start, or a stranger, left under the
        number of a job would be taken for its result.
        """
        above = directory / ".submitit" if wanted is None else Path(str(wanted).partition("%")[0])
        above.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(dir=above))

    @property
    def workers(self) -> int:
        return super().workers if self._asked or self._local else 10**6

    @property
    def pieces(self) -> int:
        return self.workers if self._asked or self._local else 1

    def close(self, *, failed: bool) -> None:
        if self._local:
            for job in self._running.values():
                job.cancel(check=False)
        else:
            self._controller.cancel(list(self._running))
        self._running = {}

    def submit(self, batch: Batch, progress: Progress) -> Any:
        packed = pack(batch)
        submitted: list[Any] = []

        def begin() -> None:
            job = self._executor.submit(self._task, *packed)
            self._running[job.job_id] = job
            submitted.append(job)

        if self._local:
            begin()
        else:
            self._controller.submit(begin)
        return submitted[0]

    def wait(self, handles: dict[int, Any]) -> list[int]:
        while True:
            ended = [number for number, job in handles.items() if self._has_ended(job)]
            if ended:
                return ended
            time.sleep(_LOOK)

    def result(self, handle: Any) -> Done:
        self._running.pop(handle.job_id, None)
        log = handle.paths.stderr
        if not handle.paths.result_pickle.exists():
            state = "gone" if self._local else self._states.get(handle.job_id, "gone")
            how = _FINAL.get(state, f"ended without a result ({state})")
            why = f"{self._name(handle)} {how}; its log: {log}"
            raise GivenUpError(why) if state in _FINAL else LostError(why)
        try:
            return unpack(handle.result())
        except Exception as error:
            said = next((line for line in reversed(str(error).splitlines()) if line.strip()), "")
            why = f"{self._name(handle)} {said.strip()}; its log: {log}"
            raise GivenUpError(why) if "timed-out" in said else LostError(why) from error

    def _name(self, job: Any) -> str:
        return f"{'the process' if self._local else 'SLURM job'} {job.job_id}"

    def _has_ended(self, job: Any) -> bool:
        """Whether a job left a result, or will leave none."""
        if job.paths.result_pickle.exists():
            return True
        if self._local:
            return bool(job.done())
        self._look()
        if self._states.get(job.job_id, "PENDING") in _GOES_ON:
            self._ended_at.pop(job.job_id, None)
            return False
        return time.monotonic() - self._ended_at.setdefault(job.job_id, time.monotonic()) > _GRACE

    def _look(self) -> None:
        """Take over what the controller says of the jobs, where it says something."""
        now = self._controller.states()
        if now is None:
            return
        # The controller forgets what ended; what was known then stays known.
        final = {job: state for job, state in self._states.items() if state not in _GOES_ON}
        self._states = {**final, **now}
        for job in self._running:
            self._states.setdefault(job, "gone")
