"""Progress of a long run."""

from __future__ import annotations

import logging
import sys

import pytest

from staf_torch.results import progress


class _Clock:
    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> _Clock:
    clock = _Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def _run(clock: _Clock, seconds: float) -> None:
    for _ in progress.Progress().each(range(100), "times"):
        clock.now += seconds / 100


def test_a_short_run_shows_no_progress(clock: _Clock, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    _run(clock, 1.9)
    assert caplog.messages == []


def test_a_long_run_without_a_terminal_logs_a_line_now_and_then(
    clock: _Clock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    _run(clock, 100.0)
    assert 5 <= len(caplog.messages) <= 12
    assert all("% of 100 times" in line and "s left" in line for line in caplog.messages)


def test_a_long_run_on_a_terminal_draws_a_bar_and_wipes_it(
    clock: _Clock,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("tqdm.std.time", clock.monotonic)  # the bar's own clock
    _run(clock, 100.0)
    drawn = capsys.readouterr().err.split("\r")
    assert any("50/100" in part and "times" in part for part in drawn)
    assert drawn[-2].strip() == ""  # wiped at the end
    assert "\n" not in "".join(drawn)
    assert caplog.messages == []  # the bar says it already


def test_lines_of_the_log_come_after_two_seconds_and_then_every_ten(
    clock: _Clock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    clock.now = 1000.0
    _run(clock, 50.0)  # half a second each
    # A step is told when the next one is asked for: the fourth at 2 s.
    assert caplog.messages == [
        f"{share} % of 100 times, {left} s left"
        for share, left in ((4, 48), (24, 38), (44, 28), (64, 18), (84, 8))
    ]


def test_a_listener_is_told_shares_and_nothing_is_shown(
    clock: _Clock,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("tqdm.std.time", clock.monotonic)
    told: list[float] = []
    for _ in progress.Progress(told.append).each("abcd", "letters"):
        clock.now += 100.0
    with progress.Progress(told.append).over(10, "steps") as advance:
        advance(3)
        advance(5)
    assert told == [0.25, 0.5, 0.75, 1.0, 0.3, 0.8]
    assert capsys.readouterr() == ("", "")
    assert caplog.messages == []


@pytest.mark.parametrize(("seconds", "drawn"), [(1.9, False), (2.6, True)])
def test_a_bar_appears_after_two_seconds(
    seconds: float,
    drawn: bool,
    clock: _Clock,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("tqdm.std.time", clock.monotonic)
    _run(clock, seconds)
    assert ("/100 " in capsys.readouterr().err) == drawn
