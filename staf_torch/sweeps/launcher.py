"""The batched launcher at work: jobs that may share a tensor batch are solved together, then every job is
replayed as Hydra runs one, with directory, `.hydra/`, log, callbacks and status, or has a row in a table."""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from ..lanes.compilation.compiler import compiler
from ..numerics.checks import choice, integer
from ..results import run_record as records
from ..results.files import METRICS, ROWS, RUN, partial_name
from ..signs import Pace, Progress, Sign, write
from . import lock, table, workers
from .executors import Executor, compute, executor
from .hydra_compat import Job, JobReturn, JobStatus, Plan, SweepJobs, filter_overrides
from .job import PRINTS, Outcome, execute, objective, reason, silence_terminal

_log = logging.getLogger(__name__)
Task = Callable[[DictConfig], Any]

_FOREIGN = ("run", "warn", "refuse")
_NOT_BATCHED = (
    "the jobs of this program cannot share tensor batches, which only the experiments of `staf` can; "
    "they run one by one. hydra/launcher=joblib runs them side by side"
)
_TOLD = 20  # failures of different reasons that are told as they happen
_ALIKE = 8  # jobs that fail alike, whatever is swept, end a sweep


@contextlib.contextmanager
def _collecting_seldom() -> Iterator[None]:
    """Search for garbage rarely: a job copies settings a dozen times, and searches are a tenth of a sweep."""
    before, frozen = gc.get_threshold(), gc.get_freeze_count()
    if not frozen:
        gc.freeze()  # torch's half a million objects stay anyway
    gc.set_threshold(20_000, 5, 5)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if not frozen:
            gc.unfreeze()


class SweepProgress:
    """Jobs that are done (some from before) and that failed, and the time left, on stderr."""

    def __init__(self, total: int, done: int = 0) -> None:
        self._total, self._before, self._done, self._failed = total, done, done, 0
        self._reasons: dict[str, tuple[str, int]] = {}  # the first job that failed so, and how many more did
        self._computed, self._running = 0.0, 0.0
        self._pace = Pace()
        # Not the log: while a job is replayed, that is the job's own.
        self._sign = Sign(lambda: self.line, total, log=False)
        self._sign.__enter__()

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
            first, more = self._reasons.get(failure, (name, -1))
            if more >= 0 or len(self._reasons) < _TOLD:
                self._reasons[failure] = first, more + 1
            if more < 0 and failure in self._reasons:
                write(f"{name} failed: {failure}")
        self._show()

    def close(self) -> None:
        """Wipe the bar, and say how many jobs failed like one that was told."""
        self._sign.__exit__()
        for first, more in self._reasons.values():
            if more:
                sys.stderr.write(f"{more} more failed like {first}\n")

    @property
    def line(self) -> str:
        """`37 of 100 jobs done, 1 failed, 12 s left`."""
        failed = f", {self._failed} failed" if self._failed else ""
        left = self._pace.left(1.0) if self._share < 1 else None
        told = "" if left is None else f", {left:.0f} s left"
        return f"{self._done} of {self._total} jobs done{failed}{told}"

    @property
    def _share(self) -> float:
        """Share of the jobs that were left to do."""
        computed = max(self._computed, self._done - self._before + self._running)
        return min(1.0, computed / max(1, self._total - self._before))

    def _show(self) -> None:
        self._sign.done = self._share * self._total
        self._pace.note(self._share, 1.0)


def job_name(num: int, overrides: Sequence[str]) -> str:
    """Return `job 3 (kernel=gaussian seed=1)`."""
    return f"job {num} ({' '.join(records.own(filter_overrides(overrides)))})"


