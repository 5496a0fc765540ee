"""Signs of life: what a call says that takes long, where, and that short ones say nothing."""

from __future__ import annotations

import io
import logging
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import environment

from staf_torch.signs import Sign


class Terminal(io.StringIO):
    """Where bars are shown."""

    def isatty(self) -> bool:
        return True


def test_a_terminal_has_a_bar_under_the_log_that_is_wiped_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    handler = logging.StreamHandler(shown)
    logging.getLogger().addHandler(handler)
    try:
        with Sign("a sum", 8, "parts") as sign:
            sign.advance()
            sign.advance()
            while "a sum" not in shown.getvalue():
                time.sleep(0.05)
            logging.getLogger("elsewhere").warning("above")
            time.sleep(0.4)
    finally:
        logging.getLogger().removeHandler(handler)
    found = shown.getvalue()
    assert found.startswith("\r 25 %|######                  | a sum: 25 % of 8 parts, ")
    assert "\r\x1b[Kabove\n\r 25 %|" in found
    assert found.endswith("\r\x1b[K")


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
