"""One tensor batch after the other, in this process."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType

from omegaconf import DictConfig

from . import work
from .base import Executor
from .work import Done


class Inline(Executor):
    """Each batch has all the threads of torch."""

    @property
    def workers(self) -> int:
        return 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def submit(self, batch: Sequence[DictConfig]) -> Done:
        return work.solve(batch)

    def wait(self, handles: dict[int, Done]) -> list[int]:
        return list(handles)

    def result(self, handle: Done) -> Done:
        return handle
