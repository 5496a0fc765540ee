"""In this room libraries are built in a third of the time, but where rounding or speed is the matter."""

from __future__ import annotations

import os

import pytest

AS_FOR_USERS = ("bits", "test_compiled_is_the_definition", "within_their_bounds")


@pytest.fixture(autouse=True)
def _libraries_are_built_without_optimisation(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not any(words in request.node.name for words in AS_FOR_USERS):
        monkeypatch.setenv("CXXFLAGS", f"{os.environ.get('CXXFLAGS', '')} -O0")
