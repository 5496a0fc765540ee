"""How an experiment is found by its name or path, what a batch shares, and small numbers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from staf_torch.experiments.registry import EXPERIMENTS, BatchedExperiment, experiment, finite


class Mine(BatchedExperiment[Any]):
    """Batches over a number, a group and a list."""

    batchable: ClassVar[frozenset[str]] = frozenset({"number", "group.*", "group.inner.*", "plain.dotted"})

    def __call__(self, cfg: Any, directory: Path, progress: Any = None) -> dict[str, float | None]:
        return {}

    def solve(self, cfgs: Any, progress: Any) -> list[Any]:
        return []

    def write(self, cfg: Any, directory: Path, solution: Any) -> dict[str, float | None]:
        return {}


not_callable = 3


def plain(cfg: Any, directory: Path, progress: Any = None) -> dict[str, float | None]:
    """A function is an experiment as it is."""
    return {}


def test_those_that_move_are_animated_and_two_run_in_batches() -> None:
    found = {name: experiment(name) for name in EXPERIMENTS}
    moves = {name for name, each in found.items() if getattr(each, "animates", False)}
    assert moves == {"gradient_chase", "adp", "adp_tracking", "avoidance"}
    batched = {name for name, each in found.items() if isinstance(each, BatchedExperiment)}
    assert batched == {"gradient_chase", "adp"}


def test_an_experiment_of_ones_own_is_found_by_its_path() -> None:
    assert experiment(f"{__name__}.plain") is plain
    made = experiment(f"{__name__}.Mine")
    assert isinstance(made, Mine)
    assert made.animates is False
    assert made.shape({}) is None
    assert made.size({}) == 0


@pytest.mark.parametrize(
    ("task", "words"),
    [
        (None, "must be one of 'gradient_chase'"),
        ("no_such_module.run", r"cannot be imported \(No module named 'no_such_module'\)"),
        (f"{__name__}.not_callable", "must be an experiment, which can be called"),
    ],
)
def test_what_is_no_experiment_is_refused(task: object, words: str) -> None:
    with pytest.raises(ValueError, match=rf"`staf task=...` {words}"):
        experiment(task)


def test_a_batch_shares_all_of_a_setting_but_the_numbers_that_may_differ() -> None:
    shared = Mine().shared
    assert shared("number", [1.0, [2, "a"], False]) == ["number", ["number", ["a"]], [False]]
    for name in ("group.a", "group.inner.b", "plain.dotted"):
        assert shared(name, 1.0) == "number"
    assert shared("other", 1.0) == shared("group", 1.0) == 1.0


def test_what_is_not_finite_is_none() -> None:
    assert finite(1.5) == finite(torch.tensor(1.5)) == 1.5
    assert isinstance(finite(torch.tensor(1.5)), float)
    assert finite(0) == 0.0
    assert all(finite(each) is None for each in (None, math.nan, math.inf, torch.tensor(-math.inf)))
