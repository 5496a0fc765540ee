"""The jobs of a sweep as tensor batches, and what becomes of each as the batches end."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Generator, Sequence
from pathlib import Path

from omegaconf import DictConfig

from ...experiments.registry import Experiment
from ...results.progress import Progress
from ...settings.plain import ManySettings
from ..batching import Batch, Flat, Outcome, batches, flat_or_none
from ..lazy import Lazy
from .base import Executor

_log = logging.getLogger(__name__)


def compute(
    settings: Sequence[DictConfig],
    directories: Sequence[Path],
    workers: Executor,
    *,
    finished: Collection[int] = frozenset(),
    most: int | None = None,
    flat: Sequence[Flat | None] | None = None,
    whole: Sequence[Experiment | None] = (),
    tell: Callable[[float], None],
) -> Generator[tuple[int, Outcome, float], None, None]:
    """Yield index, outcome and seconds of every job that is not finished, as the tensor batches end.

    A batch of which some jobs are finished is computed as a whole: rounding depends on the others in it, and
    a sweep that was interrupted ends with the very numbers that it would have had.

    Args:
        settings: of every job.
        directories: of every run.
        workers: compute the batches.
        finished: indices of jobs that need no outcome.
        most: jobs of a batch at most.
        flat: what `flat_or_none` makes of the settings of every job, where somebody has that already.
        whole: runs a job of many members in a worker, None for other jobs; empty: no worker runs any.
        tell: is told how many jobs are computed, with fractions while this process computes a batch.
    """
    done = 0
    flat = [flat_or_none(settings[i]) for i in range(len(settings))] if flat is None else flat
    planned = batches(flat, least=workers.pieces, most=most)
    planned = [batch for batch in planned if not set(finished).issuperset(batch)]
    _log.info("%d jobs in %d tensor batches", len(settings), len(planned))

    def batch(number: int) -> Batch:
        jobs = planned[number]
        places = [os.path.abspath(directories[i]) for i in jobs]  # a worker may have another folder
        some = settings.of(jobs) if isinstance(settings, ManySettings) else [settings[i] for i in jobs]
        return Batch(some, places, [whole[i] for i in jobs] if whole else ())

    wanted = [[i for i in batch if i not in finished] for batch in planned]
    left = [len(batch) for batch in wanted]
    listening = Progress(lambda share: tell(done + share * next(filter(None, left), 0)))
    for number, (outcomes, seconds) in workers.map(Lazy(len(planned), batch), listening):
        done, left[number] = done + left[number], 0
        tell(done)
        found = dict(zip(planned[number], outcomes, strict=True))
        for index in wanted[number]:
            yield index, found[index], seconds / len(outcomes)
