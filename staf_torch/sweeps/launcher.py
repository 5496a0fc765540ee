"""The batched launcher at work: jobs that may share a tensor batch are solved together, then every job is
replayed as Hydra runs one: with its directory, `.hydra/`, log, callbacks and status."""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import sys
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig
from tqdm.auto import tqdm

from ..lanes.compiler import compiler
from ..numerics.checks import choice, integer
from ..results import run_record as records
from ..results.files import METRICS
from ..results.progress import Progress
from . import lock, signals
from .batching import Flat, Outcome, flat_or_none, reason
from .executors import compute, executor
from .hydra_compat import (
    JobReturn,
    JobStatus,
    SweepJobs,
    directory_of,
    search_paths,
    without_hydra_overrides,
)
from .job import PRINTS, InWorker, Origin, execute, objective, silence_terminal
from .lazy import Lazy, T

_log = logging.getLogger(__name__)

_FOREIGN = ("run", "warn", "refuse")
_NOT_BATCHED = (
    "the jobs of this program cannot share tensor batches, which only the experiments of `staf` can; "
    "they run one by one. hydra/launcher=joblib runs them side by side"
)
_KEPT_JOBS = 128  # as many as a batch has
_BAR_EVERY, _LINE_EVERY = 0.2, 10.0  # s


@contextlib.contextmanager
def _collecting_seldom() -> Iterator[None]:
    """Collect garbage seldom: configurations refer to their parents, and a sweep makes some hundred thousand
    objects of them; Python would look through all of torch's after every few, a fifth of the sweep's time."""
    before, frozen = gc.get_threshold(), gc.get_freeze_count() > 0
    if not frozen:  # what a program has frozen itself cannot be told apart afterwards
        gc.freeze()
    gc.set_threshold(20_000, 5, 5)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if not frozen:
            gc.unfreeze()


class SweepProgress:
    """Jobs that are done and that failed, and the time left, on stderr.

    Args:
        total: jobs.
        done: of them, from before.
    """

    def __init__(self, total: int, done: int = 0) -> None:
        self._total, self._before, self._done, self._failed = total, done, done, 0
        self._computed, self._running = 0.0, 0.0
        self._start = self._shown = time.monotonic()
        # Not the log: while a job is replayed, that is the job's own.
        layout = "{percentage:3.0f}%|{bar:30}| {desc}"
        self._bar = tqdm(total=total, bar_format=layout, leave=False, disable=None)

    def computed(self, jobs: float) -> None:
        """Note how many of the jobs that were left are computed, with or without their files."""
        self._computed = jobs
        self._show()

    def running(self, share: float) -> None:
        """Note the share that is done of a job that runs alone."""
        self._running = share
        self._show()

    def ended(self, name: str, failure: str | None) -> None:
        """Note that one more job has its run directory; ``failure`` says why it has no result."""
        self._done, self._running = self._done + 1, 0.0
        if failure is not None:
            self._failed += 1
            tqdm.write(f"{name} failed: {failure}", file=sys.stderr)
        self._show()

    def close(self) -> None:
        """Wipe the bar."""
        self._bar.close()

    @property
    def line(self) -> str:
        """`37 of 100 jobs done, 1 failed, 12 s left`."""
        failed = f", {self._failed} failed" if self._failed else ""
        share = self._share
        spent = time.monotonic() - self._start
        left = f", {spent * (1 - share) / share:.0f} s left" if 0 < share < 1 else ""
        return f"{self._done} of {self._total} jobs done{failed}{left}"

    @property
    def _share(self) -> float:
        """Share of the jobs that were left to do."""
        computed = max(self._computed, self._done - self._before + self._running)
        return min(1.0, computed / max(1, self._total - self._before))

    def _show(self) -> None:
        now = time.monotonic()
        if now - self._shown < (_LINE_EVERY if self._bar.disable else _BAR_EVERY):
            return
        self._shown = now
        if self._bar.disable:
            sys.stderr.write(self.line + "\n")
            sys.stderr.flush()
            return
        self._bar.n = self._share * self._total
        self._bar.set_description_str(self.line)


