"""A job of many members in its parts: the rows on the disk, what the log says of them, and which they are."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import OmegaConf

from staf_torch.settings.plain import ManySettings
from staf_torch.sweeps import lock, member_rows, members
from staf_torch.sweeps.batching import DEFERRED, Computed, Failed
from staf_torch.sweeps.hydra_compat import config_loader
from staf_torch.sweeps.member_rows import Left, left, made_by, rows_left, writer
from staf_torch.sweeps.members import _Tally, member_overrides, start_of

PARTIAL, SUMS = ".members.json.partial", ".members.json.sums"


def rows(*numbers: int, **metrics: Any) -> list[dict[str, Any]]:
    return [
        {"num": n, "overrides": [f"seed={n}"], "status": "completed", "metrics": metrics} for n in numbers
    ]


def write(
    place: Path, first: int, last: int, total: int, before: Left | None = None, stop: bool = True
) -> None:
    """Rows from the first to the one before the last, and an end that comes before the file is complete."""
    before = Left([]) if before is None else before
    try:
        with writer(place, "run", total, before) as add:
            add(rows(*range(first, last)), [f"made {n}" for n in range(first, last)])
            if stop:
                raise KeyboardInterrupt
    except KeyboardInterrupt:
        pass


def test_rows_are_one_line_each_and_their_sums_stay_until_all_are_there(tmp_path: Path) -> None:
    write(tmp_path, 0, 2, 3)
    assert {path.name for path in tmp_path.iterdir()} == {PARTIAL, SUMS}
    found = left(tmp_path, "run")
    assert found is not None
    assert found.made == ["made 0", "made 1"]
    written = (tmp_path / PARTIAL).read_bytes()
    assert found.size == len(written) - len(b",\n")
    assert found.sums == (tmp_path / SUMS).stat().st_size
    assert list(rows_left(tmp_path, 2)) == rows(0, 1)
    assert list(rows_left(tmp_path, 1)) == rows(0)
    sums = [json.loads(line) for line in (tmp_path / SUMS).read_text().splitlines()]
    text = written.splitlines()[1].removesuffix(b",")
    assert sums[:2] == [{"run": "run"}, {"made": "made 0", "sha256": hashlib.sha256(text).hexdigest()}]
    write(tmp_path, 2, 3, 3, found, stop=False)
    assert [path.name for path in tmp_path.iterdir()] == ["members.json"]
    assert json.loads((tmp_path / "members.json").read_text())["members"] == rows(0, 1, 2)
    assert (tmp_path / "members.json").read_text().count("\n") == 5


@pytest.mark.parametrize("done", [0, 1, 2, 3])
def test_rows_that_are_taken_over_end_in_the_same_file(done: int, tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    (tmp_path / "parts").mkdir()
    write(tmp_path / "whole", 0, 3, 3, stop=False)
    if done:
        write(tmp_path / "parts", 0, done, 3)
    else:
        with pytest.raises(KeyboardInterrupt), writer(tmp_path / "parts", "run", 3, Left([])):
            raise KeyboardInterrupt
    found = left(tmp_path / "parts", "run")
    assert found is not None
    assert len(found.made) == done
    with (tmp_path / "parts" / PARTIAL).open("a") as file:
        file.write("damaged")  # what comes behind what is taken over
    write(tmp_path / "parts", done, 3, 3, found, stop=False)
    one, other = ((tmp_path / name / "members.json").read_bytes() for name in ("whole", "parts"))
    assert one == other


@pytest.mark.parametrize("gone", [PARTIAL, SUMS])
def test_rows_without_their_sums_and_sums_without_rows_are_none(
    gone: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, 0, 2, 3)
    (tmp_path / gone).unlink()
    assert left(tmp_path, "run") == Left([])
    assert caplog.messages == []


def test_rows_that_something_else_made_are_none(tmp_path: Path) -> None:
    assert left(tmp_path, "run") == Left([])
    write(tmp_path, 0, 2, 3)
    assert left(tmp_path, "other") is None
    for name in (PARTIAL, SUMS):
        os.rename(tmp_path / name, tmp_path / "aside")
        assert left(tmp_path, "run") == Left([])
        os.rename(tmp_path / "aside", tmp_path / name)
    text = (tmp_path / PARTIAL).read_text()
    (tmp_path / PARTIAL).write_text(text.replace('"version"', '"Version"'))
    assert left(tmp_path, "run") == Left([])


@pytest.mark.parametrize("harm", ["row", "sum", "made", "none"])
def test_a_row_that_is_damaged_and_those_behind_it_run_again(
    harm: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, 0, 3, 4)
    sums = (tmp_path / SUMS).read_text().splitlines(keepends=True)
    text = (tmp_path / PARTIAL).read_text()
    if harm == "row":
        (tmp_path / PARTIAL).write_text(text.replace("seed=1", "seed=7"))
    if harm == "sum":
        sums[2] = sums[2].replace('"sha256": "', '"sha256": "0')
    if harm == "made":
        sums[2] = sums[2].replace('"made 1"', "1")
    (tmp_path / SUMS).write_text("".join(sums))
    found = left(tmp_path, "run")
    assert found is not None
    assert len(found.made) == (3 if harm == "none" else 1)
    said = "a row of members.json is damaged or cut off; member 1 and those after it run again"
    assert caplog.messages == ([] if harm == "none" else [said])
    assert found.sums == sum(map(len, sums[: len(found.made) + 1]))
    assert found.size == len("".join(text.splitlines(keepends=True)[: len(found.made) + 1])) - 2


def test_a_history_belongs_to_its_row(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for number in (0, 1):
        (tmp_path / "members" / str(number)).mkdir(parents=True)
        (tmp_path / "members" / str(number) / "history.npz").write_text("kept")
    write(tmp_path, 0, 3, 4)
    files = [json.loads(line).get("files") for line in (tmp_path / SUMS).read_text().splitlines()[1:]]
    assert [each is not None and "history.npz" in each for each in files] == [True, True, False]
    assert len(left(tmp_path, "run").made) == 3  # type: ignore[union-attr]
    (tmp_path / "members" / "1" / "history.npz").write_text("Kept")  # of the same size
    assert len(left(tmp_path, "run").made) == 1  # type: ignore[union-attr]
    assert "history.npz is damaged" in caplog.text


def test_a_number_that_json_has_not_is_no_row(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"), writer(tmp_path, "run", 3, Left([])) as add:
        add(rows(0, ball=float("nan")), ["made"])


def test_what_is_written_is_on_the_disk_before_the_next_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    sync = os.fsync

    def noted(file: int) -> None:
        seen.append((tmp_path / SUMS).read_text().count("\n"))
        sync(file)

    monkeypatch.setattr(member_rows.os, "fsync", noted)
    with writer(tmp_path, "run", 2, Left([])) as add:
        for number in range(2):
            add(rows(number), ["made"])
    assert {1, 2, 3} <= set(seen)


def test_settings_in_another_order_made_the_same() -> None:
    assert made_by({"a": 1, "b": 2}) == made_by({"b": 2, "a": 1})
    assert made_by({"a": 1, "b": 2}) != made_by({"a": 1, "b": 3})
    assert Left([]) == ([], 0, 0)


# Which members there are


def test_members_are_the_product_of_lists() -> None:
    lists = OmegaConf.create({"members": ["seed=1,2", "kernel=gaussian,matern"]}).members
    expected = [[f"seed={s}", f"kernel={k}"] for s in (1, 2) for k in ("gaussian", "matern")]
    assert list(member_overrides(lists, config_loader())) == expected
    assert list(member_overrides("seed=1,2", config_loader())) == [["seed=1"], ["seed=2"]]
    for setting, words in (
        ([], "must be a list of overrides, like 'seed=range"),
        (None, "must be a list of overrides, like 'seed=range"),
        (["seed=1", 2], "must be a list of overrides, like 'seed=range"),
        (["hydra.verbose=true"], "must be about the experiment alone; got 'hydra.verbose=true'"),
        (["members=[x]"], "must be about the experiment alone; got"),
        (["seed=(1"], r"must be overrides in Hydra's grammar \(.+\); got 'seed=\(1'"),
        (["seed=range(1000001)"], "must be 1000000 at most, in several jobs if need be"),
    ):
        with pytest.raises(ValueError, match=r"`staf members=...` " + words):
            member_overrides(setting, config_loader())


class Record:
    """The record of a run that begins."""

    made_by = "run"

    def refuse_rows(self, directory: Path) -> None:
        raise ValueError("rows were made otherwise")


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("resume", [None, "here"])
def test_rows_are_taken_over_where_a_job_is_resumed(resume: str | None, again: bool, tmp_path: Path) -> None:
    write(tmp_path, 0, 2, 3)
    cfg = OmegaConf.create({"sweep": {"resume": resume, "resume_anyway": False}})
    record: Any = Record()
    with start_of(cfg, tmp_path, record, again=again) as start:
        assert lock.held(tmp_path) is not None
        assert start.run == "run"
        assert len(start.left.made) == (2 if again or resume else 0)
    assert lock.held(tmp_path) is None


def test_rows_of_another_run_are_refused_unless_a_person_means_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, 0, 2, 3)
    record: Any = Record()
    record.made_by = "other"
    cfg = OmegaConf.create({"sweep": {"resume": "here", "resume_anyway": False}})
    with pytest.raises(ValueError, match="rows were made otherwise"), start_of(cfg, tmp_path, record):
        pytest.fail("it must not begin")
    assert lock.held(tmp_path) is None
    assert caplog.messages == []
    cfg.sweep.resume_anyway = True
    with start_of(cfg, tmp_path, record) as start:
        assert start == ("other", Left([]))
    assert caplog.messages == [f"the members that {tmp_path} has were made otherwise: all run again"]
    cfg.sweep.resume = None
    caplog.clear()
    with start_of(cfg, tmp_path, record) as start:
        assert start.left == Left([])
    assert caplog.messages == []


def test_a_member_that_was_made_otherwise_is_named() -> None:
    jobs = [[f"seed={n}", "dt=1"] for n in range(4)]
    members._refuse_others(jobs, 2, ["a", "b"], ["a", "b"])
    members._refuse_others(jobs, 2, ["a", "b"], ["a"])
    with pytest.raises(ValueError, match=r"^member 3 \(seed=3 dt=1\) was not made as it would be now"):
        members._refuse_others(jobs, 2, ["a", "b"], ["a", "c"])


@pytest.mark.parametrize("keep", [False, True])
def test_files_of_a_member_are_written_where_they_are_kept(
    keep: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def completion(cfg: Any, outcome: Any) -> Any:
        if isinstance(outcome, Failed):
            raise outcome.error
        return lambda cfg, directory, progress: {"place": directory.name, "seed": cfg.seed}

    monkeypatch.setattr(members, "completion", completion)
    cfgs = ManySettings([None] * 2, [{}, {}], lambda n: OmegaConf.create({"seed": n}))
    computed = Computed(SimpleNamespace(metrics={"ball": 1.0}))
    told: Any = SimpleNamespace()

    def result(outcome: Any) -> dict[str, Any]:
        return members._result(cfgs, 1, outcome, tmp_path / "members" / "7", keep, told)

    whole = {"place": "7", "seed": 1}
    done = {"status": "completed", "reason": None, "metrics": whole if keep else {"ball": 1.0}}
    for _ in range(2):
        assert result(computed) == done
    assert (tmp_path / "members" / "7").exists() == keep
    failed = {"status": "failed", "reason": "odd", "metrics": {}}
    assert result(Failed(ValueError("odd"))) == failed
    assert (tmp_path / "members" / "7").exists() == keep
    for _ in range(2):
        assert result(DEFERRED) == {"status": "completed", "reason": None, "metrics": whole}
    assert (tmp_path / "members" / "7").is_dir()


# What the log says


def tallied(place: Path, listed: list[dict[str, Any]], pieces: int = 3) -> tuple[_Tally, int]:
    tally, before = _Tally(place), len(os.listdir("/proc/self/fd"))
    for begin in range(0, len(listed), pieces):
        tally.add(listed[begin : begin + pieces])
    tally.report()
    return tally, before


@pytest.mark.parametrize("count", [1, 20, 21, 30])
def test_few_members_are_listed_and_of_many_the_spread_of_their_metrics(
    count: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    listed = [row for n in range(count) for row in rows(n, ball_error=float(n), other=None if n else 5.0)]
    tally, before = tallied(tmp_path, listed)
    assert tally.counts() == {"members": count, "failed": 0, "diverged": 0}
    assert list(tmp_path.iterdir()) == []
    text = caplog.text
    if count <= 20:
        assert "| member " in text
        assert "other" not in text
        assert f"| seed={count - 1} " in text
        assert len(caplog.messages) == count + 2
    else:
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in caplog.messages]
        assert cells[0] == ["metric", "least", "median", "most", "members"]
        assert cells[2:] == [
            ["ball_error", "0", f"{(count - 1) / 2:g}", str(count - 1), str(count)],
            ["other", "5", "5", "5", "1"],
        ]
    tally.close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_metrics_that_no_member_has_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    tally, _ = tallied(tmp_path, [row for n in range(21) for row in rows(n, ball_error=None)])
    tally.close()
    assert not any("ball_error" in line for line in caplog.messages)


def test_members_that_failed_or_diverged_are_counted_and_the_first_ones_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR)
    listed = []
    for number in range(50):
        (row,) = rows(number, diverged_fraction=float(number % 5 == 0))
        listed.append(row | {"status": "failed", "reason": "odd", "metrics": {}} if number % 2 else row)
    tally, _ = tallied(tmp_path, listed)
    tally.close()
    assert tally.counts() == {"members": 50, "failed": 25, "diverged": 5}
    assert caplog.messages == [f"member {n} (seed={n}): odd" for n in range(1, 41, 2)]


def test_a_signal_says_how_many_members_are_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    tally = _Tally(tmp_path)
    tally.add(rows(0, 1, 2))
    with pytest.raises(KeyboardInterrupt) as told, members._saying_how_to_resume(tmp_path / "run", tally, 9):
        raise KeyboardInterrupt
    tally.close()
    said = "3 of 9 members are complete. Resume with:\n  staf sweep.resume=run"
    assert told.value.__notes__ == [said]
