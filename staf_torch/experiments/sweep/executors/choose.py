"""An executor by its name in `hydra.launcher.executor`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...._checks import choice
from .base import Executor

EXECUTORS = ("inline", "process", "submitit", "ray")
_EXTRAS = {"submitit": "slurm", "ray": "ray"}


def executor(name: object, workers: int | None, arguments: Mapping[str, Any], directory: Path) -> Executor:
    """The executor of that name.

    Args:
        name: one of `EXECUTORS`.
        workers: tensor batches at once; None for as many as suit the executor.
        arguments: of the libraries behind them, by the name of the executor.
        directory: of the sweep.

    Raises:
        ValueError: for another name, or where the library behind it is not installed.
    """
    choice("hydra.launcher", "executor", name, EXECUTORS)
    # Imported here: each needs a library that the others do without.
    try:
        if name == "submitit":
            from .cluster import Submitit

            return Submitit(workers, directory / ".submitit", arguments["submitit"])
        if name == "ray":
            from .ray import Ray

            return Ray(workers, arguments["ray"])
    except ImportError as error:
        extra = _EXTRAS[str(name)]
        raise ValueError(
            f"`hydra.launcher.executor={name}` needs the extra: pip install 'staf_torch[{extra}]' ({error})."
        ) from error
    if name == "process":
        from .process import Process

        return Process(workers)
    from .inline import Inline

    return Inline(workers)
