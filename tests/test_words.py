"""Plain words: how long the sentences of manuals are, and a spell checker."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import ROOT

MANUALS = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "runs" / "README.md",
    ROOT / "conf" / "README.md",
    ROOT / "tests" / "README.md",
    ROOT / "tests" / "benchmarks" / "README.md",
]
MANUALS += sorted((ROOT / "staf_torch").rglob("*.md"))
SHAPES = re.compile(r"^```.*?^```$|^ {4}.*?$|^\|.*?$|^#.*?$|^!\[.*?$", re.DOTALL | re.MULTILINE)


def sentences(path: Path) -> Iterator[str]:
    text = SHAPES.sub("\n\n", path.read_text(encoding="utf-8"))
    for paragraph in re.split(r"\n\s*\n|\n[*-] ", re.sub(r"\]\([^)]*\)", "]", text)):
        yield from re.split(r"(?<=[.!?])\s+(?=[A-Z`*\[(\"])", paragraph)


@pytest.mark.parametrize("path", MANUALS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_manual_is_a_page_of_sentences_that_can_be_read_aloud(path: Path) -> None:
    limit = {"README.md": 150, "CHANGELOG.md": 60}.get(str(path.relative_to(ROOT)), 120)
    limit += 10 * (path.parent.name == "guides")  # they are programs, too
    limit += 1000 * (path.name == "GALLERY.md" or path.parent.name == "benchmarks")  # pictures; tables
    assert len(path.read_text(encoding="utf-8").splitlines()) <= limit
    long = [" ".join(each.split()) for each in sentences(path) if len(re.findall(r"\S*\w\S*", each)) > 40]
    assert long == []


def test_words_are_spelled_as_a_dictionary_has_them() -> None:
    checker = shutil.which("codespell")
    if checker is None:
        pytest.skip("codespell is not installed")
    ended = subprocess.run([checker], cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout
