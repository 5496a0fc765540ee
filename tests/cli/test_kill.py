"""A run that is killed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from command_line import environment

KILLED = """
import os, signal, sys
from pathlib import Path
import staf_torch.cli.staf as app
import staf_torch.experiments.gradient_chase  # so that the children share it

replace = os.replace
for survived in range(5):
    child = os.fork()
    if child == 0:
        folder = Path(f"killed{survived}")
        folder.mkdir()
        os.chdir(folder)
        sys.stdout = sys.stderr = open(os.devnull, "w")
        calls = []

        def killing(*names):
            calls.append(names)
            if len(calls) > survived:
                os.kill(os.getpid(), signal.SIGKILL)
            replace(*names)

        os.replace = killing
        sys.argv = ["staf", "duration=0.05", "settle_time=0", "figures=false"]
        app.main()
        os._exit(0)
    print(os.waitpid(child, 0)[1])
"""


def test_a_killed_run_leaves_no_file_that_reads_as_complete(tmp_path: Path) -> None:
    """Killed just before a file gets its name: the record that it runs (0), the history (1), the metrics (2),
    the record that it is complete (3), never (4)."""
    line = [sys.executable, "-c", KILLED]
    ended = subprocess.run(line, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["9", "9", "9", "9", "0"]
    present, status = [], []
    for survived in range(5):
        (run,) = (tmp_path / f"killed{survived}" / "runs").iterdir()
        present.append({path.name for path in run.glob("*.*") if not path.name.startswith(".")})
        status.append(json.loads((run / "run.json").read_text())["status"] if survived else None)
    names = ["staf.log", "run.json", "history.npz", "metrics.json"]
    assert present == [set(names[:1]), set(names[:2]), set(names[:3]), set(names), set(names)]
    assert status == [None, "running", "running", "running", "completed"]
