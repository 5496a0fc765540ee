"""A command that is contained leaves nothing, however its daemons have left it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

CONTAINED = [sys.executable, str(Path(__file__).with_name("contained.py"))]
DAEMON = "setsid sh -c 'echo $$ > pid; exec sleep 1000' & while [ ! -s pid ]; do sleep .01; done;"


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def test_a_daemon_ends_with_the_command_that_left_it(tmp_path: Path) -> None:
    line = [*CONTAINED, "60", "sh", "-c", f"{DAEMON} exit 3"]
    assert subprocess.run(line, cwd=tmp_path, check=False, capture_output=True).returncode == 3
    assert not alive(int((tmp_path / "pid").read_text()))


def test_a_command_out_of_time_is_ended() -> None:
    assert subprocess.run([*CONTAINED, "0.2", "sleep", "1000"], check=False).returncode == 124


def test_nothing_stays_where_the_container_itself_is_told_to_end(tmp_path: Path) -> None:
    line = [*CONTAINED, "60", "sh", "-c", f"{DAEMON} sleep 1000"]
    contained = subprocess.Popen(line, cwd=tmp_path, stderr=subprocess.DEVNULL)
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
        time.sleep(0.01)
    os.kill(contained.pid, signal.SIGTERM)
    assert contained.wait() == 124
    assert not alive(int((tmp_path / "pid").read_text()))
