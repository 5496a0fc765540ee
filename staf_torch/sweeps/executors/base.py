"""What computes the tensor batches of a sweep: some at once, each in a worker that may be lost."""

from __future__ import annotations

import abc
import logging
import os
from collections.abc import Iterator, Sequence
from typing import Any

from ...numerics.checks import integer
from ...results.progress import Progress
from ..batching import Batch, Done, Failed
from ..workers import LostError

_log = logging.getLogger(__name__)
_MOST = 300  # characters of what is said of a lost worker


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
    """One line of at most a few hundred characters."""
    said = " ".join(str(error).split())
    said = said if isinstance(error, LostError | GivenUpError) else f"{type(error).__name__}: {said}"
    return said if len(said) <= _MOST else f"{said[: _MOST - 3]}..."
