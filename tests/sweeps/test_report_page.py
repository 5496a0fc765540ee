"""`report.html`, as text and in a browser."""

from __future__ import annotations

import html
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser
from sweep_runs import BAD_COUNT, write_run, write_sweep

from staf_torch.results.reader import collect
from staf_torch.sweeps.report import page, write_report
from staf_torch.tables import tabulate

NASTY = "<script>alert(1)</script>\"'&${x}{{ 7 * 7 }}"


class _Outline(HTMLParser):
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
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Errors 0.0128, 0.0512, ... in the order of the rows, and one that is missing."""
    directory = write_sweep(
        tmp_path_factory.mktemp("page") / "sweep", kernels=["exponential"], counts=(3, 15, 7)
    )
    write_report(directory)
    return directory


def test_page_has_the_table_the_figures_and_the_settings_and_loads_nothing(sweep: Path) -> None:
    text = (sweep / "report.html").read_text()
    outline = _Outline(text)
    assert outline.tags.count("img") == 2
    assert outline.tags.count("table") == 1
    assert outline.tags.count("script") == 1
    assert all(address.startswith("data:") for address in outline.addresses)
    assert "http" not in text.replace("https://hydra.cc", "")
    assert "<dt>centers</dt><dd>rings</dd>" in text
    assert "<dt>centers.radius</dt>" not in text  # swept
    assert "3 runs have" not in text
    assert BAD_COUNT in text.replace("&#x27;", "'")


def test_page_escapes_whatever_a_setting_holds(tmp_path: Path) -> None:
    write_run(tmp_path / "0", {"kernel": NASTY}, {"ball_error": 1.0})
    write_run(tmp_path / "1", {"kernel": "gaussian"}, None, status="failed", reason=NASTY)
    found = collect(tmp_path)
    text = page(found, tabulate(found), {}, NASTY)
    assert _Outline(text).tags.count("script") == 1
    assert html.unescape(text).count(NASTY) >= 4  # title, heading, note, cells


# In a browser


@pytest.fixture(scope="module")
def browser(sweep: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with Browser(tmp_path_factory.mktemp("profile")) as opened:
        opened.open((sweep / "report.html").as_uri())
        yield opened


def _column(browser: Browser, index: int) -> list[str]:
    rows = f"[...document.querySelectorAll('tbody tr')].map((r) => r.cells[{index}].textContent)"
    found: list[str] = browser.value(rows)
    return found


def _heading(browser: Browser, name: str) -> int:
    heads: list[str] = browser.value("[...document.querySelectorAll('th')].map((h) => h.textContent)")
    return next(i for i, head in enumerate(heads) if head.startswith(name))


def _numbers(cells: list[str]) -> list[float]:
    return [float(cell.split(" ")[0]) for cell in cells if cell != "-"]


def test_a_click_on_a_heading_sorts_by_number_with_what_is_missing_last(browser: Browser) -> None:
    index = _heading(browser, "ball_error")
    before = _column(browser, index)
    assert _numbers(before) != sorted(_numbers(before))
    for direction in ("ascending", "descending", "ascending"):
        browser.click(f"th:nth-child({index + 1}) button")
        cells = _column(browser, index)
        assert sorted(cells) == sorted(before)
        assert cells[-2:] == ["-", "-"]
        assert _numbers(cells) == sorted(_numbers(before), reverse=direction == "descending")
        assert browser.value(f"document.querySelectorAll('th')[{index}].ariaSort") == direction
    assert "smallest first" in browser.value("document.getElementById('said').textContent")


def test_numbers_are_not_sorted_as_texts_and_the_keyboard_does_it_too(browser: Browser) -> None:
    index = _heading(browser, "centers.count")
    browser.value(f"document.querySelectorAll('th button')[{index}].focus()")
    browser.press("Enter")
    assert _column(browser, index) == ["3", "3", "7", "7", "15", "15"]
    sorted_by = browser.value("[...document.querySelectorAll('th')].map((h) => h.ariaSort)")
    assert sorted_by.count("none") == len(sorted_by) - 1


def test_page_shows_its_figures_and_asks_for_nothing_else(browser: Browser, sweep: Path) -> None:
    widths = browser.value("[...document.images].map((i) => i.naturalWidth)")
    assert len(widths) == 2
    assert all(width > 500 for width in widths)
    assert {address.partition(":")[0] for address in browser.requests} <= {"file", "data"}
    assert sum(address.startswith("file:") for address in browser.requests) == 1
