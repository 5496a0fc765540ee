"""A small memory of the pendulum's swing-up, learned once for all tests, and compilers that are quick."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from helpers_swingup import REGION, pendulum

from staf_torch import adp


@pytest.fixture(scope="session")
def memory() -> adp.GlobalValue:
    return adp.learn_global_value(pendulum(), REGION, steps=120, trajectories=60, rounds=1, states=60)


@pytest.fixture(scope="session")
def quick_c(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """The C compiler, without optimisation."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "g++", "clang"))), None)
    if compiler is None:
        return None
    path = Path(tmp_path_factory.mktemp("compiler") / "quick-cc")
    path.write_text(f'#!/bin/sh\nexec {compiler} "$@" -O0\n')
    path.chmod(0o755)
    return path


@pytest.fixture(autouse=True)
def _programs_are_built_without_optimisation(
    request: pytest.FixtureRequest, quick_c: Path | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But where bits are the matter."""
    if "bit" not in request.node.name:
        monkeypatch.setenv("CXXFLAGS", f"{os.environ.get('CXXFLAGS', '')} -O0")
    if quick_c is not None:
        monkeypatch.setenv("CC", str(quick_c))
