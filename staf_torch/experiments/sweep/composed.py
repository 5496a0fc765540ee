"""Every job of a sweep composed once: Hydra's sweepers compose each as a test, and launchers again."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from hydra.core.config_loader import ConfigLoader
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf

from ..composition import Composer


class ComposeOnce:
    """Hydra's loader of configurations, whose `load_sweep_config` is quick and keeps what it made.

    Args:
        loader: Hydra's own, asked for all else.
        master: the configuration of the sweep.
    """

    def __init__(self, loader: ConfigLoader, master: DictConfig) -> None:
        self._loader = loader
        self._compose = Composer(loader, master.hydra.job.config_name)
        self._kept: dict[tuple[str, ...], DictConfig] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """The configuration of a job."""
        key = tuple(sweep_overrides)
        if key not in self._kept:
            composed = self._compose([*master_config.hydra.overrides.hydra, *key])
            # Times and the like are those at which the sweep began.
            OmegaConf.copy_cache(from_config=master_config, to_config=composed)
            self._kept[key] = composed
        return self._kept[key]

    def take(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """The same, for the caller alone, who may change it."""
        composed = self.load_sweep_config(master_config, sweep_overrides)
        del self._kept[tuple(sweep_overrides)]
        return composed


def compose_once(context: HydraContext, master: DictConfig) -> None:
    """Put it in the context that the sweeper and its launcher share."""
    if not isinstance(context.config_loader, ComposeOnce):
        context.config_loader = cast(ConfigLoader, ComposeOnce(context.config_loader, master))
