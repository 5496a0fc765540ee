"""`staf docs`: pages without a warning, with every public name, without a link that leads nowhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser
from command_line import environment
from public_names import public

from staf_torch.cli import reference

ATTRIBUTE = re.compile(r'\b(id|href|src)="([^"]*)"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages."""
    pytest.importorskip("pdoc")
    folder = tmp_path_factory.mktemp("reference")
    line = [sys.executable, "-W", "error", "-m", "staf_torch", "docs", "site"]
    ended = subprocess.run(line, env=environment(), capture_output=True, text=True, check=False, cwd=folder)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    assert ended.stdout == "reference pages: site/index.html\n"
    return folder / "site"


@pytest.fixture(scope="module")
def attributes(site: Path) -> dict[Path, list[tuple[str, str]]]:
    """Every id, link and source of each page."""
    return {page: ATTRIBUTE.findall(page.read_text(encoding="utf-8")) for page in site.rglob("*.html")}


def test_every_public_name_has_its_place_on_a_page(attributes: dict[Path, list[tuple[str, str]]]) -> None:
    places = {value for found in attributes.values() for kind, value in found if kind == "id"}
    assert {name.rpartition(".")[2] for name in public()} - places == set()


def test_every_link_leads_somewhere(attributes: dict[Path, list[tuple[str, str]]]) -> None:
    ids = {page: {value for kind, value in found if kind == "id"} for page, found in attributes.items()}
    lost, count = [], 0
    for page, found in attributes.items():
        for kind, value in found:
            if kind == "id" or "${" in value or value.startswith(("https://pdoc.dev", "data:")):
                continue  # the search's own template, the generator's mark
            file, _, anchor = value.partition("#")
            target = (page.parent / file).resolve() if file else page
            count += 1
            if not target.exists() or (anchor and anchor not in ids[target]):
                lost.append(f"{page.name}: {value}")
    assert count > 1000
    assert lost == []


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
def test_the_search_finds_ideal_weights_and_asks_no_server(site: Path, tmp_path: Path) -> None:
    with Browser(tmp_path) as browser:
        browser.open(f"{(site / 'staf_torch.html').as_uri()}?search=ideal+weights")
        for _ in range(2000):  # the index is being read
            found = browser.value("document.querySelector('main').innerText")
            if "StaFBasis.ideal_weights" in found:
                break
        assert "search results for 'ideal weights'" in found
        assert found.index("StaFBasis.ideal_weights") < 1000  # among the first
        assert {address.partition(":")[0] for address in browser.requests} <= {"file", "data", "blob"}


def test_without_pdoc_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reference.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"install the extra, pip install 'staf_torch\[docs\]'"):
        reference.main([])
    with pytest.raises(ValueError, match=r"takes one folder; got 'a b'"):
        reference.main(["a", "b"])
