"""The line of the log that says why something runs in plain torch."""

from __future__ import annotations

import logging

_log = logging.getLogger(f"{__package__}.program")
_said: set[tuple[str, str]] = set()  # what has been logged


def say(name: str, reason: str, kind: str | None = None) -> None:
    """Log why a program runs in plain torch, once for a reason or a kind of reasons."""
    reason = " ".join(reason.split())[:600]
    told = name, reason if kind is None else kind
    if told not in _said:
        _said.add(told)
        _log.warning("%s runs in plain torch, slower: %s", name, reason)
