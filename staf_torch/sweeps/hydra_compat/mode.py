"""Whether settings ask for one run or for a sweep (`hydra.mode`), read from one file, not composed."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.hydra import Hydra
from hydra.types import RunMode
from omegaconf import OmegaConf

from ...settings import config_directory
from .program import HAS_WHITELIST

_OURS = {"hydra", "main", "schema"}
"""Providers of settings in a search path that holds nothing but Hydra's own and `conf/`."""
_DECIDES = re.compile(r"[+~]*hydra(\.mode|\.searchpath)?([=@]|$)|[^=]*@")
"""Overrides that may set the mode themselves, or put a file where it is looked for."""
_EXPERIMENT = re.compile(r"\+{0,2}experiment=(\w+)")


@contextlib.contextmanager
def mode_read_from_its_file() -> Iterator[None]:
    """Let Hydra 1.3 read `hydra.mode` where it is written: a tenth of a second less a command.

    That version composes all settings once to look at this key, and once more to run. In `conf/` files of
    `experiment` alone set the key (a test says so); where the user's settings may do so, Hydra composes.
    """
    if HAS_WHITELIST:  # Hydra 1.4 reads it from there itself
        yield
        return
    application: Any = Hydra
    composed: Callable[[Hydra, str | None, list[str]], Any] = application.get_mode

    def get_mode(self: Hydra, config_name: str | None, overrides: list[str]) -> Any:
        providers = {place.provider for place in self.config_loader.get_search_path().get_path()}
        if config_name != "config" or not providers <= _OURS:
            return composed(self, config_name, overrides)
        known, mode = _written(overrides)
        return mode if known else composed(self, config_name, overrides)

    application.get_mode = get_mode
    try:
        yield
    finally:
        application.get_mode = composed


def _written(overrides: Sequence[str]) -> tuple[bool, RunMode | None]:
    """Return whether the file of the experiment alone decides the mode, and what it says."""
    if any(_DECIDES.match(line) for line in overrides):
        return False, None
    chosen = [line for line in overrides if re.match(r"[+~]*experiment\b", line)]
    if not chosen:
        return True, None
    name = _EXPERIMENT.fullmatch(chosen[-1])
    file = Path(config_directory(), "experiment", f"{name[1]}.yaml") if name else None
    if file is None or not file.is_file():
        return False, None
    mode = OmegaConf.select(OmegaConf.load(file), "hydra.mode")
    return True, None if mode is None else RunMode[mode]
