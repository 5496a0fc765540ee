"""A sweep that a signal ends: with its report and the line that resumes, and to the same table in the end."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import environment

from staf_torch.cli import staf
from staf_torch.sweeps import signals

SUBMITIT = """
import os, types
from pathlib import Path

class AutoExecutor:
    '''As submitit's, on a SLURM that runs the first job and then goes away.'''
    cluster, count = "slurm", 0

    def __init__(self, folder, cluster):
        self.folder = Path(folder)

    def update_parameters(self, **parameters):
        pass

    def submit(self, task, *arguments):
        self.count += 1
        paths = types.SimpleNamespace(result_pickle=self.folder / str(self.count), stderr="none")
        if self.count == 1 and os.fork() == 0:
            try:
                (self.folder / "partial").write_bytes(task(*arguments))
                (self.folder / "partial").rename(paths.result_pickle)
            finally:
                os._exit(0)
        read = paths.result_pickle.read_bytes
        return types.SimpleNamespace(job_id=str(self.count), paths=paths, result=read)
"""
SIGNALLED = """
import os, random, signal, sys, time
import staf_torch.cli.staf as app
import staf_torch.sweeps.executors.controller as controller
import staf_torch.experiments.gradient_chase  # so that the children share it

GRID = ["centers.count=3,4,6", "centers.radius=0.1,0.2", "hydra.launcher.batch=1"]
GRID += ["duration=0.05", "settle_time=0", "figures=false", "history=false"]

def start(place, *argv):
    child = os.fork()
    if child == 0:
        for number in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        sys.stdout = sys.stderr = open(f"{place}.log", "a")
        sys.argv = ["staf", "-m", *argv]
        code = 0
        try:
            app.main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
            sys.stderr.write(f"{end.code}\\n")
        sys.stderr.flush()
        os._exit(code)
    return child

def ended(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

codes = {"whole": ended(start("whole", *GRID, "hydra.sweep.dir=whole"))}
chance = random.Random(3)
for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
    place = number.name
    child = start(place, *GRID, f"hydra.sweep.dir={place}")
    jobs = chance.randint(1, 3)
    while not os.path.exists(f"{place}/{jobs}/run.json"):
        time.sleep(0.0005)
    os.kill(child, number)
    codes[place] = ended(child)
    codes[f"{place} again"] = ended(start(f"{place}2", f"sweep.resume={place}"))

controller._ASK, controller._END = 0.05, 0.3
os.environ["PATH"] = os.pathsep.join([os.getcwd(), os.environ["PATH"]])
slurm = ["hydra.launcher.executor=submitit", "+hydra.launcher.submitit.cluster=slurm"]
child = start("slurm", *GRID, *slurm, "hydra.sweep.dir=slurm")
while not os.path.exists("squeue.hangs"):
    time.sleep(0.0005)
os.kill(child, signal.SIGTERM)
codes["slurm"] = ended(child)
codes["slurm again"] = ended(start("slurm2", "sweep.resume=slurm", "hydra.launcher.executor=inline"))
import json
print(json.dumps(codes))
"""


def test_signals_end_a_sweep_with_its_report_and_the_line_that_resumes(tmp_path: Path) -> None:
    (tmp_path / "submitit.py").write_text(SUBMITIT)
    for name, first in (("squeue", "grep -q completed slurm/0/run.json || exit 1"), ("scancel", "")):
        (tmp_path / name).write_text(f'#!/bin/sh\n{first}\n: > "$0.hangs"\nexec sleep 30\n')
        (tmp_path / name).chmod(0o755)
    line = [sys.executable, "-c", SIGNALLED]
    run = subprocess.run(line, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    codes = json.loads(run.stdout)
    assert codes["whole"] == 1  # two jobs have a count that there is not
    for name, code, said in (
        ("SIGTERM", 143, "ended by SIGTERM"),
        ("SIGHUP", 129, "ended by SIGHUP"),
        ("SIGINT", 130, "interrupted"),
        ("slurm", 143, "ended by SIGTERM; 1 jobs are complete"),  # whose commands hang
    ):
        log = (tmp_path / f"{name}.log").read_text()
        assert codes[name] == code, log
        assert f"staf: {said}" in log
        assert f"staf -m sweep.resume={name}" in log
        assert "report: " in log
        assert codes[f"{name} again"] == 1
        assert (tmp_path / name / "table.csv").read_text() == (tmp_path / "whole" / "table.csv").read_text()
    assert "cancels 5 jobs (scancel did not end in time)" in (tmp_path / "slurm.log").read_text()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_within_a_finaliser_is_not_lost(number: signal.Signals) -> None:
    class Dying:
        def __del__(self) -> None:
            signal.raise_signal(number)

    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)  # a shell's background jobs ignore some
    with signals.stopped_by_signals():
        signals.check()
        Dying()  # Python prints what is raised there, and goes on
        with pytest.raises(signals.Stopped) as stopped:
            signals.check()
    assert stopped.value.number == number
    signals.check()
    assert signal.getsignal(number) == usual
    signal.signal(number, before)


def ends_in_a_sentence(number: signal.Signals, capsys: pytest.CaptureFixture[str]) -> None:
    """Run the program, patched so that the signal comes while it runs."""
    before = signal.signal(number, signal.SIG_DFL)  # a shell's background jobs ignore some
    try:
        with pytest.raises(SystemExit) as ended:
            staf.main()
    finally:
        signal.signal(number, before)
    assert ended.value.code == 128 + number
    assert capsys.readouterr().err == f"staf: ended by {number.name}\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_before_the_first_line_of_the_program_ends_in_a_sentence(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @contextlib.contextmanager
    def struck() -> Iterator[None]:
        with signals.stopped_by_signals():
            signal.raise_signal(number)
            yield

    monkeypatch.setattr(staf, "stopped_by_signals", struck)
    monkeypatch.setattr(sys, "argv", ["staf", "figures=false"])
    ends_in_a_sentence(number, capsys)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_an_error_that_a_signal_left_behind_in_a_library_is_told_as_the_signal(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """OmegaConf makes an error of its own of what is raised while it changes a node."""

    def composing() -> None:
        try:
            signal.raise_signal(number)
        finally:
            raise AttributeError("'NoneType' object has no attribute '_invalidate_flags_cache'")

    monkeypatch.setattr(staf, "_staf", composing)
    monkeypatch.setattr(sys, "argv", ["staf", "figures=false"])
    ends_in_a_sentence(number, capsys)
    error = ValueError("of no signal")
    assert signals.what_ended(error) is error
