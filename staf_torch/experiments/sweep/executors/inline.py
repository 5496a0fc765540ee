"""One tensor batch after the other, in this process."""

from __future__ import annotations

from types import TracebackType

from . import work
from .base import Executor
from .work import Batch, Done


class Inline(Executor):
    """Each batch has all the threads of torch."""

    @property
    def workers(self) -> int:
        return 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def submit(self, batch: Batch) -> Done:
        return work.solve(batch.settings)

    def wait(self, handles: dict[int, Done]) -> list[int]:
        return list(handles)

    def result(self, handle: Done) -> Done:
        return handle
