"""Tensor batches as tasks of Ray, on this machine or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any

from . import work
from .base import Executor
from .work import Batch, Done


class Ray(Executor):
    """One Ray task a tensor batch, one core a task.

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
        self._solve = ray.remote(work.solve_elsewhere)

    @property
    def workers(self) -> int:
        return self._asked or max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ours:
            self._ray.shutdown()

    def submit(self, batch: Batch) -> Any:
        return self._solve.remote(*work.pack(batch))

    def wait(self, handles: dict[int, Any]) -> list[int]:
        ready, _ = self._ray.wait(list(handles.values()), num_returns=1)
        return [number for number, handle in handles.items() if handle in ready]

    def result(self, handle: Any) -> Done:
        return work.unpack(self._ray.get(handle))
