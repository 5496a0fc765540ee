"""In this room headers of C are built in a fraction of the time: their rounding is no matter of speed."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def quick_compiler(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """The C compiler, without optimisation."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "g++", "clang"))), None)
    if compiler is None:
        return None
    path = Path(tmp_path_factory.mktemp("compiler") / "quick-cc")
    path.write_text(f'#!/bin/sh\nexec {compiler} "$@" -O0\n')
    path.chmod(0o755)
    return path


@pytest.fixture(autouse=True)
def _headers_are_built_without_optimisation(
    quick_compiler: Path | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if quick_compiler is not None:
        monkeypatch.setenv("CC", str(quick_compiler))
        monkeypatch.setenv("CXXFLAGS", "-O0")
