"""Settings from overrides: Hydra's composition, made fast for jobs that differ in values alone."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from typing import Any, cast

from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import create_config_search_path
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import ConfigCompositionException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from ...settings import config_directory


def config_loader() -> ConfigLoader:
    """Return Hydra's loader: of the running program, else one of `conf/`."""
    if GlobalHydra.instance().is_initialized():
        return GlobalHydra.instance().config_loader()
    Plugins.instance()  # the sources of configurations are plugins
    return ConfigLoaderImpl(create_config_search_path(config_directory()))


def parse_override(line: str, loader: ConfigLoader | None = None) -> Override:
    """Return one override, parsed by Hydra's grammar.

    Raises:
        hydra.errors.HydraException: if the grammar has no such line.
    """
    (parsed,) = OverridesParser.create(config_loader=loader).parse_overrides([line])
    return parsed


def product(overrides: Sequence[Override]) -> list[list[str]]:
    """Return the overrides of every job of a sweep, in the order of Hydra's own sweeper."""
    (jobs,) = BasicSweeper.split_arguments(list(overrides), None)
    return [list(job) for job in jobs]


class Composer:
    """``loader.load_configuration(config_name, overrides, RunMode.RUN)``, fast where it is called often.

    Hydra takes some 40 ms a configuration, nearly all of it for the defaults list and for merging files. Here
    each choice of config groups is composed once, and the values are then applied. A test holds the result to
    Hydra's own, to the last flag.

    Args:
        loader: Hydra's, of the program.
        config_name: of the primary configuration.
        hydra_node: False for the configuration as a task sees it, which is the larger part of the time.
    """

    def __init__(
        self, loader: ConfigLoader, config_name: str | None = "config", *, hydra_node: bool = True
    ) -> None:
        self._loader, self._name, self._hydra_node = loader, config_name, hydra_node
        self._parser = OverridesParser.create()
        self._parsed: dict[str, Override] = {}
        self._chosen: dict[tuple[str, ...], bytes] = {}  # pickled: copied a fifth as fast otherwise
        self._groups: dict[str, bool] = {}
        self._apply = getattr(ConfigLoaderImpl, "_apply_overrides_to_config", None)
        self._repository = getattr(loader, "repository", None)

    def __call__(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of these overrides; the caller may change it.

        Raises:
            hydra.errors.HydraException, ValueError: what Hydra itself raises.
        """
        parsed = [self._parse(line) for line in overrides]
        chosen = tuple(line for line, one in zip(overrides, parsed, strict=True) if self._chooses(one))
        if self._apply is None or any("searchpath" in line for line in chosen):
            return self.anew(overrides)
        if chosen not in self._chosen:
            self._chosen[chosen] = pickle.dumps(self.anew(chosen))
        composed: DictConfig = pickle.loads(self._chosen[chosen])
        try:
            self._apply([one for one in parsed if not self._chooses(one)], composed)
        except OmegaConfBaseException as error:
            raise ConfigCompositionException() from error
        if self._hydra_node:
            _note_overrides(composed, parsed)
        return composed

    def anew(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration as Hydra itself composes it; arguments and errors as of a call."""
        composed = self._loader.load_configuration(self._name, list(overrides), RunMode.RUN)
        if not self._hydra_node:
            with read_write(composed), open_dict(composed):
                del composed["hydra"]
        return composed

    def _parse(self, line: str) -> Override:
        if line not in self._parsed:
            (parsed,) = self._parser.parse_overrides([line])
            if parsed.is_sweep_override():
                self.anew([line])  # refused there, in Hydra's words
            self._parsed[line] = parsed
        return self._parsed[line]

    def _chooses(self, override: Override) -> bool:
        """Return whether the override decides what is composed, beyond the value of one key."""
        key = override.key_or_group
        if override.is_hydra_override() or self._repository is None:
            return True
        if key not in self._groups:
            self._groups[key] = bool(self._repository.group_exists(key))
        return self._groups[key] and not isinstance(override.value(), dict)


def _note_overrides(composed: DictConfig, parsed: Sequence[Override]) -> None:
    """Write into Hydra's node what Hydra notes there of the overrides."""
    app = [one for one in parsed if not one.is_hydra_override()]
    node: Any = composed.hydra
    node.overrides.task = [one.input_line for one in app]
    directory_name = getattr(config_loader_impl, "get_overrides_dirname", None)  # Hydra 1.3; then a resolver
    if directory_name is not None:
        style = node.job.config.override_dirname
        node.job.override_dirname = directory_name(
            overrides=app, kv_sep=style.kv_sep, item_sep=style.item_sep, exclude_keys=style.exclude_keys
        )


class JobLoader:
    """Hydra's loader for a sweep whose launcher is ours: jobs are composed as `Composer` does it.

    Sweepers compose each job as a test and throw the result away: they get the settings without Hydra's node,
    a third of the work. Our launcher takes that node from `whole`.

    Args:
        loader: Hydra's own, asked for all else.
        master: the settings of the sweep.
    """

    def __init__(self, loader: ConfigLoader, master: DictConfig) -> None:
        self._loader = loader
        self._composers = {
            node: Composer(loader, master.hydra.job.config_name, hydra_node=node) for node in (True, False)
        }
        self._unseen = bool(master.hydra.searchpath)  # groups that a `Composer` cannot see

    @classmethod
    def install(cls, context: HydraContext, master: DictConfig) -> None:
        """Let a sweep compose by a loader of this class."""
        if not isinstance(context.config_loader, cls):
            context.config_loader = cast(ConfigLoader, cls(context.config_loader, master))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """Return the settings of a job as its task sees them, without Hydra's node."""
        return self._composed(master_config, sweep_overrides, hydra_node=False)

    def whole(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of a job with Hydra's node."""
        return self._composed(master_config, sweep_overrides, hydra_node=True)

    def _composed(self, master: DictConfig, overrides: Sequence[str], *, hydra_node: bool) -> DictConfig:
        composer = self._composers[hydra_node]
        lines = [*master.hydra.overrides.hydra, *overrides]
        composed = composer.anew(lines) if self._unseen else composer(lines)
        # Times and the like are those at which the sweep began.
        OmegaConf.copy_cache(from_config=master, to_config=composed)
        return composed
