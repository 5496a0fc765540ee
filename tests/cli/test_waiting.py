"""Threads of a command leave the processor to others while they wait."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CODE = "import os, sys, staf_torch.cli; print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"


@pytest.mark.parametrize("stated", [None, "active"])
def test_threads_wait_passively_unless_the_user_says_otherwise(stated: str | None) -> None:
    others = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    given = {} if stated is None else {"OMP_WAIT_POLICY": stated}
    command = [sys.executable, "-c", CODE]
    said = subprocess.run(command, env=others | given, capture_output=True, text=True, check=True).stdout
    assert said.split() == [stated or "passive", "False"]  # before torch is loaded, or it has no effect
