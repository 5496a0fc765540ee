"""In this room libraries are built in a third of the time, but where bits are the matter."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def _libraries_are_built_without_optimisation(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "bit" not in request.node.name:
        monkeypatch.setenv("CXXFLAGS", f"{os.environ.get('CXXFLAGS', '')} -O0")
