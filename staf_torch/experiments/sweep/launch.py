"""The batched launcher at work: jobs that may share a tensor batch are solved together, then every job is
replayed through Hydra's own `run_job`, which gives it its directory, `.hydra/`, log, callbacks and status."""

from __future__ import annotations

import contextlib
import functools
import gc
import inspect
import logging
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.utils import JobReturn, JobStatus, configure_log, filter_overrides, run_job, setup_globals
from omegaconf import DictConfig, open_dict

from ..._checks import integer
from ..progress import listening
from ..wording import reason
from . import handoff, records
from .composed import ComposeOnce
from .executors import executor, work
from .objective import objective
from .progress import SweepProgress

_log = logging.getLogger(__name__)


class Job(NamedTuple):
    """A job that is to run."""

    num: int
    overrides: list[str]
    config: DictConfig  # with Hydra's node
    settings: DictConfig  # without

    @property
    def name(self) -> str:
        """`job 3 (kernel=gaussian seed=1)`."""
        return f"job {self.num} ({' '.join(records.own(filter_overrides(self.overrides)))})"

    @property
    def directory(self) -> Path:
        """Of the run."""
        return Path(str(self.config.hydra.sweep.dir)) / str(self.config.hydra.sweep.subdir)


class Launch:
    """One call of Hydra's: a list of jobs to run.

    Args:
        launcher: the plugin, with its settings and what Hydra set up.
    """

    def __init__(self, launcher: Any) -> None:
        self._launcher, self._context = launcher, launcher.hydra_context
        self._task: Callable[[DictConfig], Any] = launcher.task_function
        self._master: DictConfig = launcher.config
        self._directory = Path(str(self._master.hydra.sweep.dir))
        self._progress = SweepProgress(0)
        if launcher.batch is not None:
            integer("hydra.launcher", "batch", launcher.batch, least=1)

    def run(self, job_overrides: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        """The returns of the jobs, in order."""
        with _seldom_collecting():
            return self._run(job_overrides, first)

    def _run(self, job_overrides: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        setup_globals()
        self._hydra_logging()
        self._directory.mkdir(parents=True, exist_ok=True)
        numbered = {first + i: list(overrides) for i, overrides in enumerate(job_overrides)}
        records.list_jobs(self._directory, numbered)
        jobs = [self._compose(num, overrides) for num, overrides in numbered.items()]
        returns = self._finished(jobs)
        self._progress = SweepProgress(len(jobs), len(returns))
        try:
            with contextlib.closing(self._solved(jobs, set(returns))) as solved_jobs:
                for job, solved in solved_jobs:
                    returns[job.num] = self._replay(job, solved)
        finally:
            self._progress.close()
            self._hydra_logging()
        failed = sum(ended.status == JobStatus.FAILED for ended in returns.values())
        _log.info("%d of %d jobs completed, %d failed", len(jobs) - failed, len(jobs), failed)
        return [returns[num] for num in numbered]

    def _solved(
        self, jobs: list[Job], finished: set[int]
    ) -> Generator[tuple[Job, handoff.Solved | None], None, None]:
        """Every job that is not finished with what was computed for it, as the tensor batches end.

        A batch of which some jobs are finished is computed as a whole: rounding depends on the others in it,
        and a sweep that was interrupted ends with the very numbers that it would have had.
        """
        if not handoff.is_marked(self._task):  # another program's task: nothing to batch
            yield from ((job, None) for job in jobs)
            return
        if len(finished) == len(jobs):
            return
        about = self._launcher
        with executor(about.executor, about.workers, about.arguments, self._directory) as workers:
            batches = self._batches(jobs, workers.pieces)
            batches = [batch for batch in batches if not finished.issuperset(job.num for job in batch)]
            _log.info("%d jobs in %d tensor batches, %s", len(jobs), len(batches), self._directory)
            done = workers.map([_work(batch) for batch in batches])
            self._progress.expect([sum(job.num not in finished for job in batch) for batch in batches])
            with listening(self._progress.part):
                for number, (outcomes, seconds) in done:
                    batch = batches[number]
                    self._progress.solved(number)
                    for job, outcome in zip(batch, outcomes, strict=True):
                        if job.num not in finished:
                            yield job, handoff.Solved(outcome, seconds / len(batch))
                    self._hydra_logging()  # what follows belongs to no job's log

    def _replay(self, job: Job, solved: handoff.Solved | None) -> JobReturn:
        with handoff.handed(solved):
            ended = run_job(
                hydra_context=self._context,
                task_function=self._task if solved is None else _off_the_terminal(self._task),
                config=job.config,
                job_dir_key="hydra.sweep.dir",
                job_subdir_key="hydra.sweep.subdir",
            )
        failure = ended._return_value if ended.status == JobStatus.FAILED else None
        self._progress.ended(job.name, None if failure is None else reason(failure))
        return ended

    def _finished(self, jobs: list[Job]) -> dict[int, JobReturn]:
        """The jobs that an earlier start of this sweep completed."""
        found: dict[int, JobReturn] = {}
        if not records.resumed(self._master):
            return found
        for job in jobs:
            metrics = records.metrics_of(job.directory, job.overrides)
            if metrics is not None:
                ended = JobReturn(overrides=job.overrides, status=JobStatus.COMPLETED)
                ended.return_value = objective(self._master, metrics)
                found[job.num] = ended
        return found

    def _compose(self, num: int, overrides: list[str]) -> Job:
        loader = self._context.config_loader
        assert isinstance(loader, ComposeOnce)
        config = loader.take(self._master, overrides)
        with open_dict(config):
            config.hydra.job.id = str(num)
            config.hydra.job.num = num
        return Job(num, overrides, config, records.without_hydra(config))

    def _batches(self, jobs: list[Job], pieces: int) -> list[list[Job]]:
        """The jobs of every tensor batch: in order, and at least so many batches where that can be."""
        from .. import members

        settings = [job.settings for job in jobs]
        groups, found = members.groups(settings), []
        for group in groups:
            most = min(self._launcher.batch or len(group), -(-len(group) * len(groups) // pieces))
            for chunk in members.chunks(settings, group):
                found += [chunk[i : i + most] for i in range(0, len(chunk), most)]
        return [[jobs[i] for i in chunk] for chunk in sorted(found)]

    def _hydra_logging(self) -> None:
        trusted = {}
        if "execution_whitelist" in inspect.signature(configure_log).parameters:  # Hydra 1.4
            trusted = {"execution_whitelist": self._context.execution_whitelist}
        configure_log(self._master.hydra.hydra_logging, self._master.hydra.verbose, **trusted)


@contextlib.contextmanager
def _seldom_collecting() -> Iterator[None]:
    """Hydra copies configurations a dozen times a job, and Python would look through all of them for cycles
    after every few: a fifth of the time of a sweep."""
    before = gc.get_threshold()
    gc.freeze()  # the half a million objects of torch are here to stay
    gc.set_threshold(200_000, 50, 50)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


def _work(batch: Sequence[Job]) -> work.Batch:
    return work.Batch([job.settings for job in batch], [str(job.directory) for job in batch])


def _off_the_terminal(task: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """The task with its log in its file alone: a hundred summaries would bury the line of progress."""

    @functools.wraps(task)
    def quiet(cfg: DictConfig) -> Any:
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.StreamHandler) and not isinstance(handler, logging.FileHandler):
                handler.setLevel(logging.CRITICAL + 1)
        return task(cfg)

    return quiet