class AlikeFailures:
    """Failures that have nothing to do with what is swept: all jobs so far have one reason.

    It gets the overrides of all jobs, and the number of the first.
    """

    def __init__(self, jobs: Sequence[Sequence[str]], first: int = 0) -> None:
        self._jobs, self._first = jobs, first
        self._reason: str | None = None
        self._failed = list[int]()
        self._possible = True

    def ended(self, num: int, failure: str | None) -> None:
        """Note the end of a job.

        Raises:
            ValueError: if `_ALIKE` jobs failed with this reason, no other has ended, and each override that
                differs among the jobs differs among those; others are left.
        """
        self._possible = self._possible and failure is not None and self._reason in (None, failure)
        if not self._possible:  # one job went well, or failed otherwise
            return
        self._reason = failure
        self._failed.append(num - self._first)
        if len(self._failed) % _ALIKE or len(self._failed) == len(self._jobs):
            return
        if _differing(self._jobs) == _differing(self._jobs[failed] for failed in self._failed):
            left = len(self._jobs) - len(self._failed)
            raise ValueError(
                f"{len(self._failed)} jobs failed with the same error, the other {left} were not run: "
                f"{failure}"
            )


def _differing(jobs: Iterable[Sequence[str]]) -> set[int]:
    """Return which places of the overrides hold more than one text."""
    values: list[set[str]] = []
    for job in jobs:
        values += [set() for _ in job[len(values) :]]
        for seen, line in zip(values, job, strict=False):
            if len(seen) < 2:
                seen.add(line)
    return {place for place, seen in enumerate(values) if len(seen) > 1}


