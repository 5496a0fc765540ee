"""One run as it is read back: what it was, how it ended, what it measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from .overrides import Value

COMPLETED, FAILED, RUNNING, UNFINISHED = "completed", "failed", "running", "unfinished"
"""Of a run: it ended, it raised, it has not said that it ended, or there is no word of its end."""
ABOUT = ("task", "status", "reason", "seconds", "version", "directory", "member")
"""What can be a column beside settings and metrics."""


@dataclasses.dataclass(frozen=True)
class Run:
    """A run, or a member of a run of many."""

    directory: Path
    overrides: Mapping[str, Value]  # key -> value, as typed
    settings: Mapping[str, Value]  # all of them, with dotted keys; the option of a group under its name
    metrics: Mapping[str, float | None]  # None: nothing to report, or not finite
    status: str
    reason: str | None = None  # why there is no result, or something else that a reader should know
    member: int | None = None  # its number among the members of a run of many
    version: str | None = None  # of the staf_torch that wrote it
    task: str | None = None
    seconds: float | None = None
    lost: Mapping[str, str] = dataclasses.field(default_factory=dict)  # metric -> what stood there instead

    def setting(self, key: str) -> Value:
        """The setting of that key, as composed where that is known, else as typed."""
        return self.settings[key] if key in self.settings else self.overrides.get(key)

    def value(self, key: str) -> Value:
        """Anything about the run that has a name: a metric, one of `ABOUT`, or a setting."""
        if key in self.metrics:
            return self.metrics[key]
        if key in ABOUT:
            found = getattr(self, key)
            return str(found) if isinstance(found, Path) else found
        return self.setting(key)

    def absence(self, metric: str) -> str:
        """Why there is no number under that metric."""
        if metric in self.lost:
            return f"was {self.lost[metric]}, which is not a number"
        if self.reason is not None:
            return self.reason
        if metric in self.metrics:
            return "not finite, or nothing to report"
        return "this run has no such metric"
