"""The report of a sweep, part by part: which rows and figures it has, and the page to its last character."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2
import pytest
from recorded import Record
from sweep_runs import write_run

from staf_torch.results.reader import collect
from staf_torch.results.run_directory import RunDirectory
from staf_torch.sweeps import report
from staf_torch.sweeps.report import draw_sweep, page, write_report
from staf_torch.tables import tabulate


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Two kernels and two seeds; one of the runs failed."""
    for num, (kernel, seed) in enumerate((k, s) for k in ("matern", "gaussian") for s in (0, 1)):
        overrides = {"kernel": kernel, "seed": seed}
        metrics = {"ball_error": 0.123456789 * (num + 1), "condition_number": 8.0, "settling_time": None}
        if num == 3:
            write_run(tmp_path / "3", overrides, None, status="failed", reason="no <room>", version="1.2")
        else:
            write_run(tmp_path / str(num), overrides, metrics, version="1.2")
    (tmp_path / "4").mkdir()
    (tmp_path / "4" / "run.json").write_text("damaged")
    return tmp_path


def main_of(text: str) -> str:
    return text[text.index("<main>") : text.index("</main>")]


def test_the_page_is_as_it_was(sweep: Path, record: Record) -> None:
    found = collect(sweep)
    skipped = tuple(dataclasses.replace(each, path=Path("4"), reason="<unread>") for each in found.skipped)
    found = dataclasses.replace(found, skipped=skipped, remarks=("a remark",))
    text = page(found, tabulate(found), {"A figure": b"png"}, "A <title>")
    record({str(n): line for n, line in enumerate(main_of(text).splitlines())})
    assert f"base64,{base64.b64encode(b'png').decode()}" in text
    assert text.startswith('<!DOCTYPE html>\n<html lang="en">')
    assert "<title>A &lt;title&gt;</title>" in text


def test_the_page_of_runs_that_know_little_says_what_it_can(sweep: Path) -> None:
    found = collect(sweep)
    bare = [dataclasses.replace(run, task=None, version=None, settings={}) for run in found.rows]
    found = dataclasses.replace(found, rows=tuple(bare), skipped=(), remarks=())
    text = main_of(page(found, tabulate(found), {}, "title"))
    assert '<p class="about">runs: 4 runs, 3 completed</p>' in text
    assert "<dt>" not in text
    assert "<img" not in text
    some = dataclasses.replace(found, rows=(*bare[:1], *collect(sweep).rows[1:2]))
    assert '<p class="about">gradient_chase: 2 runs, 2 completed, staf_torch 1.2</p>' in page(
        some, tabulate(some), {}, "title"
    )
    assert "<dt>dt</dt><dd>0.01</dd>" in page(some, tabulate(some), {}, "title")


def test_settings_that_all_runs_share_are_listed_by_name(sweep: Path) -> None:
    common = report._common(collect(sweep))
    assert list(common) == sorted(common)
    assert common["dt"] == 0.01
    assert not {"kernel", "seed"} & set(common)


def test_a_page_with_a_name_that_there_is_not_is_an_error(
    sweep: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    environment = jinja2.Environment

    def noted(**options: Any) -> Any:
        made.append(environment(**options))
        return made[-1]

    monkeypatch.setattr(jinja2, "Environment", noted)
    found = collect(sweep)
    page(found, tabulate(found), {}, "title")
    with pytest.raises(jinja2.UndefinedError):
        made[0].from_string("{{ nothing }}").render()


@pytest.mark.parametrize("seeds", [True, False])
def test_a_report_has_a_row_for_all_seeds_and_its_csv_a_row_a_run(seeds: bool, sweep: Path) -> None:
    if not seeds:
        for num in (1, 3):
            (sweep / str(num) / "run.json").unlink()
            for path in (sweep / str(num)).iterdir():
                path.unlink()
    text = write_report(sweep, figures=False)
    assert (sweep / "table.md").read_text() == text
    lines = (sweep / "table.csv").read_text().splitlines()
    assert len(lines) == (5 if seeds else 3)
    assert "condition_number" in lines[0]
    assert str(sweep) not in (sweep / "table.csv").read_text()
    assert ("±" in text) == seeds
    assert "condition_number" not in text
    assert "**" in text
    assert "\\textbf" in (sweep / "table.tex").read_text()
    shown = (sweep / "report.html").read_text()
    assert f"<h1>Sweep {sweep.name}</h1>" in shown
    assert "best" in shown
    assert not (sweep / "figures").exists()


@pytest.mark.parametrize("figures", [None, True, False])
def test_figures_are_drawn_unless_somebody_says_otherwise(
    figures: bool | None, sweep: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(found: object) -> None:
        raise RuntimeError("no font")

    draws: dict[str, tuple[str, Callable[..., Any]]] = {
        "first": ("First", lambda found: "a figure"),
        "second": ("Second", lambda found: None),
        "third": ("Third", fails),
    }
    monkeypatch.setattr(report, "SWEEP_FIGURES", draws)
    monkeypatch.setattr(report, "images", lambda figure: {"png": b"png of " + figure.encode(), "svg": b"svg"})
    write_report(sweep, **({} if figures is None else {"figures": figures}))
    drawn = figures is not False
    shown = (sweep / "report.html").read_text()
    assert ("<h2>First</h2>" in shown) == drawn
    assert (base64.b64encode(b"png of a figure").decode() in shown) == drawn
    assert (sweep / "figures").exists() == drawn
    assert caplog.messages == (["no figure third: RuntimeError: no font"] if drawn else [])
    if drawn:
        assert (sweep / "figures" / "first.png").read_bytes() == b"png of a figure"
        found = draw_sweep(collect(sweep), RunDirectory(sweep))
        assert found == {"First": b"png of a figure"}
