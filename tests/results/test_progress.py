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
