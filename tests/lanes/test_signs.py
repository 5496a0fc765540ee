"""Signs of life: what a call says that takes long, where, and that short ones say nothing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from command_line import environment


def test_a_script_sees_what_is_going_on_and_how_far_it_is_and_not_the_calls_of_its_workers(
    tmp_path: Path,
) -> None:
    (tmp_path / "script.py").write_text(
        """
import multiprocessing, time
from staf_torch.signs import Sign
def work():
    with Sign("in a worker"):
        time.sleep(2.2)
if __name__ == "__main__":
    process = multiprocessing.get_context("spawn").Process(target=work)
    process.start()
    with Sign("a value", 4, "rounds") as sign:
        time.sleep(0.2)
        sign.advance()
        sign.advance()
        with Sign("compiling 3 lines"):
            process.join()
"""
    )
    command = [sys.executable, str(tmp_path / "script.py")]
    found = subprocess.run(command, env=environment(), capture_output=True, text=True, check=True)
    assert found.stdout == ""
    assert found.stderr == "a value: 50 % of 4 rounds, 3 s left; compiling 3 lines (2 s so far)\n"
