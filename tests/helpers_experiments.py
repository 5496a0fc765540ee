"""Every experiment, run short and once for all tests: its metrics, files, figures, log and progress."""

from __future__ import annotations

import csv
import functools
import json
import logging
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from composing import settings
from matplotlib.figure import Figure

from staf_torch.experiments.registry import experiment
from staf_torch.figures.style import keep_figures
from staf_torch.signs import Progress

CASES: dict[str, str] = {
    "adp": "experiment=adp duration=0.3 dt=0.005 trajectories=2",
    "adp_comparison": "experiment=adp_comparison duration=0.04 dt=0.01 trajectories=20",
    "adp_initial_weights": "experiment=adp_initial_weights duration=0.3 dt=0.02 trajectories=5 "
    "initial_weights=[0.1,1.0]",
    "adp_tracking": "experiment=adp_tracking duration=0.3 dt=0.01",
    "avoidance of a unicycle": "experiment=avoidance avoidance.vehicle=unicycle avoidance.discs=2 "
    "trajectories=3 duration=3.0 dt=0.2 adp.compile=false",
    "exponential_bound": "experiment=exponential_bound exponential_bound.states=9 "
    "exponential_bound.radii=[0.1]",
    "faults": "experiment=faults trajectories=3 duration=0.6 faults.cases=[unstable]",
    "faults from the start": "experiment=faults trajectories=2 duration=0.03 faults.cases=[short_period]",
    "feasibility": "experiment=feasibility feasibility.states=16 feasibility.radii=[0.1] "
    "feasibility.epsilons=[0.1,0.01]",
    "flat_limit": "experiment=flat_limit flat_limit.radii.per_decade=1 flat_limit.counts=[3,6,15]",
    "gradient_chase": "dt=0.05 duration=1.0 settle_time=0.5 trajectories=3 certificate=true centers.count=6 "
    "spread=0.4",
    "icl": "experiment=icl trajectories=3 dt=0.01 duration=0.5 settle_time=0.1 icl.length=[0.02,0.04]",
    "laws": "experiment=laws dt=0.1 duration=1.0 settle_time=0.5 laws.steps=[0.1,0.05] laws.work=4",
    "layouts": "experiment=layouts layouts.states=4 layouts.radii=[0.1,0.2]",
    "learn_kernel": "experiment=learn_kernel optimizer=exact centers.count=3 dt=0.1 duration=1.0 "
    "settle_time=0.5 learn_kernel.steps=4 learn_kernel.widths.count=2 learn_kernel.radii.count=3",
    "memory": "experiment=memory duration=8 dt=0.02 memory.steps=30 memory.revisits=6 memory.states=40",
    "rivals": "experiment=rivals rivals.plants=[double_integrator] rivals.methods=[LQR,discrete~LQR,IPOPT] "
    "rivals.states=1 rivals.calls=10",
    "safe_box": "experiment=safe_box duration=0.02 dt=0.01 trajectories=1 safe_box.states=4 "
    "safe_box.decay=20 safe_box.substeps=2 safe_box.followed=0.01 adp.optimum.horizon=0.5 "
    "adp.optimum.intervals=8",
}


def words(name: str) -> list[str]:
    """The settings of a case; a ~ is a space."""
    return [word.replace("~", " ") for word in CASES[name].split()]


class Ran(NamedTuple):
    """What a run returned, wrote, drew and logged."""

    metrics: dict[str, float | None]
    directory: Path
    figures: list[Figure]
    log: str
    progress: list[float]

    def rows(self, name: str) -> list[dict[str, str]]:
        """The rows of one of its tables."""
        return list(csv.DictReader((self.directory / f"{name}.csv").read_text().splitlines()))


@functools.cache
def ran(name: str, *more: str) -> Ran:
    """Run a case of `CASES` with its figures, not rendered: that takes a second."""
    folder = tempfile.TemporaryDirectory()
    _FOLDERS.append(folder)  # removed at exit
    return run(Path(folder.name), *words(name), "figures=true", *more)


def run(directory: Path, *overrides: str) -> Ran:
    """Run any settings in a directory."""
    cfg = settings(*overrides)
    told: list[float] = []
    handler, log = _Lines(), logging.getLogger("staf_torch")
    level = log.level
    log.addHandler(handler)
    log.setLevel("INFO")
    try:
        with pytest.MonkeyPatch.context() as patch, keep_figures() as kept:
            patch.setattr(Figure, "savefig", lambda figure, file, **named: file.write(b"not rendered"))
            metrics = experiment(cfg.task)(cfg, directory, Progress(told.append))
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
    assert json.loads((directory / "metrics.json").read_text(), parse_constant=pytest.fail) == metrics
    return Ran(metrics, directory, [figure for figure, _ in kept], "\n".join(handler.lines), told)


class _Lines(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


_FOLDERS: list[Any] = []
