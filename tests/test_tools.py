"""The tools of the tests: what is skipped, what is left behind."""

from __future__ import annotations

import importlib.util
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from absent_extras import EXTRAS, reason

HINT = "LQR needs SciPy: pip install 'staf_torch[adp]'."
CONTAINED = [sys.executable, str(Path(__file__).with_name("contained.py"))]
DAEMON = "setsid sh -c 'echo $$ > pid; exec sleep 1000' & while [ ! -s pid ]; do sleep .01; done;"


def chained(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "absent"),
    [
        (ModuleNotFoundError("No module named 'scipy'", name="scipy.linalg"), "scipy"),
        (ImportError(HINT), "scipy"),
        (AssertionError(f"exit 1: {HINT}"), "scipy"),
        (chained(ValueError("no LQR"), ModuleNotFoundError("x", name="scipy")), "scipy"),
        (ModuleNotFoundError("No module named 'torch.gone'", name="torch.gone"), None),
        (AssertionError("scipy gave 2"), None),
    ],
)
def test_an_absent_extra_is_the_reason_of_what_lacks_it(
    error: Exception, absent: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, gone = importlib.util.find_spec, set(EXTRAS.values())
    with monkeypatch.context() as patched:
        patched.setattr(
            "importlib.util.find_spec", lambda name, *of: None if name in gone else found(name, *of)
        )
        assert reason(error) == (None if absent is None else f"{absent} is not installed")
        patched.setitem(EXTRAS, "adp", "torch")
        assert reason(ImportError(HINT)) is None  # it is installed


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.parametrize("ended", ["by itself", "by a signal"])
def test_a_daemon_ends_with_the_command_that_left_it(ended: str, tmp_path: Path) -> None:
    line = [
        *CONTAINED,
        "60",
        "sh",
        "-c",
        f"{DAEMON} {'exit 3' if ended == 'by itself' else 'exec sleep 1000'}",
    ]
    contained = subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.DEVNULL)
    pid = tmp_path / "pid"
    while not pid.exists() or not pid.read_text():
        time.sleep(0.01)
    if ended == "by a signal":
        contained.send_signal(signal.SIGTERM)
    assert contained.wait() == {"by itself": 3, "by a signal": 124}[ended]
    assert not alive(int(pid.read_text()))


def test_a_command_out_of_time_is_ended() -> None:
    assert subprocess.run([*CONTAINED, "0.2", "sleep", "1000"], check=False).returncode == 124
