"""Figures that are not laid out, and their looks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from figures.looks import looks, version
from matplotlib.figure import Figure
from recorded import Record


@pytest.fixture
def not_laid_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where panels lie says nothing of what they hold, and takes nine tenths of the time."""
    monkeypatch.setattr("matplotlib.layout_engine.ConstrainedLayoutEngine.execute", lambda *_: None)


@pytest.fixture
def looks_are_the_recorded(monkeypatch: pytest.MonkeyPatch, record: Record) -> Iterator[None]:
    """What is no number: colours, markers, sizes, where a legend is."""
    drawn: list[Figure] = []
    begin = Figure.__init__

    def kept(figure: Figure, *given: Any, **named: Any) -> None:
        begin(figure, *given, **named)
        drawn.append(figure)

    monkeypatch.setattr(Figure, "__init__", kept)
    yield
    found = {str(at): dict(enumerate(looks(figure))) for at, figure in enumerate(drawn)}
    if record.known().get("matplotlib", version()) == version():
        record({"matplotlib": version(), **found})
