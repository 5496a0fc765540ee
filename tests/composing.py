"""Settings composed as the command composes them, many at once."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from omegaconf import DictConfig, OmegaConf

from staf_torch.sweeps.hydra_compat import Composer, config_loader, find_launcher
from staf_torch.sweeps.hydra_compat.inside import HAS_WHITELIST

HYDRA: dict[str, str] = {} if HAS_WHITELIST else {"version_base": "1.3"}  # 1.4 deprecates the argument
# OmegaConf 2.4, which Hydra 1.4 takes, deprecates the new name again.
register_resolver = OmegaConf.register_resolver if HAS_WHITELIST else OmegaConf.register_new_resolver


@functools.cache
def _composer() -> Composer:
    find_launcher()  # also where the package is on the path and not installed
    return Composer(config_loader())


def settings(*overrides: str) -> DictConfig:
    """The settings of a command line without Hydra's node, a cached composition for each choice of groups."""
    return _composer()(overrides)


def compose(base: Sequence[str], jobs: Sequence[Sequence[str]]) -> list[DictConfig]:
    """The settings of ``[*base, *job]`` for every job, without Hydra's node."""
    return [settings(*base, *job) for job in jobs]
