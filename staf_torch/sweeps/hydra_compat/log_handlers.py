"""Logging that is configured anew for a while, which Python does by closing every handler that there is."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator


@contextlib.contextmanager
def handlers_aside() -> Iterator[None]:
    """Hide the handlers of the process from `logging.config`, which closes all that it knows of.

    In the end they come back, the level with them, and those made meanwhile are closed.
    """
    root = logging.getLogger()
    handlers, level, known = root.handlers[:], root.level, logging._handlerList[:]  # type: ignore[attr-defined]
    named = dict(logging._handlers)  # type: ignore[attr-defined]
    disabled = {name for name, each in _loggers() if each.disabled}
    logging._handlerList.clear()  # type: ignore[attr-defined]
    logging._handlers.clear()  # type: ignore[attr-defined]
    root.handlers[:] = []
    try:
        yield
    finally:
        for handler in root.handlers:
            handler.close()
        root.handlers[:] = handlers
        if root.level != level:
            root.setLevel(level)
        for name, each in _loggers():
            each.disabled = name in disabled
        logging._handlerList[:0] = known  # type: ignore[attr-defined]
        logging._handlers.update(named)  # type: ignore[attr-defined]


def _loggers() -> list[tuple[str, logging.Logger]]:
    """The loggers of the process but the root, by their names."""
    known = logging.Logger.manager.loggerDict
    return [(name, each) for name, each in known.items() if isinstance(each, logging.Logger)]