class Job(NamedTuple):
    """A job that is to run."""

    num: int
    overrides: list[str]
    settings: DictConfig  # as the task sees them, without Hydra's node

    @property
    def name(self) -> str:
        """`job 3 (kernel=gaussian seed=1)`."""
        return job_name(self.num, self.overrides)


def job_name(num: int, overrides: Sequence[str]) -> str:
    """Return `job 3 (kernel=gaussian seed=1)`."""
    return f"job {num} ({' '.join(records.own(without_hydra_overrides(overrides)))})"


class Launch:
    """One call of Hydra's: a list of jobs to run.

    Args:
        launcher: the plugin, with its settings and what Hydra set up.
    """

    def __init__(self, launcher: Any) -> None:
        self._launcher = launcher
        self._jobs: SweepJobs = launcher.hydra_context.config_loader
        self._task: Callable[[DictConfig], Any] = launcher.task_function
        self._directory = Path(str(launcher.config.hydra.sweep.dir))
        self._numbered = self._jobs.numbered
        self._directories: dict[int, Path] = {}  # of the jobs that ran
        if launcher.batch is not None:
            integer("hydra.launcher", "batch", launcher.batch, least=1)
        choice("hydra.launcher", "foreign", launcher.foreign, _FOREIGN)
        if self._task is not execute and launcher.foreign == "refuse":
            raise ValueError(f"`hydra.launcher.foreign=refuse`: {_NOT_BATCHED}")

    @_collecting_seldom()
    def run(self, job_overrides: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        """Run the jobs, numbered from ``first``, and return Hydra's records of them, in order."""
        self._jobs.start()
        if not PRINTS.get():
            silence_terminal()
        self._directory.mkdir(parents=True, exist_ok=True)
        numbered = {first + i: list(overrides) for i, overrides in enumerate(job_overrides)}
        records.list_jobs(self._directory, numbered)
        returns = self._finished(numbered)
        progress = SweepProgress(len(numbered), len(returns))
        try:
            with contextlib.closing(self._computed(numbered, set(returns), progress)) as computed:
                for job, task in computed:
                    signals.check()
                    self._still_there(len(returns), len(numbered))
                    ended = self._replay(job, task)
                    failure = ended._return_value if ended.status == JobStatus.FAILED else None
                    progress.ended(job.name, None if failure is None else reason(failure))
                    returns[job.num] = ended
        finally:
            progress.close()
        self._refuse_lost(numbered, returns)
        failed = sum(ended.status == JobStatus.FAILED for ended in returns.values())
        _log.info("%d of %d jobs completed, %d failed", len(numbered) - failed, len(numbered), failed)
        return [returns[num] for num in numbered]

    def _replay(self, job: Job, task: Callable[[DictConfig], Any]) -> JobReturn:
        """Run a job whose outcome is known as Hydra runs one, and keep no settings of it."""
        config = self._jobs.whole(job.num, job.overrides)
        self._directories[job.num] = self._place_of(job)
        ended = self._jobs.run(task, config, job.settings)
        ended.cfg = ended.hydra_cfg = None
        return ended

    def _still_there(self, done: int, jobs: int) -> None:
        """Raise OSError if the directory of the sweep was taken away: nobody wants it made anew."""
        own = lock.held(self._directory)
        if own is not None and own.lost():
            raise ValueError(
                f"{self._directory} was removed or replaced while its sweep went on: stopped when {done} of "
                f"{jobs} jobs were done, and those are lost."
            )

    def _refuse_lost(self, numbered: Mapping[int, list[str]], returns: Mapping[int, JobReturn]) -> None:
        """Turn jobs whose results have gone since they ended into failed ones."""
        self._still_there(len(returns), len(numbered))
        for num, directory in self._directories.items():
            ended = returns[num]
            complete = self._task is execute and ended.status == JobStatus.COMPLETED
            if complete and not (directory / METRICS).exists():
                name = job_name(num, numbered[num])
                error = ValueError(f"the results of {name} are not in {directory} any more")
                sys.stderr.write(f"{name} failed: {error}\n")
                ended.status, ended.return_value = JobStatus.FAILED, error

    def _whole(self, job: Job) -> InWorker | None:
        """Return what runs a job of many members in a worker, None for other jobs."""
        if job.settings.get("members") is None:
            return None
        config = self._jobs.whole(job.num, job.overrides)
        return InWorker(Origin.of(config.hydra), search_paths())

    def _flat(self, overrides: Sequence[str]) -> Flat | None:
        """Return the settings of a job by dotted keys."""
        return flat_or_none(self._jobs.settings(overrides))

    def _place_of(self, job: Job) -> Path:
        """Return the run directory of a job."""
        if self._numbered and not any(line.lstrip("+~").startswith("hydra") for line in job.overrides):
            return self._directory / str(job.num)
        return directory_of(self._jobs.whole(job.num, job.overrides))

    def _finished(self, numbered: Mapping[int, list[str]]) -> dict[int, JobReturn]:
        """Return the jobs that an earlier start of this sweep completed."""
        found: dict[int, JobReturn] = {}
        if not records.resumed(self._jobs.master):
            return found
        anyway = records.resumed_anyway(self._jobs.master)
        for num, overrides in numbered.items():
            settings = self._jobs.settings(overrides)
            config = self._jobs.whole(num, overrides)
            record = records.RunRecord(settings, config.hydra.runtime.choices, overrides, compiler())
            metrics = record.finished(directory_of(config), anyway=anyway)
            if metrics is not None:
                ended = JobReturn(overrides=overrides, status=JobStatus.COMPLETED)
                ended.return_value = objective(self._jobs.master, metrics)
                found[num] = ended
        return found

    def _computed(
        self, numbered: Mapping[int, list[str]], finished: set[int], progress: SweepProgress
    ) -> Generator[tuple[Job, Callable[[DictConfig], Any]], None, None]:
        """Yield every job that is not finished with the task that ends it, as the tensor batches end."""
        order, about = list(numbered), self._launcher

        @functools.lru_cache(_KEPT_JOBS)
        def job(index: int) -> Job:
            num = order[index]
            return Job(num, numbered[num], self._jobs.settings(numbered[num]))

        if self._task is not execute:
            if about.foreign == "warn":
                _log.warning("%s (hydra.launcher.foreign=run says nothing)", _NOT_BATCHED)
            yield from ((job(index), self._task) for index in range(len(order)))
            return
        if len(finished) == len(order):
            return

        def each(make: Callable[[int], T]) -> Lazy[T]:
            return Lazy(len(order), make)

        with executor(about.executor, about.workers, about.arguments, self._directory) as workers:
            outcomes = compute(
                each(lambda index: job(index).settings),
                each(lambda index: self._place_of(job(index))),
                workers,
                flat=each(lambda index: self._flat(numbered[order[index]])),
                finished={i for i, num in enumerate(order) if num in finished},
                whole=() if about.executor == "inline" else each(lambda index: self._whole(job(index))),
                most=about.batch,
                tell=progress.computed,
            )
            for index, outcome, seconds in outcomes:
                yield job(index), _off_the_terminal(outcome, seconds, Progress(progress.running))


def _off_the_terminal(outcome: Outcome, seconds: float, progress: Progress) -> Callable[[DictConfig], Any]:
    """Return the task of a computed job, logging to its file alone: summaries would bury the bar."""

    @functools.wraps(execute)
    def quiet(cfg: DictConfig) -> Any:
        silence_terminal()
        return execute(cfg, outcome, seconds, progress)

    return quiet
