"""A test is skipped for an extra that is not here, and for no other reason."""

from __future__ import annotations

import importlib.util

import pytest
from absent_extras import EXTRAS, reason


@pytest.fixture(autouse=True)
def _none_is_here(monkeypatch: pytest.MonkeyPatch) -> None:
    found, gone = importlib.util.find_spec, set(EXTRAS.values())
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name, *of: None if name in gone else found(name, *of)
    )


def chained(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "absent"),
    [
        (ModuleNotFoundError("No module named 'scipy'", name="scipy.linalg"), "scipy"),
        (ImportError("LQR needs SciPy: pip install 'staf_torch[adp]'."), "scipy"),
        (AssertionError("exit 1: needs Gymnasium: pip install 'staf_torch[gym]'."), "gymnasium"),
        (chained(ValueError("no LQR"), ModuleNotFoundError("x", name="scipy")), "scipy"),
        (ModuleNotFoundError("No module named 'torch.gone'", name="torch.gone"), None),
        (ModuleNotFoundError("No module named 'scipi'", name="scipi"), None),
        (AssertionError("scipy gave 2"), None),
    ],
)
def test_an_absent_extra_is_the_reason_of_what_names_it(error: Exception, absent: str | None) -> None:
    assert reason(error) == (None if absent is None else f"{absent} is not installed")


def test_an_extra_that_is_here_is_no_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRAS, "adp", "torch")
    assert reason(ImportError("pip install 'staf_torch[adp]'")) is None
