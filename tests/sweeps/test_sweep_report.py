"""What a sweep ends with: table and figures, whatever went wrong."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
from omegaconf import DictConfig, OmegaConf
from sweep_runs import BAD_COUNT, error, write_run, write_sweep

from staf_torch.figures import sweep as series
from staf_torch.figures.style import images
from staf_torch.results.reader import collect
from staf_torch.results.run_directory import RunDirectory
from staf_torch.sweeps.callbacks import SweepReport
from staf_torch.sweeps.report import draw_sweep, write_report

FILES = {"table.md", "table.tex", "table.csv", "report.html"}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sweep(tmp_path_factory.mktemp("report") / "sweep")


def settings(directory: Path) -> DictConfig:
    return OmegaConf.create({"figures": False, "hydra": {"sweep": {"dir": str(directory)}}})


def left(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir() if path.is_file()}


def test_report_has_a_row_for_all_seeds_and_the_csv_a_row_a_run(sweep: Path) -> None:
    text = write_report(sweep, figures=False)
    assert left(sweep) == FILES
    assert (sweep / "table.md").read_text() == text
    assert text.count("\n| exponential") + text.count("\n| gaussian") == 12
    assert len((sweep / "table.csv").read_text().splitlines()) == 37
    assert "12 of 36 failed" in text


def test_equal_sweeps_in_two_directories_have_equal_tables(tmp_path: Path) -> None:
    one, two = (write_sweep(tmp_path / name) for name in ("one", "two"))
    assert write_report(one, figures=False) == write_report(two, figures=False)
    for name in ("table.csv", "table.tex"):
        assert (one / name).read_bytes() == (two / name).read_bytes()


@pytest.mark.parametrize("seeds", [(0,), (0, 1)])
def test_a_sweep_of_which_every_job_failed_has_a_table_of_reasons(
    seeds: tuple[int, ...], tmp_path: Path
) -> None:
    directory = write_sweep(tmp_path / "sweep", kernels=["gaussian"], counts=(7,), seeds=seeds)
    text = write_report(directory)
    assert left(directory) == FILES
    assert BAD_COUNT in text
    assert BAD_COUNT in (directory / "table.csv").read_text()


# The callback


def test_callback_reports_once_at_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    directory = write_sweep(tmp_path / "sweep")
    callback, cfg = SweepReport(), settings(directory)
    callback.on_multirun_end(cfg)
    out = capsys.readouterr().out
    assert (directory / "table.md").read_text() in out
    assert str(directory / "report.html") in out


@pytest.mark.parametrize("kind", ["missing", "empty"])
def test_a_sweep_without_a_run_ends_quietly(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    if kind == "empty":
        (tmp_path / "sweep").mkdir()
    SweepReport().on_multirun_end(settings(tmp_path / "sweep"))
    assert capsys.readouterr().out == ""
    assert len(caplog.messages) == (kind == "empty")


def test_an_error_of_a_figure_costs_that_figure_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("no font")

    monkeypatch.setattr(series, "draw_error_against_radius", fails)
    directory = write_sweep(tmp_path / "sweep", seeds=(0,))
    write_report(directory)
    assert left(directory) == FILES
    assert {path.stem for path in (directory / "figures").iterdir()} == {"error_map"}
    assert caplog.messages == ["no figure error_against_radius: RuntimeError: no font"]


# The figures


def test_curves_are_the_geometric_means_over_the_seeds_with_their_interval(sweep: Path) -> None:
    panels = series.error_against_radius(collect(sweep))
    assert [panel.title for panel in panels] == ["exponential kernel", "Gaussian kernel"]
    assert [curve.label for curve in panels[0].curves] == ["3 centers", "6 centers"]
    point = panels[0].curves[1].points[1]
    logs = [math.log(error(0.1, 6, seed)) for seed in range(3)]
    assert point.x == 0.1
    assert math.log(point.middle) == pytest.approx(sum(logs) / 3, rel=1e-12)
    assert point.low < point.middle < point.high
    assert point.middle**2 == pytest.approx(point.low * point.high, rel=1e-12)
    floor = panels[0].curves[1].floor[1]
    assert floor.middle == pytest.approx(point.middle / 2, rel=1e-12)
    assert series.rounding_floor(collect(sweep)) == 1.1e-15


def test_a_map_has_a_gap_where_all_runs_failed(sweep: Path) -> None:
    shown = series.heat_maps(collect(sweep))[0]
    assert (shown.radii, shown.counts) == ((0.05, 0.1), (3, 6, 7))
    assert shown.errors[2] == (None, None)
    assert shown.errors[0][0] == pytest.approx(5.12 * 0.05**2, rel=1e-3)


def test_figures_are_only_those_that_the_swept_settings_allow(tmp_path: Path) -> None:
    for num, steps in enumerate((1, 10)):
        metrics = {"ball_error": 1.0 / steps, "products_per_second": 100 * (steps + 1.0)}
        write_run(tmp_path / str(num), {"optimizer.inner_steps": steps}, metrics)
    found = collect(tmp_path)
    assert series.error_against_radius(found) == []
    assert series.heat_maps(found) == []
    (panel,) = series.cost_against_accuracy(found)
    (curve,) = panel.curves
    assert curve.label == "steepest descent"
    assert [(point.x, point.middle) for point in curve.points] == [(200.0, 1.0), (1100.0, 0.1)]
    assert set(draw_sweep(found, RunDirectory(tmp_path))) == {"Cost against accuracy"}


def test_of_one_law_the_cost_is_that_of_the_centers_and_a_line_is_a_radius(tmp_path: Path) -> None:
    for num, (count, radius) in enumerate(itertools.product((3, 6), (0.1, 0.2))):
        metrics = {"ball_error": radius**2 / count, "products_per_second": 10.0}
        write_run(tmp_path / str(num), {"centers.count": count, "centers.radius": radius}, metrics)
    (panel,) = series.cost_against_accuracy(collect(tmp_path))
    assert [curve.label for curve in panel.curves] == ["$r$ = 0.1", "$r$ = 0.2"]
    points = [(point.x, point.middle) for point in panel.curves[1].points]
    assert points == [(90.0, pytest.approx(0.04 / 3)), (360.0, pytest.approx(0.04 / 6))]


def test_more_panels_than_can_be_read_are_refused(tmp_path: Path) -> None:
    for num in range(26):
        overrides = {"dt": 1 + num // 2, "centers.radius": 0.1 + num % 2}
        write_run(tmp_path / str(num), overrides, {"ball_error": 1.0})
    with pytest.raises(series.TooManyError, match="13 panels, by dt: too many to read"):
        series.error_against_radius(collect(tmp_path))


@pytest.mark.parametrize(("rounding", "seen"), [(1e-15, False), (1e-4, True)])
def test_rounding_out_of_the_picture_is_said_to_be_below(rounding: float, seen: bool) -> None:
    curve = series.Curve("3 centers", tuple(series.Point(r, r, r, r) for r in (0.1, 0.2)))
    figure = series.draw_error_against_radius([series.Panel("exponential kernel", (curve,))], rounding)
    (words,) = [t.get_text() for t in figure.legends[0].get_texts() if "rounding" in t.get_text()]
    assert words.endswith(", below") is not seen
    assert bool(figure.axes[0].get_ylim()[0] < rounding) is seen


def test_figures_are_the_same_bytes_on_every_run(sweep: Path) -> None:
    maps = series.heat_maps(collect(sweep))[:1]
    one, two = (images(series.draw_heat_maps(maps)) for _ in range(2))
    assert one == two


def test_there_is_no_map_where_only_one_of_radius_and_count_was_swept(tmp_path: Path) -> None:
    for name in ("centers.radius", "centers.count"):
        for num, value in enumerate((3, 6)):
            write_run(tmp_path / name / str(num), {name: value}, {"ball_error": 0.1 * value})
        assert series.heat_maps(collect(tmp_path / name)) == []
