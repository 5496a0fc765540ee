"""Tensor batches on this machine: in this process, or in others."""

from __future__ import annotations

import os
import time

from ...results.progress import Progress
from ..batching import Batch, Done, solve
from ..hydra_compat import env_override
from ..workers import Worker, ready
from .base import Executor
from .remote import pack, solve_elsewhere, unpack


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
