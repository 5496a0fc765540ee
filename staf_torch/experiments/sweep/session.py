"""The sweep that a command runs, from its first word to its last, whatever the launcher."""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from . import records


class Session:
    """What the command knows of the sweep that Hydra runs for it."""

    def __init__(self) -> None:
        self.config: DictConfig | None = None
        self.ended = False

    @property
    def directory(self) -> Path | None:
        """Of the sweep; None where there is none, or nothing of it was written."""
        return None if self.config is None else Path(str(self.config.hydra.sweep.dir))

    def close(self) -> None:
        """After a failure: Hydra then forgets to tell its callbacks that the sweep is over."""
        directory = self.directory
        if self.config is None or directory is None or self.ended:
            return
        if not any(directory.glob(f"**/{records.RUN}")):
            _withdraw(directory)
            return
        for about in self.config.hydra.callbacks.values():
            module, _, name = str(about.get("_target_", "")).rpartition(".")
            if module.startswith("staf_torch."):
                arguments: Any = OmegaConf.to_container(about)
                arguments.pop("_target_")
                callback = getattr(importlib.import_module(module), name)(**arguments)
                callback.on_multirun_end(config=self.config, config_name=self.config.hydra.job.config_name)

    @property
    def farewell(self) -> str:
        """What to say after Ctrl-C."""
        directory = self.directory
        if directory is None or not any(directory.glob(f"*/{records.RUN}")):
            return "staf: interrupted"
        found = [records.read(path) or {} for path in directory.glob(f"*/{records.RUN}")]
        complete = sum(record.get("status") == "completed" for record in found)
        place = os.path.relpath(directory)
        return (
            f"staf: interrupted; {complete} jobs are complete. Resume with:\n  staf -m sweep.resume={place}"
        )


_session: ContextVar[Session | None] = ContextVar("session", default=None)


@contextlib.contextmanager
def session() -> Iterator[Session]:
    """The command runs inside."""
    token = _session.set(Session())
    try:
        found = _session.get()
        assert found is not None
        yield found
    finally:
        _session.reset(token)


class SweepSession(Callback):
    """Hydra's word to the session that a sweep begins and ends."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Take a directory that no other sweep has, and note there what was typed."""
        if not records.resumed(config):
            claim(config)
            typed = config.hydra.overrides
            directory = Path(str(config.hydra.sweep.dir))
            records.begin_sweep(directory, list(typed.task), list(typed.hydra))
        running = _session.get()
        if running is not None:
            running.config = config

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """The sweep is over."""
        running = _session.get()
        if running is not None:
            running.ended = True


def claim(config: DictConfig) -> None:
    """Make the sweep's directory; where another sweep has it, take the next name: `<name>-2`, ...

    A directory that was asked for on the command line is used as it is.
    """
    wanted = str(config.hydra.sweep.dir)
    if any(line.startswith("hydra.sweep.dir=") for line in config.hydra.overrides.hydra):
        Path(wanted).mkdir(parents=True, exist_ok=True)
        return
    directory, attempt = Path(wanted), 1
    while True:
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            attempt += 1
            directory = Path(f"{wanted}-{attempt}")
        else:
            break
    if attempt > 1:  # also for the jobs, whose settings are composed anew
        config.hydra.sweep.dir = str(directory)
        config.hydra.overrides.hydra.append(f"hydra.sweep.dir={records.quoted(str(directory))}")


def _withdraw(directory: Path) -> None:
    """Take back a sweep of which no job has started."""
    for name in (records.SWEEP, "multirun.yaml"):
        (directory / name).unlink(missing_ok=True)
    shutil.rmtree(directory / ".submitit", ignore_errors=True)
    with contextlib.suppress(OSError):  # not empty: it was there before
        directory.rmdir()
