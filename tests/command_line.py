"""Runs many command lines in one process, so that torch is imported once, each in a directory of its own.

As a script: `python command_line.py JOBS RESULTS` with two JSON files.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PLANTS = '''
import torch
from torch import nn
from staf_torch import Kernel
from staf_torch.engine.predictors import Predictor
from staf_torch.metrics import Metric
from staf_torch.optim import UpdateLaw
from staf_torch.sweeps.callbacks import Tracker

class Escape(nn.Module):
    """x' = x^2: a user's plant without a flow, a dimension or a base class."""
    def drift(self, x):
        return x ** 2

class Wrong(nn.Module):
    def drift(self, x):
        return x[..., :1]

class Cauchy(Kernel):
    def __init__(self, width=1.0):
        super().__init__()
        self.width = width
    def forward(self, x1, x2):
        return 1 / (1 + (x1.unsqueeze(-2) - x2.unsqueeze(-3)).square().sum(-1) / self.width ** 2)

class Shrinking(UpdateLaw):
    """A user's law: descent at a step that shrinks from iteration to iteration, a number a row."""
    def __init__(self, rate=0.5):
        self.rate = rate
    def init(self, weights):
        return (torch.full_like(weights[..., 0], self.rate),)
    def step(self, objective, weights, state):
        length = state[0] / objective.gram.square().sum((-1, -2)).sqrt()
        return weights + length.unsqueeze(-1) * objective.descent(weights), (0.99 * state[0],)

class Still(Predictor):
    """A user's predictor: the paper's weights stay."""
    def predict(self, inputs, weights, previous, unit):
        return unit * weights

class Largest(Metric):
    """A user's metric: the norm of the state."""
    name = "largest_state"
    def __call__(self, result, problem):
        return result.state.norm(dim=-1)

class Lines(Tracker):
    """A user's tracker: a line a run."""
    def record(self, run):
        with open(run.directory / "staf.log", "a") as file:
            file.write(f"tracked {run.settings['kernel']} {run.metrics['ball_error']}\\n")

def bowl(x):
    return x.square().sum(-1)

def wrong(x):
    return x
'''


class Outcome(NamedTuple):
    """What a command line left behind."""

    code: int
    out: str
    err: str
    folder: Path  # its working directory

    @property
    def left(self) -> set[str]:
        """Every file and folder in the working directory but the user's module."""
        return {
            p.name for p in self.folder.iterdir() if p.name not in ("plants.py", "__pycache__", "blocked")
        }


def run_all(jobs: Mapping[str, Sequence[str]], base: Path, module: str = PLANTS) -> dict[str, Outcome]:
    """Every command line (without the program) in a fresh folder that holds ``module`` as `plants.py`."""
    folders = {name: base / str(index) for index, name in enumerate(jobs)}
    for folder in folders.values():
        folder.mkdir()
        (folder / "plants.py").write_text(module)
        (folder / "blocked").write_text("a file where a directory should be\n")
    from absent_extras import heard  # not in the process that runs them

    listed = [{"folder": str(folders[name]), "argv": list(argv)} for name, argv in jobs.items()]
    (base / "jobs.json").write_text(json.dumps(listed))
    program = [sys.executable, __file__, str(base / "jobs.json"), str(base / "results.json")]
    ended = subprocess.run(program, cwd=base, env=environment(), capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    results = json.loads((base / "results.json").read_text())
    for code, *said in results:
        heard(code, *said)
    return {name: Outcome(*found, folders[name]) for name, found in zip(jobs, results, strict=True)}


def environment() -> dict[str, str]:
    """This checkout first on the path of a new process."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path}


def one(folder: str, argv: list[str]) -> tuple[int, str, str]:
    """One command line in this process: exit code, output, errors."""
    from staf_torch.cli.staf import main

    os.chdir(folder)
    os.environ.pop("HYDRA_FULL_ERROR", None)
    sys.argv = ["staf", *argv]
    path = list(sys.path)
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            # As the interpreter does it: a text goes to stderr, and the code is 1.
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                err.write(end.code + "\n")
        except BaseException:
            traceback.print_exc(file=err)
            code = 99
    logging.shutdown()
    root = logging.getLogger()
    for handler in root.handlers[:]:  # of the run: the next message would open its file again
        if isinstance(handler, logging.FileHandler) and handler.baseFilename.endswith("staf.log"):
            root.removeHandler(handler)
    sys.path[:] = path
    sys.modules.pop("plants", None)
    return code, out.getvalue(), err.getvalue()


if __name__ == "__main__":
    jobs = json.loads(Path(sys.argv[1]).read_text())
    target = Path(sys.argv[2])
    target.write_text(json.dumps([one(job["folder"], job["argv"]) for job in jobs]))
