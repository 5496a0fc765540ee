"""Tensor batches as jobs of a SLURM cluster, or of this machine, through submitit."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from . import work
from .base import Executor
from .work import Batch, Done

_POLL_LOCAL, _POLL = 0.2, 10.0  # s


class Submitit(Executor):
    """One cluster job a tensor batch.

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            for job in self._jobs:
                job.cancel(check=False)

    def submit(self, batch: Batch) -> Any:
        job = self._executor.submit(work.solve_elsewhere, *work.pack(batch))
        self._jobs.append(job)
        return job

    def wait(self, handles: dict[int, Any]) -> list[int]:
        while True:
            ended = [number for number, job in handles.items() if job.done()]
            if ended:
                return ended
            time.sleep(_POLL_LOCAL if self._local else _POLL)

    def result(self, handle: Any) -> Done:
        return work.unpack(handle.result())
