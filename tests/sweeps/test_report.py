"""What a sweep ends with: table, figures and one page, as text and in a browser."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser
from sweep_runs import BAD_COUNT, error, write_run, write_sweep

from staf_torch.figures import sweep as series
from staf_torch.results.reader import collect
from staf_torch.sweeps.report import page, write_report
from staf_torch.tables import tabulate

NASTY = "<script>alert(1)</script>\"'&${x}{{ 7 * 7 }}"
FILES = {"table.md", "table.tex", "table.csv", "report.html"}


class Outline(HTMLParser):
    """Which tags there are, and where they point."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep over two kernels, radii, counts of which one fails, and three seeds."""
    return write_sweep(tmp_path_factory.mktemp("report") / "sweep")


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Errors 0.0128, 0.0512, ... in the order of the rows, and one that is missing, with its report."""
    directory = write_sweep(
        tmp_path_factory.mktemp("page") / "sweep", kernels=["exponential"], counts=(3, 15, 7), seeds=(0,)
    )
    write_report(directory)
    return directory


def left(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir() if path.is_file()}


def test_a_report_has_a_row_for_all_seeds_and_its_csv_a_row_a_run_with_all_metrics(large: Path) -> None:
    text = write_report(large, figures=False)
    assert left(large) == FILES
    assert not (large / "figures").exists()
    assert (large / "table.md").read_text() == text
    assert text.count("\n| exponential") + text.count("\n| gaussian") == 12
    assert "12 of 36 failed" in text
    assert "±" in text
    assert "rounding_floor" not in text
    assert "**" in text
    assert "\\textbf" in (large / "table.tex").read_text()
    csv = (large / "table.csv").read_text()
    assert len(csv.splitlines()) == 37
    assert "rounding_floor" in csv.splitlines()[0]
    assert str(large) not in csv
    found = (large / "report.html").read_text()
    assert f"<h1>Sweep {large.name}</h1>" in found
    assert "gradient_chase: 36 runs, 24 completed" in found


def test_a_sweep_of_which_every_job_failed_has_a_table_of_reasons(tmp_path: Path) -> None:
    directory = write_sweep(tmp_path / "sweep", kernels=["gaussian"], counts=(7,), seeds=(0, 1))
    text = write_report(directory)
    assert left(directory) == FILES
    assert BAD_COUNT in text
    assert BAD_COUNT in (directory / "table.csv").read_text()


# The figures


def test_curves_are_the_geometric_means_over_the_seeds_with_their_interval(large: Path) -> None:
    panels = series.error_against_radius(collect(large))
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
    shown = series.heat_maps(collect(large))[0]
    assert (shown.radii, shown.counts) == ((0.05, 0.1), (3, 6, 7))
    assert shown.errors[2] == (None, None)  # where all runs failed
    assert shown.errors[0][0] == pytest.approx(5.12 * 0.05**2, rel=1e-3)


def test_an_error_of_a_figure_costs_that_figure_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for num in range(26):  # 13 panels, which nobody can read
        overrides = {"dt": 1 + num // 2, "centers.radius": 0.1 + num % 2}
        write_run(tmp_path / str(num), overrides, {"ball_error": 1.0})
    write_report(tmp_path)
    assert left(tmp_path) == FILES
    assert [line.partition(": ")[0] for line in caplog.messages] == ["no figure error_against_radius"]
    assert "13 panels, by dt: too many to read" in caplog.text


# The page


def test_page_has_the_table_the_figures_and_the_settings_and_loads_nothing(sweep: Path) -> None:
    text = (sweep / "report.html").read_text()
    outline = Outline(text)
    assert [outline.tags.count(tag) for tag in ("img", "table", "script")] == [2, 1, 1]
    runs = [address for address in outline.addresses if not address.startswith("data:")]
    assert {path.name for path in sweep.iterdir() if path.is_dir()} - {"figures"} == {
        run[:-1] for run in runs
    }
    assert "<dt>ball_error</dt><dd>largest |V - V^| over the closed ball" in text
    for name in ("error_against_radius", "error_map"):
        assert base64.b64encode((sweep / "figures" / f"{name}.png").read_bytes()).decode() in text
    assert "http" not in text.replace("https://hydra.cc", "")
    assert "<dt>centers</dt><dd>rings</dd>" in text
    assert "<dt>centers.radius</dt>" not in text  # swept
    assert BAD_COUNT in text.replace("&#x27;", "'")
    assert re.search(r'class="number best"[^>]*>[^<]*', text)


def test_page_has_command_date_machine_versions_and_units(tmp_path: Path) -> None:
    for num, hour in enumerate((9, 7, 8)):
        path = (
            write_run(tmp_path / str(num), {"centers.radius": 0.1 + num}, {"settling_time": 1.5}) / "run.json"
        )
        facts = {"began": f"2026-11-26T0{hour}:00:00+00:00", "machine": NASTY, "python": "3.11.7"}
        facts["units"] = {"state": "rad, rad/s", "input": "N m"}
        path.write_text(json.dumps(json.loads(path.read_text()) | facts))
    lines = {"overrides": ["centers.radius=0.1,1.1,2.1", "note='two words'"], "hydra": ["hydra.sweep.dir=w"]}
    (tmp_path / "sweep.json").write_text(json.dumps({"version": "0.2", "jobs": [], **lines}))
    write_report(tmp_path, figures=False)
    text = (tmp_path / "report.html").read_text()
    assert Outline(text).tags.count("script") == 1
    text = html.unescape(text)
    for said in (
        """<dd>staf -m centers.radius=0.1,1.1,2.1 'note='"'"'two words'"'"'' hydra.sweep.dir=w</dd>""",
        "<dd>2026-11-26T07:00:00+00:00 to 2026-11-26T09:00:00+00:00</dd>",
        f"<dd>{NASTY}</dd>",
        "Python 3.11.7",
        "<dd>state rad, rad/s, input N m</dd>",
    ):
        assert said in text


def test_page_escapes_whatever_a_setting_holds(tmp_path: Path) -> None:
    write_run(tmp_path / "0", {"kernel": NASTY}, {"ball_error": 1.0})
    write_run(tmp_path / "1", {"kernel": "gaussian"}, None, status="failed", reason=NASTY)
    (tmp_path / "2").mkdir()
    (tmp_path / "2" / "run.json").write_text("damaged")
    found = collect(tmp_path)
    text = page(found, tabulate(found), {}, NASTY)
    assert Outline(text).tags.count("script") == 1
    assert html.unescape(text).count(NASTY) >= 4  # title, heading, note, cells
    assert "skipped" in text


# In a browser


@pytest.fixture(scope="module")
def browser(sweep: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        opened.open((sweep / "report.html").as_uri())
        yield opened


def column(browser: Browser, index: int) -> list[str]:
    rows = f"[...document.querySelectorAll('tbody tr')].map((r) => r.cells[{index}].textContent)"
    found: list[str] = browser.value(rows)
    return found


def heading(browser: Browser, name: str) -> int:
    heads: list[str] = browser.value("[...document.querySelectorAll('th')].map((h) => h.textContent)")
    return next(i for i, head in enumerate(heads) if head.startswith(name))


def numbers(cells: list[str]) -> list[float]:
    return [float(cell.split(" ")[0]) for cell in cells if cell != "-"]


def test_a_click_or_a_key_on_a_heading_sorts_by_number_with_what_is_missing_last(browser: Browser) -> None:
    index = heading(browser, "ball_error")
    before = column(browser, index)
    assert numbers(before) != sorted(numbers(before))
    for direction in ("ascending", "descending"):
        browser.click(f"th:nth-child({index + 1}) button")
        cells = column(browser, index)
        assert sorted(cells) == sorted(before)
        assert cells[-2:] == ["-", "-"]
        assert numbers(cells) == sorted(numbers(before), reverse=direction == "descending")
        assert browser.value(f"document.querySelectorAll('th')[{index}].ariaSort") == direction
    assert "largest first" in browser.value("document.getElementById('said').textContent")
    index = heading(browser, "centers.count")
    browser.value(f"document.querySelectorAll('th button')[{index}].focus()")
    browser.press("Enter")
    assert column(browser, index) == ["3", "3", "7", "7", "15", "15"]  # not as texts


def test_page_shows_its_figures_and_asks_for_nothing_else(browser: Browser) -> None:
    widths = browser.value("[...document.images].map((i) => i.naturalWidth)")
    assert len(widths) == 2
    assert all(width > 500 for width in widths)
    assert {address.partition(":")[0] for address in browser.requests} <= {"file", "data"}
    assert sum(address.startswith("file:") for address in browser.requests) == 1