class Launch:
    """A call by Hydra: a list of jobs to run, by the launcher's settings and what Hydra set up."""

    def __init__(self, launcher: Any) -> None:
        self._launcher = launcher
        self._jobs: SweepJobs = launcher.hydra_context.config_loader
        self._task: Task = launcher.task_function
        self._directory = Path(str(launcher.config.hydra.sweep.dir))
        self._directories: dict[int, Path] = {}  # of the jobs that ran
        if launcher.batch is not None:
            integer("hydra.launcher", "batch", launcher.batch, least=1)
        choice("hydra.launcher", "foreign", launcher.foreign, _FOREIGN)
        self.in_table = records.in_table(self._jobs.master)
        if self._task is not execute and (launcher.foreign == "refuse" or self.in_table):
            why = "sweep.records=table" if self.in_table else "hydra.launcher.foreign=refuse"
            raise ValueError(f"`{why}`: {_NOT_BATCHED}")
        if self.in_table and not self._jobs.at_once:
            raise ValueError(
                "`sweep.records=table` needs all jobs at once: hydra/sweeper=basic without max_batch_size."
            )

    def begin(self) -> None:
        """Open the log of the sweep, and refuse a directory that has records of the other kind.

        Raises:
            ValueError: if it has.
        """
        self._jobs.start()
        if not PRINTS.get():
            silence_terminal()
        self._refuse_the_other_kind()

    def _refuse_the_other_kind(self) -> None:
        """Raise ValueError if a sweep of directories is resumed as a table, or the other way round."""
        names = (ROWS, partial_name(ROWS))
        rows = any((self._directory / name).exists() for name in names)
        runs = next(self._directory.glob(f"*/{RUN}"), None) is not None
        if (runs and self.in_table) or (rows and not self.in_table):
            raise ValueError(
                f"{self._directory} was begun with the other value of `sweep.records`, which a sweep keeps."
            )

    def _executor(self) -> Executor:
        about = self._launcher
        return executor(about.executor, about.workers, about.arguments, self._directory)

    def fill_table(self, jobs: Sequence[Sequence[str]]) -> None:
        """Run the jobs, which leave rows of a table; raise ValueError if one failed, when all have ended."""
        progress = SweepProgress(len(jobs))
        done, failed, alike = 0, [], AlikeFailures(jobs)

        def ended(num: int, failure: str | None) -> None:
            nonlocal done
            done += 1
            self._still_there(done, len(jobs))
            name = "" if failure is None else job_name(num, jobs[num])
            progress.ended(name, failure)
            alike.ended(num, failure)
            if failure is not None:
                failed.append((num, failure))

        with contextlib.closing(progress), self._executor() as executor:
            most = self._launcher.batch
            table.fill(
                self._jobs, jobs, self._directory, executor, most=most, ended=ended, tell=progress.computed
            )
        _log.info("%d of %d jobs completed, %d failed", done - len(failed), len(jobs), len(failed))
        if failed:
            num, why = failed[0]
            raise ValueError(f"{len(failed)} of {len(jobs)} jobs failed; {job_name(num, jobs[num])}: {why}")

    def fill_directories(self, jobs: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        """Run the jobs, numbered from ``first``, and return Hydra's records of them, in order."""
        numbered = {first + i: list(one) for i, one in enumerate(jobs)}
        plan = self._jobs.many(list(numbered.values()))  # before anything is written
        self._jobs.refuse_shared(numbered)
        self._directory.mkdir(parents=True, exist_ok=True)
        records.list_jobs(self._directory, numbered)
        returns = self._finished(numbered, plan)
        progress = SweepProgress(len(numbered), len(returns))
        alike = AlikeFailures(list(numbered.values()), min(numbered, default=0))
        if returns:
            alike.ended(min(returns), None)
        index = {num: i for i, num in enumerate(numbered)}
        with contextlib.closing(progress), contextlib.ExitStack() as stack, _collecting_seldom():
            for num, task in self._tasks(numbered, plan, set(returns), progress, stack):
                workers.check()
                self._still_there(len(returns), len(numbered))
                returns[num] = self._replay(task, Job(self._jobs, num, numbered[num], plan, index[num]))
                wrong = returns[num].status == JobStatus.FAILED
                why = reason(returns[num]._return_value) if wrong else None
                progress.ended(job_name(num, numbered[num]), why)
                alike.ended(num, why)
        self._refuse_lost(numbered, returns)
        failed = sum(ended.status == JobStatus.FAILED for ended in returns.values())
        _log.info("%d of %d jobs completed, %d failed", len(numbered) - failed, len(numbered), failed)
        return [returns[num] for num in numbered]

    def _replay(self, task: Task, job: Job) -> JobReturn:
        """Run a job whose outcome is known as Hydra runs one, and keep no settings of it."""
        self._directories[job.num] = job.directory
        ended = self._jobs.run(task, job)
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

    def _finished(self, numbered: Mapping[int, list[str]], plan: Plan) -> dict[int, JobReturn]:
        """Return the jobs that an earlier start of this sweep completed."""
        found: dict[int, JobReturn] = {}
        if not records.resumed(self._jobs.master):
            return found
        for index, (num, overrides) in enumerate(numbered.items()):
            job = Job(self._jobs, num, overrides, plan, index)
            record = records.RunRecord(job.settings, job.prepared.choices, overrides, compiler(), job.flat)
            metrics = record.finished_before(job.directory)
            if metrics is not None:
                found[num] = JobReturn(overrides=overrides, status=JobStatus.COMPLETED)
                found[num].return_value = objective(self._jobs.master, metrics)
        return found

    def _tasks(
        self,
        numbered: Mapping[int, list[str]],
        plan: Plan,
        finished: set[int],
        progress: SweepProgress,
        stack: contextlib.ExitStack,
    ) -> Iterator[tuple[int, Task]]:
        """Return number and task of every job that is not finished, as the tensor batches end.

        What computes them is given back as the ``stack`` ends.
        """
        order, about = list(numbered), self._launcher
        if self._task is not execute:
            if about.foreign == "warn":
                _log.warning("%s (hydra.launcher.foreign=run switches this warning off)", _NOT_BATCHED)
            return ((num, self._task) for num in order)
        if len(finished) == len(order):
            return iter(())

        def task(computed: tuple[int, Outcome, float]) -> tuple[int, Task]:
            index, outcome, seconds = computed
            return order[index], _off_the_terminal(outcome, seconds, Progress(progress.running))

        outcomes = compute(
            *plan,
            lambda index: self._jobs.directory(order[index], numbered[order[index]]),
            stack.enter_context(self._executor()),
            finished={i for i, num in enumerate(order) if num in finished},
            most=about.batch,
            tell=progress.computed,
        )
        return map(task, outcomes)


def _off_the_terminal(outcome: Outcome, seconds: float, progress: Progress) -> Task:
    """Return the task of a computed job, logging to its file alone: summaries would bury the bar."""

    @functools.wraps(execute)
    def quiet(cfg: DictConfig) -> Any:
        silence_terminal()
        return execute(cfg, outcome, seconds, progress)

    return quiet
