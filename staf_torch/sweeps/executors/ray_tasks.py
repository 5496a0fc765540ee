"""Tensor batches as tasks of Ray, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...results.progress import Progress
from ..batching import Batch, Done
from ..workers import LostError
from .base import Executor
from .remote import pack, solve_elsewhere, unpack


class Ray(Executor):
    """One task of Ray a tensor batch and one core a task, on this machine or on a Ray cluster.

    Args:
        workers: tasks at once; None for as many as Ray has cores.
        arguments: of `ray.init`.
    """

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
                raise LostError(f"Ray could not begin ({type(error).__name__}: {said})") from error
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
