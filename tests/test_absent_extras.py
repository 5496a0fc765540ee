"""A test is skipped for an extra that is not here, and for no other reason."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
from absent_extras import EXTRAS, reason

import staf_torch


@pytest.fixture(autouse=True)
def _none_is_here(monkeypatch: pytest.MonkeyPatch) -> None:
    found, gone = importlib.util.find_spec, set(EXTRAS.values())
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name, *of: None if name in gone else found(name, *of)
    )


def chained(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


def raised(
    error: Exception, file: str = str(Path(staf_torch.__file__).parent / "numerics" / "x.py")
) -> Exception:
    """The error, as it is where a file raises it: by default one of the package."""
    try:
        exec(compile("raise error", file, "exec"), {"error": error})
    except Exception as found:
        return found
    raise AssertionError("nothing was raised")


HINT = "LQR needs SciPy: pip install 'staf_torch[adp]'."


@pytest.mark.parametrize(
    ("error", "absent"),
    [
        (ModuleNotFoundError("No module named 'scipy'", name="scipy.linalg"), "scipy"),
        (raised(ImportError(HINT)), "scipy"),
        (chained(AssertionError("not what was expected"), raised(ValueError(HINT))), "scipy"),
        (chained(ValueError("no LQR"), ModuleNotFoundError("x", name="scipy")), "scipy"),
        (raised(ValueError("no LQR")), None),
        (raised(AssertionError(f"{HINT!r} is not said"), __file__), None),
        (AssertionError(f"Regex pattern did not match: {HINT}"), None),
        (ModuleNotFoundError("No module named 'torch.gone'", name="torch.gone"), None),
        (ModuleNotFoundError("No module named 'scipi'", name="scipi"), None),
        (AssertionError("scipy gave 2"), None),
    ],
)
def test_an_absent_extra_is_the_reason_of_what_lacks_it(error: Exception, absent: str | None) -> None:
    assert reason(error) == (None if absent is None else f"{absent} is not installed")


@pytest.mark.parametrize("code", [0, 1])
def test_a_failure_that_quotes_a_process_is_excused_where_that_ended_so(code: int) -> None:
    hint = f"process {code} needs Gymnasium: pip install 'staf_torch[gym]'."
    line = [sys.executable, "-S", "-c", f"import sys; print({hint!r}, file=sys.stderr); sys.exit({code})"]
    said = subprocess.run(line, capture_output=True, text=True, check=False).stderr
    assert reason(AssertionError(f"exit {code}: {said}")) == ("gymnasium is not installed" if code else None)
    assert reason(AssertionError("another one needs Gymnasium: pip install 'staf_torch[gym]'.")) is None


def test_an_extra_that_is_here_is_no_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRAS, "adp", "torch")
    assert reason(raised(ImportError("pip install 'staf_torch[adp]'"))) is None
