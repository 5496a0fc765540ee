"""Which jobs share a tensor batch, what becomes of each, and in which words an error is told."""

from __future__ import annotations

import errno
import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError, OmegaConfBaseException

from staf_torch.experiments.registry import BatchedExperiment, Metrics
from staf_torch.signs import SHOWN, Progress
from staf_torch.sweeps.job import (
    DEFERRED,
    Computed,
    Failed,
    Written,
    batches,
    completion,
    groups,
    sentence,
    solve,
)


class Solved(NamedTuple):
    """What a batch leaves for a job."""

    metrics: Metrics


class Sized(BatchedExperiment[Any]):
    """An experiment whose settings say how much a solution keeps, and which shape it has."""

    batchable = frozenset({"seed", "kept"})

    def __call__(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        return {"alone": 1.0}

    def solve(self, cfgs: Sequence[DictConfig], progress: Progress) -> list[Any]:
        if any(cfg.seed == 13 for cfg in cfgs):
            raise RuntimeError("thirteen")
        metrics = [{"seed": float(cfg.seed), "together": float(len(cfgs))} for cfg in cfgs]
        return [ValueError("odd") if m["seed"] % 2 else Solved(m) for m in metrics]

    def write(self, cfg: DictConfig, directory: Path, solution: Any) -> Metrics:
        return {**solution.metrics, "place": float(directory.name)}

    def shape(self, settings: Mapping[str, object]) -> object:
        return settings.get("shape")

    def size(self, settings: Mapping[str, object]) -> int:
        kept = settings.get("kept", 0)
        assert isinstance(kept, int)
        return kept


def alone(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """An experiment that takes no part in batches."""
    return {"alone": 2.0}


SIZED, ALONE = f"{__name__}.Sized", f"{__name__}.alone"


def jobs(count: int, **more: Any) -> list[dict[str, Any]]:
    return [{"task": SIZED, "seed": n, **more} for n in range(count)]


# Which share a batch


@pytest.mark.parametrize("count", [1, 6, 13])
@pytest.mark.parametrize("least", [1, 3, 100])
@pytest.mark.parametrize("most", [None, 2])
def test_batches_are_every_job_once_in_order_and_as_many_as_keep_all_workers_busy(
    count: int, least: int, most: int | None
) -> None:
    found = batches(jobs(count), least=least, most=most)
    assert [index for batch in found for index in batch] == list(range(count))
    longest = max(map(len, found))
    assert longest <= (most or count)
    assert longest == min(most or count, -(-count // least))  # no shorter than that needs
    assert all(len(batch) == longest for batch in found[:-1])


def test_batches_of_two_groups_share_the_workers() -> None:
    mixed = [{"task": SIZED, "seed": n, "kernel": "ab"[n % 2]} for n in range(12)]
    assert batches(mixed) == [[0, 2, 4, 6, 8, 10], [1, 3, 5, 7, 9, 11]]
    assert batches(mixed, least=2) == batches(mixed)
    four = [[0, 2, 4], [1, 3, 5], [6, 8, 10], [7, 9, 11]]
    assert batches(mixed, least=4) == four
    assert [len(batch) for batch in batches(mixed, least=3)] == [4, 4, 2, 2]


def test_a_batch_is_as_long_as_memory_allows() -> None:
    half = 2**27
    assert batches(jobs(2, kept=half)) == [[0, 1]]
    assert batches(jobs(2, kept=half + 1)) == [[0], [1]]
    assert batches(jobs(9, kept=half // 2)) == [[0, 1, 2, 3], [4, 5, 6, 7], [8]]
    assert batches([{**job, "kept": kept} for job, kept in zip(jobs(3), (2 * half, 0, 1), strict=True)]) == [
        [0, 1],
        [2],
    ]
    assert [len(batch) for batch in batches(jobs(300))] == [128, 128, 44]  # whatever they keep
    assert [len(batch) for batch in batches(jobs(300), most=200)] == [200, 100]


def test_jobs_that_can_share_no_batch_stand_alone() -> None:
    lone = [
        {"task": ALONE, "seed": 1},
        {"task": ALONE, "seed": 1},
        {"task": "nowhere.at_all"},
        {"seed": 1},  # without a task
    ]
    assert groups([*lone, *jobs(2), *jobs(2, shape="other")]) == [*([n] for n in range(4)), [4, 5], [6, 7]]
    assert batches(lone, least=1) == [[n] for n in range(4)]


# What becomes of each


def cfgs(*seeds: int, **more: Any) -> list[DictConfig]:
    return [OmegaConf.create({"task": SIZED, "seed": seed, **more}) for seed in seeds]


def test_a_batch_that_raises_is_tried_job_by_job_and_that_is_told(caplog: pytest.LogCaptureFixture) -> None:
    one, two = solve(cfgs(2, 3), SHOWN)
    assert isinstance(one, Computed)
    assert isinstance(two, Failed)  # an error is that of its job
    assert (one.metrics, str(two.error)) == ({"seed": 2.0, "together": 2.0}, "odd")
    found = solve(cfgs(2, 13), SHOWN)
    assert isinstance(found[0], Computed)
    assert found[0].metrics["together"] == 1.0
    assert isinstance(found[1], Failed)
    assert str(found[1].error) == "thirteen"
    assert caplog.messages == [
        "a batch of 2 jobs cannot run as one tensor program (RuntimeError: thirteen); they run one by one"
    ]
    caplog.clear()
    (alone,) = solve(cfgs(13), SHOWN)
    assert isinstance(alone, Failed)
    assert caplog.messages == []


def test_what_is_left_to_do_follows_from_the_outcome(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    (cfg,) = cfgs(2)
    (computed,) = solve([cfg], SHOWN)
    assert completion(cfg, computed)(cfg, tmp_path / "7") == {"seed": 2.0, "together": 1.0, "place": 7.0}
    assert solve([OmegaConf.create({"task": ALONE})] * 2, SHOWN) == [DEFERRED] * 2  # takes no part in batches
    assert completion(cfg, DEFERRED)(cfg, tmp_path) == {"alone": 1.0}
    with pytest.raises(ValueError, match="odd"):
        completion(cfg, Failed(ValueError("odd")))
    written = Written({"there": 3.0}, [(logging.WARNING, "100 % odd"), (logging.INFO, "told")])
    assert completion(cfg, written)(cfg, tmp_path) == {"there": 3.0}
    assert [(r.levelno, r.getMessage()) for r in caplog.records] == [(30, "100 % odd"), (20, "told")]


# In which words


def chained(*errors: BaseException) -> BaseException:
    for error, cause in itertools.pairwise(errors):
        error.__cause__ = cause
    return errors[0]


def missing(name: str | None, options: list[str] | None) -> MissingConfigException:
    return MissingConfigException("not found", name, options)


DISK = OSError(errno.ENOSPC, "No space left", "a/file")
OWN = " One of your own needs `--config-dir FOLDER`."
OTHERS = "; others come with the extras joblib, slurm, ray and optuna"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("ours"), "ours"),
        (ValueError("ours, and more\nfull_key: kernel"), "ours, and more"),
        (chained(HydraException("wrapped"), RuntimeError("between"), ValueError("ours")), "ours"),
        (chained(RuntimeError("theirs"), OmegaConfBaseException("omega")), "theirs"),
        (DISK, "cannot write a/file: No space left"),
        (chained(*[RuntimeError("of itself")] * 2), "of itself"),
        (
            ConfigKeyError("Could not override 'centers.raduis'.\nKey is not there"),
            "there is no setting `centers.raduis`; did you mean `centers.radius`?",
        ),
        (
            ConfigKeyError("Could not override 'optimizer.iterations'.\nKey is not there"),
            "there is no setting `optimizer.iterations`; did you mean `optimizer.inner_steps`?",
        ),
        (
            HydraException("Ambiguous value for argument 'kernel=a,b'\n1. To use it as a list"),
            "`kernel=a,b` is a list, and a list is a sweep: `staf -m kernel=a,b`; "
            "one setting that is a list is written `kernel=[a,b]`.",
        ),
        (
            missing("kernel/inverse_rot", ["matern", "inverse_multiquadric"]),
            "there is no `kernel/inverse_rot`; there are matern, inverse_multiquadric. "
            f"Did you mean `inverse_multiquadric`?{OWN}",
        ),
        (missing("hydra/launcher/x.yaml", ["a"]), f"there is no `hydra/launcher/x`; there are a{OTHERS}."),
    ],
)
def test_an_error_is_told_in_a_sentence(error: BaseException, words: str) -> None:
    assert sentence(error) == words
