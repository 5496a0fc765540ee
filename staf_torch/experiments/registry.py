"""The interface of experiments, and those that the setting `task` knows by name.

An experiment of your own needs no change here. Write a function or a class in a module that Python can import
(the working directory counts), and a YAML file that names it, in a folder of your own::

    # mine.py
    def energy(cfg, directory, progress=None):
        run = RunDirectory(directory)                # staf_torch.results.run_directory
        return run.metrics({"energy": float(cfg.initial_state[0]) ** 2})

    # my_conf/experiment/energy.yaml
    # @package _global_
    task: mine.energy

Then `staf --config-dir my_conf experiment=energy` runs the experiment and `staf -m --config-dir my_conf
experiment=energy seed=0,1` sweeps it; `hydra.searchpath=[file://my_conf]` does what `--config-dir` does.
`energy.held = ...`, a function of the settings, lets it have a dry run (`study`).
Derive a class from `BatchedExperiment` where many jobs can be computed as one tensor batch; `in_calls` then
makes one call of jobs whose objects differ in numbers alone.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..lanes.dependencies.contents import Contents
from ..lanes.per_row.objects import merged
from ..lanes.row_numbers import some_rows
from ..numerics.checks import COMMAND_LINE, choice, fail
from ..results.files import grouped
from ..signs import SHOWN, Progress

_log = logging.getLogger(__name__)

Metrics = dict[str, float | None]
"""Name to number; None where there is nothing finite to report."""


def finite(number: float | Tensor | None) -> float | None:
    """Return a number as `metrics.json` holds it: None where it is not finite."""
    return float(number) if number is not None and math.isfinite(number) else None


def log_slope(x: Sequence[float], y: Sequence[float | None], above: float = 0.0) -> float | None:
    """Return d log(y) / d log(x) by least squares over the points with y > above; None for fewer than two."""
    points = [(math.log(p), math.log(q)) for p, q in zip(x, y, strict=True) if q is not None and q > above]
    if len(points) < 2:
        return None
    log_x, log_y = np.array(points).T
    return float(np.polyfit(log_x, log_y, 1)[0])


class Experiment(Protocol):
    """A study: a function, or an object that is called like one."""

    def __call__(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        """Run what the settings (all but Hydra's) describe, fill the run directory, which exists, and return
        what `metrics.json` holds; that file comes last.

        Raises ValueError if a setting breaks its rule.
        """
        ...


class Solution(Protocol):
    """A problem that is solved and has left nothing on disk yet. It can be pickled."""

    @property
    def metrics(self) -> Metrics:
        """Return the content of `metrics.json`."""
        ...


S = TypeVar("S", bound=Solution)


@functools.lru_cache(4096)  # a sweep asks for each setting of each job
def _with_groups(name: str) -> tuple[str, ...]:
    """A dotted name, and ``group.*`` for every group that it is in."""
    return name, *(f"{name[:i]}.*" for i, letter in enumerate(name) if letter == ".")


def _form(value: object) -> object:
    """Return the word "number" for a number, lists entry by entry, anything else itself in a list."""
    if isinstance(value, list):
        return [_form(entry) for entry in value]
    return "number" if isinstance(value, int | float) and not isinstance(value, bool) else [value]


class BatchedExperiment(ABC, Generic[S]):
    """An experiment that solves many configurations as one tensor batch and writes each by itself.

    Configurations share a batch where they differ in numbers of `batchable` settings alone and `shape` is
    equal. What a member gets must not depend on the others.
    """

    animates: ClassVar[bool] = False  # whether the setting `animation` has a meaning
    batchable: ClassVar[frozenset[str]]
    """Settings, dotted, whose numbers may differ within a batch; ``kernel.*``: all that a kernel has, also
    one of a user's own."""

    @abstractmethod
    def __call__(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        """Run one configuration; see `Experiment`."""

    @abstractmethod
    def solve(self, cfgs: Sequence[DictConfig], progress: Progress) -> list[S | Exception]:
        """Return the solutions, in order; an exception in the place of settings that break a rule.

        Raises:
            Exception: what stops the batch as a whole; each of its members is then tried alone.
        """

    @abstractmethod
    def write(self, cfg: DictConfig, directory: Path, solution: S) -> Metrics:
        """Fill the run directory with a solution; `metrics.json` comes last."""

    def shared(self, name: str, value: object) -> object:
        """Return what a batch shares of a setting: nothing of a batchable number, else all (JSON)."""
        return value if self.batchable.isdisjoint(_with_groups(name)) else _form(value)

    def shape(self, settings: Mapping[str, object]) -> object:
        """Return what follows from batchable settings and must be equal in a batch all the same (JSON)."""
        return None

    def size(self, settings: Mapping[str, object]) -> int:
        """Return about how many bytes a solution keeps until it is written."""
        return 0


EXPERIMENTS: Mapping[str, str] = {
    "gradient_chase": "gradient_chase.GradientChase",
    "laws": "laws.run",
    "flat_limit": "flat_limit.run",
    "exponential_bound": "theorems.exponential_bound",
    "feasibility": "theorems.feasibility",
    "layouts": "theorems.layouts",
    "learn_kernel": "learn_kernel.run",
    "memory": "memory.run",
    "adp": "adp.Regulation",
    "adp_comparison": "adp_comparison.run",
    "adp_initial_weights": "adp_comparison.initial_weights",
    "adp_tracking": "adp_tracking.run",
    "faults": "faults.run",
    "icl": "icl.run",
    "safe_box": "safe_box.run",
    "avoidance": "avoidance.run",
    "rivals": "rivals.run",
}
"""Name in `task` -> path within this package. They are imported when they are asked for."""


def experiment(task: object) -> Experiment | BatchedExperiment[Solution]:
    """Return the experiment that the setting `task` names: one of `EXPERIMENTS`, or a dotted path.

    Raises:
        ValueError: if there is no such name, or nothing that can be called at the path.
    """
    own = isinstance(task, str) and "." in task
    if not own:
        choice(COMMAND_LINE, "task", task, tuple(EXPERIMENTS))
    path = str(task) if own else f"{__package__}.{EXPERIMENTS[str(task)]}"
    module, _, name = path.rpartition(".")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        if not own:
            raise
        raise fail(COMMAND_LINE, "task", f"cannot be imported ({error})", task) from error
    made: Experiment | BatchedExperiment[Solution] = found() if isinstance(found, type) else found
    if not callable(made):
        raise fail(COMMAND_LINE, "task", "must be an experiment, which can be called", task)
    return made


def check_animation(cfg: DictConfig) -> None:
    """Refuse the setting `animation` where the experiment has nothing that moves.

    Raises:
        ValueError: if the experiment has no attribute ``animates`` that is true.
    """
    wanted = cfg.get("animation", False)
    if wanted is not False and not getattr(experiment(cfg.task), "animates", False):
        rule = f"must be false for the task {cfg.task}, which has no animation"
        raise fail(COMMAND_LINE, "animation", rule, wanted)


_REFUSALS = (ValueError, TypeError, NotImplementedError, RuntimeError)
"""What objects raise that do not serve numbers of a row's own."""

_R = TypeVar("_R")
Advance = Callable[[int], None]


class RowsOfJobs:
    """The rows of a call, each with the numbers of its job.

    ``kinds`` has the row of numbers of each job, ``counts`` its rows; `differ` says whether jobs have numbers
    of their own.
    """

    def __init__(self, kinds: Sequence[int], counts: Sequence[int]) -> None:
        self.differ = len(set(kinds)) > 1
        kind, count = (torch.tensor(each, dtype=torch.int64, device="cpu") for each in (kinds, counts))
        self._kind = kind.repeat_interleave(count)

    def of(self, rows: slice = slice(None)) -> contextlib.AbstractContextManager[None]:
        """Batches of the block hold these rows of the call."""
        return some_rows(self._kind[rows]) if self.differ else contextlib.nullcontext()


class _Set(NamedTuple):
    """Jobs of one call."""

    jobs: list[int]
    objects: tuple[Any, ...]  # with the numbers of all of them
    kinds: list[int]  # of each job, the row of its numbers
    alone: list[_Set]  # the calls in place of this one where it refuses numbers of a row's own


def in_calls(
    call: Callable[[Sequence[int], Any, RowsOfJobs, Advance | None], Sequence[_R]],
    objects: Sequence[tuple[Any, ...]],
    counts: Sequence[int],
    alike: Sequence[Hashable],
    advance: Advance | None = None,
) -> list[_R]:
    """Return the results of jobs, of which those whose objects differ in numbers alone share a call.

    Where objects differ in more there are several calls, and where one refuses numbers of a row's own, as not
    all objects serve them, its jobs run one after the other: those of the same objects together. A ``call``
    gets the jobs by number, the objects that have the numbers of all, their rows, and ``advance``; jobs share
    it whose ``alike`` are equal, and ``counts`` are their rows.
    """
    found: dict[int, _R] = {}
    groups = grouped(range(len(objects)), lambda i: alike[i]).values()
    waiting: list[_Set] = []
    for jobs in groups:
        same = grouped(jobs, lambda i: tuple(map(id, objects[i]))).values()
        waiting += _joined([_Set(each, objects[each[0]], [0] * len(each), []) for each in same])
    while waiting:
        some = waiting.pop(0)
        rows = RowsOfJobs(some.kinds, [counts[i] for i in some.jobs])
        try:
            results = call(some.jobs, some.objects, rows, advance)
        except _REFUSALS as error:
            if not some.alone:
                raise
            _log.debug("%d jobs run one after the other: %s", len(some.alone), error)
            waiting[:0] = some.alone
        else:
            found.update(zip(some.jobs, results, strict=True))
    return [found[i] for i in range(len(objects))]


def _joined(alone: list[_Set]) -> list[_Set]:
    """Return calls of distinct objects as one, or as a few where objects differ in more than numbers."""
    if len(alone) == 1:
        return alone
    try:
        merged_objects = merged([each.objects for each in alone])
    except ValueError:  # they differ in more than numbers
        keys = [Contents(*each.objects, telling=True).key for each in alone]
        sets = grouped(range(len(alone)), lambda i: (i,) if keys[i] is None else keys[i]).values()
        if len(sets) == 1:
            return alone
        return [each for some in sets for each in _joined([alone[i] for i in some])]
    kinds = [kind for kind, each in enumerate(alone) for _ in each.jobs]
    return [_Set([job for each in alone for job in each.jobs], merged_objects, kinds, alone)]
