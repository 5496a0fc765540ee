"""Tensor batches in processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
from concurrent import futures
from types import TracebackType

from hydra.core.utils import env_override

from . import work
from .base import Executor
from .work import Batch, Done


class Process(Executor):
    """Fresh processes, which share the cores between them."""

    def __init__(self, workers: int | None = None) -> None:
        super().__init__(workers)
        fresh = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
        self._pool = futures.ProcessPoolExecutor(self.workers, fresh, _leave_interrupts_to_the_parent)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        workers = list((getattr(self._pool, "_processes", None) or {}).values())
        self._pool.shutdown(wait=kind is None, cancel_futures=True)
        if kind is not None:
            for process in workers:
                process.terminate()

    def submit(self, batch: Batch) -> futures.Future[bytes]:
        threads = max(1, (os.cpu_count() or 1) // self.workers)
        with env_override({"OMP_NUM_THREADS": str(threads)}):  # a worker begins on a submission
            return self._pool.submit(work.solve_elsewhere, *work.pack(batch))

    def wait(self, handles: dict[int, futures.Future[bytes]]) -> list[int]:
        futures.wait(handles.values(), return_when=futures.FIRST_COMPLETED)
        return [number for number, future in handles.items() if future.done()]

    def result(self, handle: futures.Future[bytes]) -> Done:
        return work.unpack(handle.result())


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
