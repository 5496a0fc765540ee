"""Runs many command lines in a fork of this process, which has torch, each in a directory of its own."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import logging
import multiprocessing
import os
import runpy
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
    found = in_a_child(lambda: [one(str(folders[name]), list(argv)) for name, argv in jobs.items()], base)
    return {name: Outcome(*one, folders[name]) for name, one in zip(jobs, found, strict=True)}


def in_a_child(work: Callable[[], Any], base: Path) -> Any:
    """What JSON keeps of what a function returns in a child, with all that this process has imported."""

    def run() -> None:
        try:
            importlib.reload(warnings)  # what is told of them, as in an interpreter that has just begun
            logging.root.handlers.clear()  # those of pytest
            (base / "results.json").write_text(json.dumps(work()))
            _keep_coverage()
        except BaseException:
            (base / "error").write_text(traceback.format_exc())

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns where there are threads
        child = multiprocessing.get_context("fork").Process(target=run)
        child.start()
    child.join()
    assert not (base / "error").exists(), (base / "error").read_text()
    return json.loads((base / "results.json").read_text())


def _keep_coverage() -> None:
    """Write what a child executed, where somebody measures it: a fork that ends itself keeps nothing."""
    measuring = sys.modules["coverage"].Coverage.current() if "coverage" in sys.modules else None
    if measuring is not None:
        measuring.stop()
        measuring.save()


def environment() -> dict[str, str]:
    """This checkout first on the path of a new process."""
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": path}


def one(folder: str, argv: list[str]) -> tuple[int, str, str]:
    """One command line in this process: exit code, output, errors."""
    os.chdir(folder)
    os.environ.pop("HYDRA_FULL_ERROR", None)
    sys.argv = ["staf", *argv]
    path = list(sys.path)
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_module("staf_torch", run_name="__main__")
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
