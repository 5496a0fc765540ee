"""Many configurations at once: Hydra composes each choice of config groups once, the values are then applied.

Hydra takes some 40 ms a configuration, nearly all of it for the defaults list and for merging files, which
the values of a sweep do not change. The result is the same to the last flag; a test holds it to that.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import ConfigCompositionException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException


def config_directory() -> str:
    """`conf/`: inside the package when it is installed from a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "conf"
    return str(inside if inside.is_dir() else package.parent / "conf")


def config_loader() -> ConfigLoader:
    """Hydra's loader: of the running program, else one of `conf/`."""
    if GlobalHydra.instance().is_initialized():
        return GlobalHydra.instance().config_loader()
    Plugins.instance()  # the sources of configurations are plugins
    return ConfigLoaderImpl(create_config_search_path(config_directory()))


def compose(
    base: Sequence[str],
    jobs: Iterable[Sequence[str]],
    *,
    loader: ConfigLoader | None = None,
    hydra_node: bool = True,
) -> list[DictConfig]:
    """The configurations of ``[*base, *job]`` for every job.

    Args:
        base: overrides of all jobs, in Hydra's grammar, without sweeps.
        jobs: overrides of each.
        loader: `config_loader()` by default.
        hydra_node: as in `Composer`.

    Raises:
        hydra.errors.HydraException, ValueError: what Hydra itself raises at the first bad job.
    """
    composer = Composer(config_loader() if loader is None else loader, hydra_node=hydra_node)
    return [composer((*base, *job)) for job in jobs]


class Composer:
    """``loader.load_configuration(config_name, overrides, RunMode.RUN)``, fast where it is called often.

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
        """The configuration of these overrides; the caller may change it.

        Raises:
            hydra.errors.HydraException, ValueError: what Hydra itself raises.
        """
        parsed = [self._parse(line) for line in overrides]
        chosen = tuple(line for line, one in zip(overrides, parsed, strict=True) if self._chooses(one))
        if self._apply is None or any("searchpath" in line for line in chosen):
            return self._load(overrides)
        if chosen not in self._chosen:
            self._chosen[chosen] = pickle.dumps(self._load(chosen))
        composed: DictConfig = pickle.loads(self._chosen[chosen])
        try:
            self._apply([one for one in parsed if not self._chooses(one)], composed)
        except OmegaConfBaseException as error:
            raise ConfigCompositionException() from error
        if self._hydra_node:
            _record(composed, parsed)
        return composed

    def _load(self, overrides: Sequence[str]) -> DictConfig:
        composed = self._loader.load_configuration(self._name, list(overrides), RunMode.RUN)
        if not self._hydra_node:
            with read_write(composed), open_dict(composed):
                del composed["hydra"]
        return composed

    def _parse(self, line: str) -> Override:
        if line not in self._parsed:
            (parsed,) = self._parser.parse_overrides([line])
            if parsed.is_sweep_override():
                self._load([line])  # refused there, in Hydra's words
            self._parsed[line] = parsed
        return self._parsed[line]

    def _chooses(self, override: Override) -> bool:
        """Whether it has a say in what is composed, beyond the value of one key."""
        key = override.key_or_group
        if override.is_hydra_override() or self._repository is None:
            return True
        if key not in self._groups:
            self._groups[key] = bool(self._repository.group_exists(key))
        return self._groups[key] and not isinstance(override.value(), dict)


def _record(composed: DictConfig, parsed: Sequence[Override]) -> None:
    """What Hydra notes of the overrides in its own node."""
    app = [one for one in parsed if not one.is_hydra_override()]
    node: Any = composed.hydra
    node.overrides.task = [one.input_line for one in app]
    directory_name = getattr(config_loader_impl, "get_overrides_dirname", None)  # Hydra 1.3; then a resolver
    if directory_name is not None:
        style = node.job.config.override_dirname
        node.job.override_dirname = directory_name(
            overrides=app, kv_sep=style.kv_sep, item_sep=style.item_sep, exclude_keys=style.exclude_keys
        )


def settings(cfg: DictConfig) -> dict[str, Any]:
    """All settings but Hydra's, resolved: flat dotted key -> scalar or list."""
    plain = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(plain, dict)
    plain.pop("hydra", None)
    return _flat("", plain)


def _flat(prefix: str, node: dict[Any, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in node.items():
        name = f"{prefix}{key}"
        found |= _flat(f"{name}.", value) if isinstance(value, dict) and value else {name: value}
    return found
