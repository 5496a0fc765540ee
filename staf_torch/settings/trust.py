"""Trust: reading a run never runs code, and building what it describes needs `--trust` for foreign code.

Reading is JSON, plain YAML and arrays without pickles. Settings that name nothing but this package's own
classes may be built. Everything else (a class or function from elsewhere, a `task` of one's own, a resolver
such as `${oc.env:HOME}`, Hydra's search path and callbacks) can run code of whoever wrote the folder, or read
the environment: it is shown and refused until the user says `--trust`.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..results.files import visible
from . import config_directory

_TARGET = re.compile(r"_target_: *(staf_torch\.[\w.]+)")
_NOT_PARTS = (
    "staf_torch.settings.chase.load",  # imports any object by its path
    "staf_torch.systems.MujocoPlant",  # reads any file
    "staf_torch.sweeps.",  # callbacks and trackers
)
_REFERENCE = re.compile(r"\$\{[\w.]+\}")
_HARMLESS = re.compile(
    r"hydra/launcher=(batched|basic|joblib)|hydra/sweeper=(basic|optuna)|hydra\.mode=\w+|hydra\.verbose=\w+"
    r"|hydra\.launcher\.(executor|workers|batch|n_jobs)=\w+"
    r"|\+*hydra\.launcher\.submitit\.(timeout_min|mem_gb|nodes|cpus_per_task|gpus_per_node|cluster)=\w+"
    r"|\+*hydra\.launcher\.submitit\.slurm_(partition|account|qos|time|array_parallelism)=[\w-]+"
    r"|\+*hydra\.launcher\.ray\.num_cpus=\d+|hydra\.sweeper\.(n_trials|n_jobs|sampler\.seed)=\d+"
    r"|hydra\.sweeper\.direction=\w+|hydra\.sweep\.dir=.*|hydra\.run\.dir=.*"
)
"""Hydra's own overrides that can only say where and how often jobs run."""
_MAY_RUN = re.compile(r"_[a-z]+_\b|\$\{|\\|\bpath\b|\btask\b|\btracker\b|hydra|@|=.*(/|\.\.)")
"""What an override of a job contains if it names code, another file or the environment."""


def may_run_code(override: str) -> bool:
    """Return whether an override may lead to code, files or variables that are not this package's own."""
    if override.lstrip("+~").startswith(("hydra.", "hydra/")):
        return _HARMLESS.fullmatch(override) is None
    return _MAY_RUN.search(override) is not None


def foreign_settings(settings: Any) -> list[str]:
    """Return `key: value` of every setting of a run, as `.hydra/config.yaml` has them, that needs trust,
    before any interpolation is resolved."""
    return [f"{key}: {value}" for key, value in _leaves(settings) if _is_foreign(key, value)]


def refusal(place: Path, lines: Sequence[str]) -> str:
    """Return the message that shows the lines of a folder which may run foreign code."""
    shown = "".join(f"\n  {visible(line)}" for line in lines)
    return f"{place} has lines that may run code of whoever wrote it:{shown}\nIf you know them, add --trust."


@functools.cache
def constructors() -> frozenset[str]:
    """Return the dotted paths that settings may name without trust.

    They are the targets of the package's own `conf/`, and the other public classes of the same kinds.
    """
    from .. import adp, kernels, optim, systems, targets
    from ..engine import predictors

    kinds = (
        *(kernels.Kernel, optim.UpdateLaw, systems.ControlAffineSystem, predictors.Predictor),
        *(adp.ActorCriticLaw, adp.Controller, adp.Cost, adp.Extrapolation, adp.Gains, adp.ValueBasis),
        *(adp.LQR, adp.RolloutPolicy, targets.Paper, targets.Quadratic, targets.Cosine),
    )
    rooms = {module.__name__: module for module in (kernels, optim, systems, targets, adp, predictors)}
    rooms |= {"staf_torch": kernels, "staf_torch.predictors": predictors}
    found = {
        target
        for path in Path(config_directory()).rglob("*.yaml")
        for target in _TARGET.findall(path.read_text(encoding="utf-8"))
        if not target.startswith(_NOT_PARTS)
    }
    for room, module in rooms.items():
        for name, part in vars(module).items():
            if inspect.isclass(part) and issubclass(part, kinds) and not inspect.isabstract(part):
                found |= {f"{room}.{name}", f"{part.__module__}.{name}"}
    return frozenset(found)


def _is_foreign(key: str, value: Any) -> bool:
    names = key.split(".")
    if "_target_" in names and value is not None:
        return value not in constructors()
    if names[-1] == "task" and "." in str(value):
        return True
    return isinstance(value, str) and "$" in value and _REFERENCE.fullmatch(value) is None


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every plain value with its dotted key."""
    if isinstance(value, dict | list):
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, value
