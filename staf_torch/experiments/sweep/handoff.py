"""How a job that was solved in a tensor batch reaches the task that writes its run directory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any, NamedTuple, TypeVar

Task = TypeVar("Task", bound=Callable[..., Any])
_MARK = "takes_solved_jobs"


class Solved(NamedTuple):
    """A job that was computed before it runs."""

    outcome: Any  # `members.Solved`, or the exception that it ended with
    seconds: float  # its share of the time that the batch took


_current: ContextVar[Solved | None] = ContextVar("solved", default=None)


def takes_solved(task: Task) -> Task:
    """Mark a task function that asks `current` before it computes anything."""
    setattr(task, _MARK, True)
    return task


def is_marked(task: Callable[..., Any]) -> bool:
    """Whether `takes_solved` was applied to it."""
    return bool(getattr(task, _MARK, False))


def current() -> Solved | None:
    """What was computed for the job that runs now."""
    return _current.get()


@contextlib.contextmanager
def handed(solved: Solved | None) -> Iterator[None]:
    """The job that runs inside finds ``solved``."""
    token = _current.set(solved)
    try:
        yield
    finally:
        _current.reset(token)
