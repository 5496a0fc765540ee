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


def test_an_absent_extra_is_the_reason_of_what_lacks_it(monkeypatch: pytest.MonkeyPatch) -> None:
    found, gone = importlib.util.find_spec, set(EXTRAS.values())
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name, *of: None if name in gone else found(name, *of)
    )
    for error in (ModuleNotFoundError("x", name="scipy.linalg"), AssertionError(f"exit 1: {HINT}")):
        assert reason(error) == "scipy is not installed"
    assert reason(ModuleNotFoundError("x", name="torch.gone")) is None
    monkeypatch.setitem(EXTRAS, "adp", "torch")
    assert reason(ImportError(HINT)) is None  # it is installed


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.parametrize(("then", "code"), [("exit 3", 3), ("exec sleep 1000", 124)])
def test_a_daemon_ends_with_the_command_that_left_it(then: str, code: int, tmp_path: Path) -> None:
    """The command ends by itself, or by a signal."""
    line = [*CONTAINED, "60", "sh", "-c", f"{DAEMON} {then}"]
    contained = subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.DEVNULL)
    pid = tmp_path / "pid"
    while not pid.exists() or not pid.read_text():
        time.sleep(0.01)
    if code == 124:
        contained.send_signal(signal.SIGTERM)
    assert contained.wait() == code
    assert not alive(int(pid.read_text()))


def test_a_command_out_of_time_is_ended() -> None:
    assert subprocess.run([*CONTAINED, "0.2", "sleep", "1000"], check=False).returncode == 124
