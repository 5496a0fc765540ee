"""One tensor batch: what a worker does, in this process or in another."""

from __future__ import annotations

import contextlib
import pickle
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from omegaconf import DictConfig


class Done(NamedTuple):
    """A tensor batch that was computed."""

    outcomes: list[Any]  # one a job: `members.Solved`, or the exception that it ended with
    seconds: float


def solve(batch: Sequence[DictConfig]) -> Done:
    """What every job of a tensor batch leaves."""
    from ... import members

    start = time.monotonic()
    return Done(list(members.solve(list(batch))), time.monotonic() - start)


def solve_elsewhere(pickled: bytes, path: Sequence[str]) -> bytes:
    """The same in a process that has only just begun.

    Args:
        pickled: the configurations.
        path: `sys.path` of the command, which may lead to a user's own modules.
    """
    sys.path[:] = [*path, *(entry for entry in sys.path if entry not in path)]
    with _trusted():
        outcomes, seconds = solve(pickle.loads(pickled))
        return pickle.dumps(Done([_portable(outcome) for outcome in outcomes], seconds))


def pack(batch: Sequence[DictConfig]) -> tuple[bytes, list[str]]:
    """The arguments of `solve_elsewhere`."""
    return pickle.dumps(list(batch)), list(sys.path)


def unpack(result: bytes) -> Done:
    """What it returned."""
    done: Done = pickle.loads(result)
    return done


def _portable(outcome: Any) -> Any:
    """The outcome, or for an exception that does not survive the way, its words."""
    if not isinstance(outcome, BaseException):
        return outcome
    try:
        pickle.loads(pickle.dumps(outcome))
    except Exception:
        return RuntimeError(f"{type(outcome).__name__}: {outcome}")
    return outcome


@contextlib.contextmanager
def _trusted() -> Iterator[None]:
    """Hydra 1.4 instantiates only what the program trusts, and this process is not the program."""
    try:
        from hydra._internal.execution_policy import execution_whitelist
    except ImportError:
        yield
        return
    with execution_whitelist(("staf_torch.*",)):
        yield
