"""Executors of this machine and of Ray without their processes: what goes to a worker and comes back."""

from __future__ import annotations

import logging
import os
import pickle
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from omegaconf import DictConfig, OmegaConf

from staf_torch.experiments.registry import Metrics
from staf_torch.results.progress import SHOWN, Progress
from staf_torch.sweeps.batching import DEFERRED, Batch, Computed, Done, Failed, Written
from staf_torch.sweeps.executors import local, remote
from staf_torch.sweeps.executors.local import Inline, Process
from staf_torch.sweeps.executors.ray_tasks import Ray


def batch(*names: str) -> Batch:
    return Batch([OmegaConf.create({"name": name}) for name in names], list(names))


# On this machine


def test_one_batch_after_the_other_is_computed_here(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 12.5])
    monkeypatch.setattr(local, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    monkeypatch.setattr(
        local, "solve", lambda settings, progress: [(each.name, progress) for each in settings]
    )
    inline = Inline()
    done = inline.submit(batch("a", "b"), SHOWN)
    assert done == Done([("a", SHOWN), ("b", SHOWN)], 2.5)  # type: ignore[list-item]
    assert inline.wait({3: done, 4: done}) == [3, 4]
    assert inline.result(done) is done
    inline.close(failed=False)


class Hand:
    """A worker without a process."""

    made: ClassVar[list[Hand]] = []

    def __init__(self, work: object) -> None:
        assert work is remote.solve_elsewhere
        self.threads, self.begun, self.lives = os.environ.get("OMP_NUM_THREADS"), [], True
        Hand.made.append(self)

    def begin(self, *arguments: Any) -> None:
        self.begun.append(pickle.loads(arguments[0]).directories)

    def result(self) -> bytes:
        return pickle.dumps(Done([], 1.0))

    def alive(self) -> bool:
        return self.lives

    def end(self) -> None:
        self.begun.append("ended")


@pytest.mark.parametrize(
    ("cores", "workers", "threads"), [(7, 2, "3"), (2, 5, "1"), (None, 1, "1"), (4, None, "1")]
)
def test_processes_share_the_cores_and_are_used_again(
    cores: int | None, workers: int | None, threads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local, "Worker", Hand)
    monkeypatch.setattr(Hand, "made", [])
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    before = os.environ.get("OMP_NUM_THREADS")
    process = Process(workers)
    first, second = (process.submit(batch(name), SHOWN) for name in ("a", "b"))
    assert Hand.made == [first, second]
    assert process.result(first) == Done([], 1.0)
    assert process.submit(batch("c"), SHOWN) is first
    assert process.result(second) == process.result(first) == Done([], 1.0)
    second.lives = False  # type: ignore[attr-defined]
    first.lives = False  # type: ignore[attr-defined]
    third = process.submit(batch("d"), SHOWN)
    assert [hand.begun for hand in Hand.made] == [[["a"], ["c"]], [["b"]], [["d"]]]
    assert third is Hand.made[2]
    assert {hand.threads for hand in Hand.made} == {threads}
    assert os.environ.get("OMP_NUM_THREADS") == before
    process.close(failed=False)
    assert [hand.begun[-1] for hand in Hand.made] == ["ended"] * 3
    process.close(failed=True)
    assert [hand.begun.count("ended") for hand in Hand.made] == [1, 1, 1]


# What a worker does


def whole(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """An experiment that says something in every way."""
    if cfg.get("fails"):
        raise NotPicklableError(directory, "in our words")
    logging.getLogger("own").info("told %d", 1)
    logging.getLogger("own").debug("not told")
    warnings.warn("take care", stacklevel=1)
    (directory / "left").write_text("")
    return {"whole": 1.0}


class NotPicklableError(Exception):
    """An error that cannot be made again of what pickle keeps."""

    def __init__(self, place: Path, why: str) -> None:
        super().__init__(why)


@pytest.fixture
def path(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """The path of imports, which a worker changes, and the level of the log."""
    root = logging.getLogger()
    level = root.level
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield sys.path
    root.setLevel(level)


def elsewhere(cfgs: Sequence[DictConfig], place: Path, wholes: Sequence[Any] = ()) -> Done:
    places = [str(place / "new" / str(n)) for n in range(len(cfgs))]
    packed = remote.pack(Batch(list(cfgs), places, wholes))
    return remote.unpack(remote.solve_elsewhere(*packed))


@pytest.mark.usefixtures("path")
def test_an_experiment_without_batches_leaves_its_log_for_the_parent(tmp_path: Path) -> None:
    cfgs = [OmegaConf.create({"task": f"{__name__}.whole", "fails": fails}) for fails in (False, True)]
    root = logging.getLogger()
    root.setLevel(logging.WARNING)
    handlers = list(root.handlers)
    shown = warnings.showwarning
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        for _ in range(2):  # in the same directory
            written, failed = elsewhere(cfgs, tmp_path).outcomes
            assert written == Written(
                {"whole": 1.0}, [(logging.INFO, "told 1"), (logging.WARNING, "take care")]
            )
            assert isinstance(failed, Failed)
            assert type(failed.error) is RuntimeError
            assert str(failed.error) == "NotPicklableError: in our words"
    assert (tmp_path / "new" / "0" / "left").exists()
    assert root.handlers == handlers
    assert warnings.showwarning is shown


def other(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Another one."""
    return {"other": 2.0}


@pytest.mark.usefixtures("path")
def test_what_runs_a_job_whole_goes_before_its_task(tmp_path: Path) -> None:
    cfgs = [OmegaConf.create({"task": f"{__name__}.other"}) for _ in range(2)]
    found = elsewhere(cfgs, tmp_path, [None, other]).outcomes
    assert [each.metrics for each in found] == [{"other": 2.0}] * 2  # type: ignore[union-attr]
    cfgs[0].task = cfgs[1].task = f"{__name__}.whole"
    assert elsewhere(cfgs, tmp_path, [other, other]).outcomes == found


def test_a_worker_imports_from_where_the_command_does_first(
    path: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path[:] = ["/ours", "/both", *path]
    before = list(path)
    clock = iter([10.0, 12.5])
    monkeypatch.setattr(remote, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    monkeypatch.setattr(
        remote, "solve", lambda settings, progress: [Failed(ValueError("odd")) for _ in settings]
    )
    pickled = pickle.dumps(Batch([OmegaConf.create({})], ["here"]))
    done = remote.unpack(remote.solve_elsewhere(pickled, ["/theirs", "/both"]))
    assert sys.path == ["/theirs", "/both", *(each for each in before if each != "/both")]
    assert done.seconds == 2.5
    (failed,) = done.outcomes
    assert isinstance(failed, Failed)
    assert type(failed.error) is ValueError
    assert remote._portable(DEFERRED) is DEFERRED
    computed = Computed(SimpleNamespace(metrics={}))
    assert remote._portable(computed) is computed


# Ray


class FakeRay:
    """Ray, in this process."""

    def __init__(self, running: bool, cores: dict[str, float]) -> None:
        self.running, self.cores, self.notes = running, cores, []

    def is_initialized(self) -> bool:
        return self.running

    def init(self, **given: Any) -> None:
        self.notes.append(given)

    def remote(self, **options: Any) -> Any:
        self.notes.append(options)
        return lambda function: SimpleNamespace(remote=lambda *arguments: (function, arguments))

    def cluster_resources(self) -> dict[str, float]:
        return self.cores

    def shutdown(self) -> None:
        self.notes.append("down")

    def wait(self, handles: list[Any], num_returns: int = 0) -> tuple[list[Any], list[Any]]:
        assert num_returns == 1
        return handles[1:2], handles[2:]

    def get(self, handle: Any) -> bytes:
        return pickle.dumps(Done([DEFERRED], 4.0))


@pytest.mark.parametrize("running", [False, True])
def test_ray_is_begun_and_ended_by_whom_it_belongs_to(running: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    ray = FakeRay(running, {"CPU": 3.0})
    monkeypatch.setitem(sys.modules, "ray", ray)
    made = Ray(None, {"address": "here", "log_to_driver": True})
    begun = {"log_to_driver": True, "include_dashboard": False, "address": "here"}
    assert ray.notes == [*([] if running else [begun]), {"max_retries": 0}]
    handle = made.submit(batch("a"), SHOWN)
    assert handle[0] is remote.solve_elsewhere
    assert pickle.loads(handle[1][0]).directories == ["a"]
    assert made.wait({5: "one", 7: "two", 9: "three"}) == [7]
    assert made.result(handle) == Done([DEFERRED], 4.0)
    assert (made.workers, made.pieces, Ray(2, {}).workers) == (3, 3, 2)
    for cores in ({}, {"CPU": 0.5}):
        ray.cores = cores
        assert made.workers == 1
    made.close(failed=True)
    assert (ray.notes[-1] == "down") == (not running)
    ray.notes.clear()
    if not running:
        Ray(None, {})
        assert ray.notes[0] == {"log_to_driver": False, "include_dashboard": False}
    with pytest.raises(ValueError, match=r"`hydra.launcher\(workers=...\)` must be at least 1"):
        Ray(0, {})
