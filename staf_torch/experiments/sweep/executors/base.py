"""What an executor is: it takes tensor batches and gives back what they left, in the order they finish."""

from __future__ import annotations

import abc
import os
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Any

from ...._checks import integer
from .work import Batch, Done


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
        """Tensor batches that a group of jobs should at least make, to keep everyone busy."""
        return self.workers

    def __enter__(self) -> Executor:
        return self

    @abc.abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    @abc.abstractmethod
    def submit(self, batch: Batch) -> Any:
        """Begin a tensor batch; a handle on it."""

    @abc.abstractmethod
    def wait(self, handles: dict[int, Any]) -> list[int]:
        """Block until one of the batches has ended; the keys of all that have."""

    @abc.abstractmethod
    def result(self, handle: Any) -> Done:
        """What a batch left that has ended. Raises where the worker itself was lost."""

    def map(self, batches: Sequence[Batch]) -> Iterator[tuple[int, Done]]:
        """The number of a batch and what it left, as they end. A lost worker fails its batch alone."""
        running: dict[int, Any] = {}
        waiting = list(range(len(batches)))[::-1]
        while waiting or running:
            while waiting and len(running) < self.workers:
                number = waiting.pop()
                running[number] = self.submit(batches[number])
            for number in self.wait(running):
                handle = running.pop(number)
                try:
                    done = self.result(handle)
                except Exception as error:
                    lost = RuntimeError(f"the worker was lost ({type(error).__name__}: {error})")
                    done = Done([lost] * len(batches[number].settings), 0.0)
                yield number, done
