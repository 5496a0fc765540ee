"""The interface of a tracker."""

from __future__ import annotations

from abc import ABC, abstractmethod

from ..run import Run


class Tracker(ABC):
    """Takes finished runs elsewhere: to event files, a server, a notebook.

    Example:
        >>> class Lines(Tracker):
        ...     def record(self, run):
        ...         with open("results.txt", "a") as file:
        ...             print(run.settings["kernel"], run.metrics["ball_error"], file=file)

        In `mine.py`, it is used by `staf tracker=custom tracker.path=mine.Lines`.

    One is made before the first run, so that the constructor can refuse by a ValueError, and one for each job
    that ended. An error of `record` is a warning in the log: the results are on the disk all the same.
    """

    @abstractmethod
    def record(self, run: Run) -> None:
        """Take in a completed run, once: with many members, each of them."""
