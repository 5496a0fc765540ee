"""Where the tensor batches of a sweep are computed: in this process, in others, on a cluster, by Ray."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...numerics.checks import choice
from .base import Executor as Executor
from .local import Inline as Inline
from .local import Process
from .planning import compute as compute
from .ray_tasks import Ray
from .remote import pack as pack
from .remote import solve_elsewhere as solve_elsewhere
from .remote import unpack as unpack
from .slurm import Submitit

EXECUTORS = ("inline", "process", "submitit", "ray")
_EXTRAS = {"submitit": "slurm", "ray": "ray"}


def executor(name: object, workers: int | None, arguments: Mapping[str, Any], directory: Path) -> Executor:
    """Return the executor of that name in `hydra.launcher.executor`.

    Args:
        name: one of `EXECUTORS`.
        workers: tensor batches at once; None for as many as suit the executor.
        arguments: of the libraries behind them, by the name of the executor.
        directory: of the sweep.

    Raises:
        ValueError: for another name, or where the library behind it is not installed.
    """
    choice("hydra.launcher", "executor", name, EXECUTORS)
    try:
        if name == "submitit":
            return Submitit(workers, directory, arguments["submitit"])
        if name == "ray":
            return Ray(workers, arguments["ray"])
    except ImportError as error:
        extra = _EXTRAS[str(name)]
        raise ValueError(
            f"`hydra.launcher.executor={name}` needs the extra: pip install 'staf_torch[{extra}]' ({error})."
        ) from error
    return Process(workers) if name == "process" else Inline(workers)
