"""Reference pages: built by pdoc where it is installed, without a warning, with every public name."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import environment

import staf_torch

NAMES = sorted(
    {*staf_torch.__all__, "read_runs", "run", "sweep"}
    - {name for name in staf_torch.__all__ if inspect.ismodule(getattr(staf_torch, name))}
)
MODULES = sorted({getattr(staf_torch, name).__module__ for name in NAMES})


@pytest.mark.parametrize("name", NAMES)
def test_a_public_name_says_what_it_is(name: str) -> None:
    assert inspect.getdoc(getattr(staf_torch, name))


def test_every_public_name_has_its_place_on_a_page(tmp_path: Path) -> None:
    pytest.importorskip("pdoc")
    # The annotations of a NamedTuple are evaluated in `typing`, which knows none of our names.
    strict = ["-W", "error", "-W", "ignore:Error parsing type annotation ForwardRef:UserWarning"]
    line = [sys.executable, *strict, "-m", "pdoc", "-d", "google", "--math", "-o", str(tmp_path)]
    ended = subprocess.run(
        [*line, *MODULES], env=environment(), capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert ended.returncode == 0, ended.stderr
    assert "Warn" not in ended.stderr
    for name in NAMES:
        page = tmp_path / (getattr(staf_torch, name).__module__.replace(".", "/") + ".html")
        assert f'id="{name}"' in page.read_text(encoding="utf-8"), name
