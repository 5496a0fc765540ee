"""`staf` as a Hydra application, and what its command line says before Hydra reads it."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import hydra
from omegaconf import DictConfig, OmegaConf

from ...settings import config_directory
from .inside import HAS_WHITELIST, TRUSTED, arguments

_PACKAGE = Path(__file__).resolve().parents[2]
_NAMES = re.compile(r"(?:_target_|\bpath)['\"]?\s*[=:]\s*['\"]?([A-Za-z_]\w*\.[\w.]*\w)")


def program(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
    """Return ``task`` as a Hydra application over `conf/`, which reads `sys.argv`."""
    options = {"execution_whitelist": TRUSTED} if HAS_WHITELIST else {"version_base": "1.3"}
    decorate: Any = hydra.main
    decorated: Callable[[], None] = decorate(config_path=config_directory(), config_name="config", **options)(
        task
    )
    return decorated


def find_launcher() -> None:
    """Make Hydra find `hydra/launcher=batched` in a bare checkout, in this process and in those it starts.

    The package's own `hydra_plugins` goes before any other: an editable install has a copy, which may be of
    another day. A wheel has one at the top level, for programs that do not import this module.
    """
    folder = _PACKAGE / "plugins"
    if str(folder) in sys.path or not folder.is_dir():
        return
    try:
        installed = importlib.util.find_spec("hydra_plugins.staf_batched") is not None
    except ModuleNotFoundError:  # no package `hydra_plugins` at all
        installed = False
    sys.path.insert(0, str(folder))
    if not installed:  # workers of other launchers unpickle names of `hydra_plugins` before they import us
        path = [os.environ.get("PYTHONPATH", ""), str(folder), str(_PACKAGE.parent)]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, path))


def overrides_in(argv: Sequence[str]) -> list[str]:
    """Return the overrides among the words of a command line."""
    return list(arguments(argv).overrides)


def named_packages(argv: Sequence[str]) -> list[str]:
    """Return the packages of the objects that a command line names: who types a name trusts what is there.

    Objects are named by keys `_target_` and `path`, in overrides and in the files below `--config-dir`.
    """
    if not HAS_WHITELIST:
        return []
    named = re.findall(_NAMES, "\n".join(overrides_in(argv)))
    for folder in _config_folders(argv):
        for file in Path(folder).rglob("*.yaml"):
            named += re.findall(_NAMES, file.read_text(encoding="utf-8", errors="replace"))
    return sorted({name.partition(".")[0] for name in named})


def with_mode(argv: Sequence[str]) -> list[str]:
    """Return the arguments, and the `hydra.mode` that the file of `experiment=...` sets, for Hydra 1.4.

    That version takes the mode from the command line or from the primary file alone.
    """
    given = overrides_in(argv)
    chosen = [line.partition("=")[2] for line in given if line.startswith("experiment=")]
    stated = any(line.startswith("hydra.mode=") for line in given) or {"-m", "--multirun"} & set(argv)
    if not HAS_WHITELIST or stated or not chosen:
        return list(argv)
    for folder in (*_config_folders(argv), config_directory()):
        file = Path(folder, "experiment", f"{chosen[-1]}.yaml")
        if file.is_file():
            mode = OmegaConf.select(OmegaConf.load(file), "hydra.mode")
            behind = argv.index(f"experiment={chosen[-1]}") + 1  # overrides may not be parted by an option
            added = [] if mode is None else [f"hydra.mode={mode}"]
            return [*argv[:behind], *added, *argv[behind:]]
    return list(argv)


def _config_folders(argv: Sequence[str]) -> list[str]:
    """Return the directory of `--config-dir`, as a list of one or none."""
    return list(filter(None, [arguments(argv).config_dir]))


@contextlib.contextmanager
def full_errors() -> Iterator[bool]:
    """Let exceptions leave Hydra as they are; yield whether the user asked for traces (HYDRA_FULL_ERROR)."""
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield before not in (None, "", "0")
    finally:
        if before is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
        else:
            os.environ["HYDRA_FULL_ERROR"] = before


class BrokenSweep(NamedTuple):
    """A sweep that an exception ended."""

    config: DictConfig
    callbacks: Any

    def end(self) -> None:
        """Tell the callbacks that the sweep is over, where Hydra does not: version 1.3 forgets it."""
        if not HAS_WHITELIST:
            self.callbacks.on_multirun_end(config=self.config, config_name=self.config.hydra.job.config_name)


def breaking_off() -> bool:
    """Return whether an exception ends the sweep that calls back now: version 1.4 calls back then too."""
    broken = {id(frame) for frame, _ in traceback.walk_tb(sys.exc_info()[2])}
    frame: FrameType | None = sys._getframe()
    while frame is not None and frame.f_code.co_name != "multirun":
        frame = frame.f_back
    return frame is not None and id(frame) in broken


def broken_sweep(error: BaseException) -> BrokenSweep | None:
    """Return the sweep that ``error`` ended, None where no sweep had begun.

    Hydra keeps both in local variables of `Hydra.multirun`, which the traceback leads to.
    """
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_name == "multirun" and "callbacks" in frame.f_locals:
            return BrokenSweep(frame.f_locals["cfg"], frame.f_locals["callbacks"])
    return None
