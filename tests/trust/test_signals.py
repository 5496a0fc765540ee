"""What ends a run or a sweep: signals, with a report and the line that resumes; kills; places that vanish."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import pytest
from command_line import in_a_child, one

from staf_torch.results.reader import collect
from staf_torch.sweeps import workers

SIGNALLED = '''
import os, random, signal, sys, time
import staf_torch.cli.staf as app

GRID = ["centers.count=3,4", "centers.radius=0.1,0.2", "hydra.launcher.batch=1"]
GRID += ["duration=0.02", "settle_time=0", "figures=false", "history=false"]

def run(place, *argv):
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
    return code

def start(place, *argv):
    child = os.fork()
    if child == 0:
        os._exit(run(place, *argv))
    return child

def ended(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

def killed_before_a_name(survived):
    """A run that is killed just before the file after so many others gets its name."""
    child = os.fork()
    if child == 0:
        os.mkdir(f"run{survived}")
        os.chdir(f"run{survived}")
        sys.stdout = sys.stderr = open(os.devnull, "w")
        calls, replace = [], os.replace

        def killing(*names):
            calls.append(names)
            if len(calls) > survived:
                os.kill(os.getpid(), signal.SIGKILL)
            replace(*names)

        os.replace = killing
        sys.argv = ["staf", "duration=0.05", "settle_time=0", "figures=false"]
        app.main()
        os._exit(0)
    return child

run("shared", *GRID, "hydra.sweep.dir=shared")  # what it imports and composes the children share, too
begin = time.monotonic()
codes = {"whole": ended(start("whole", *GRID, "hydra.sweep.dir=whole"))}
whole = time.monotonic() - begin
codes["runs"] = [ended(killed_before_a_name(survived)) for survived in range(5)]
chance = random.Random(3)
for number in (signal.SIGTERM, signal.SIGINT, signal.SIGKILL):
    place = number.name
    child = start(place, *GRID, f"hydra.sweep.dir={place}")
    first = "sweep.json" if number == signal.SIGKILL else "0/run.json"
    while not os.path.exists(f"{place}/{first}"):
        assert os.waitpid(child, os.WNOHANG) == (0, 0), "the sweep ended before it began"
        time.sleep(0.001)
    if number == signal.SIGKILL:  # anywhere from the first file of the sweep on
        time.sleep(chance.uniform(0, whole))
    os.kill(child, number)
    codes[place] = ended(child)
    if number != signal.SIGINT:
        codes[f"{place} again"] = ended(start(f"{place}2", f"sweep.resume={place}"))
'''


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where sweeps were ended and resumed, by children of one process; `codes.json` says how each ended."""
    folder = tmp_path_factory.mktemp("signals")
    codes = in_a_child(lambda: ended_and_resumed(folder), folder)
    (folder / "codes.json").write_text(json.dumps(codes))
    return folder


def ended_and_resumed(folder: Path) -> object:
    """Run `SIGNALLED` in a folder whose modules it finds; return the codes."""
    os.chdir(folder)
    sys.path.insert(0, "")
    names: dict[str, object] = {}
    exec(SIGNALLED, names)
    return names["codes"]


def test_signals_end_a_sweep_with_its_report_and_the_line_that_resumes(place: Path) -> None:
    codes = json.loads((place / "codes.json").read_text())
    assert codes["whole"] == 1  # two jobs have a count that there is not
    for name, code, said in (("SIGTERM", 143, "ended by SIGTERM"), ("SIGINT", 130, "interrupted")):
        log = (place / f"{name}.log").read_text()
        assert codes[name] == code, log
        assert f"staf: {said}" in log
        assert f"staf -m sweep.resume={name}" in log
        assert "report: " in log
    whole = (place / "whole" / "table.csv").read_text()
    for name in ("SIGTERM", "SIGKILL"):  # killed at a random time it ends as if it had not been
        assert codes[f"{name} again"] == 1
        assert (place / name / "table.csv").read_text() == whole


def test_a_killed_run_leaves_no_file_that_reads_as_complete(place: Path) -> None:
    """Killed just before a file gets its name: the record that it runs (0), the history (1), the metrics (2),
    the record that it is complete (3), never (4)."""
    assert json.loads((place / "codes.json").read_text())["runs"] == [-9, -9, -9, -9, 0]
    present, status = [], []
    for survived in range(5):
        (run,) = (place / f"run{survived}" / "runs").iterdir()
        present.append({path.name for path in run.glob("*.*") if not path.name.startswith(".")})
        status.append(json.loads((run / "run.json").read_text())["status"] if survived else None)
    names = ["staf.log", "run.json", "history.npz", "metrics.json"]
    assert present == [set(names[:1]), set(names[:2]), set(names[:3]), set(names), set(names)]
    assert status == [None, "running", "running", "running", "completed"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_within_a_finaliser_is_not_lost(number: signal.Signals) -> None:
    class Dying:
        def __del__(self) -> None:
            signal.raise_signal(number)

    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)  # a shell's background jobs ignore some
    with workers.stopped_by_signals():
        workers.check()
        Dying()  # Python prints what is raised there, and goes on
        with pytest.raises(workers.Stopped) as stopped:
            workers.check()
    assert stopped.value.number == number
    workers.check()
    assert signal.getsignal(number) == usual
    signal.signal(number, before)


# Places that vanish or cannot be written

HARMFUL = """
import os, shutil
from pathlib import Path

def bowl(x):  # a user's target, that once does harm after the first job is complete
    harm = Path("harm.py")
    if harm.exists() and Path("sweep/0/metrics.json").exists() and Path("sweep/1").exists():
        text = harm.read_text()
        harm.unlink()
        exec(text)
    return x.square().sum(-1)
"""
SWEEP = ["-m", "seed=range(3)", "duration=0.05", "settle_time=0", "figures=false", "hydra.sweep.dir=sweep"]
SWEEP += ["target=custom", "target.path=harmful.bowl", "hydra.launcher.batch=1"]


def harmed(place: Path, harm: str) -> tuple[int, str, str]:
    """A sweep in which a target does harm while its second job runs; code, output and errors."""
    (place / "harmful.py").write_text(HARMFUL)
    (place / "harm.py").write_text(harm)
    code, out, err = in_a_child(lambda: one(str(place), SWEEP), place)
    assert not (place / "harm.py").exists()
    return code, out, err


def test_a_directory_that_is_removed_ends_its_sweep(tmp_path: Path) -> None:
    code, out, err = harmed(tmp_path, "shutil.rmtree('sweep')")
    assert code == 1
    assert "sweep was removed or replaced while its sweep went on" in err
    assert "completed" not in out


def test_a_disk_that_takes_no_file_fails_what_it_hits_and_resume_ends_the_sweep(tmp_path: Path) -> None:
    code, _, err = harmed(tmp_path, "os.makedirs('sweep/2/.metrics.json.partial')")
    assert code == 1
    assert "job 2 (seed=2 " in err
    assert "failed: cannot write" in err
    assert [run.status for run in collect(tmp_path / "sweep").rows] == ["completed", "completed", "failed"]
    (tmp_path / "sweep" / "2" / ".metrics.json.partial").rmdir()
    line = ["-m", "sweep.resume=sweep", "--trust"]
    assert in_a_child(lambda: one(str(tmp_path), line), tmp_path)[0] == 0
    assert [run.status for run in collect(tmp_path / "sweep").rows] == ["completed"] * 3
