"""Figures that are not laid out."""

from __future__ import annotations

import pytest


@pytest.fixture
def not_laid_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where panels lie says nothing of what they hold, and takes nine tenths of the time."""
    monkeypatch.setattr("matplotlib.layout_engine.ConstrainedLayoutEngine.execute", lambda *_: None)
