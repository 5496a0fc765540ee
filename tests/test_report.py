"""Progress of a long run, and the figure."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from staf_torch.experiments import progress
from staf_torch.report import plots


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
    bar = progress.Progress(100, "times")
    for _ in range(100):
        clock.now += seconds / 100
        bar.advance(1)
    bar.close()


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
    clock: _Clock, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress.sys.stderr, "isatty", lambda: True, raising=False)
    _run(clock, 100.0)
    drawn = capsys.readouterr().err.split("\r")
    assert any("[###" in part and "of 100 times" in part for part in drawn)
    assert drawn[-2].strip() == ""
    assert "\n" not in "".join(drawn)


def _history(count: int, dim: int = 2, lost: bool = False) -> plots.ChaseHistory:
    time = np.linspace(0, 1, 50)
    wave = np.sin(time[:, None] + np.arange(10))
    excess = np.abs(wave[:, 0]) * 1e-3
    excess[7] = 0.0
    if lost:
        excess[30:] = np.nan
    return plots.ChaseHistory(
        time=time,
        state=wave[:, :dim],
        value=wave[:, 0],
        estimate=wave[:, 0] + 1e-3,
        ideal_estimate=wave[:, 0] + 1e-4,
        weights=wave[:, :count],
        ideal_weights=wave[:, :count],
        excess=excess,
    )


@pytest.mark.parametrize(("count", "dim", "lost"), [(3, 2, False), (10, 1, False), (3, 5, True)])
def test_figure_has_four_panels_and_is_the_same_on_every_run(
    count: int, dim: int, lost: bool, tmp_path: Path
) -> None:
    for name in ("one", "two"):
        figure = plots.draw_chase(_history(count, dim, lost))
        assert len(figure.axes) == 4
        assert figure.axes[3].get_yscale() == "log"
        plots.save(figure, tmp_path / name)
    for kind in ("png", "pdf"):
        assert (tmp_path / f"one.{kind}").read_bytes() == (tmp_path / f"two.{kind}").read_bytes()
