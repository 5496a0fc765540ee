"""Settings from overrides: Hydra's composition, made fast for jobs that differ in values alone."""

from __future__ import annotations

import contextlib
import functools
import pickle
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import omegaconf.base
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import ConfigCompositionException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException


def parse_override(line: str, loader: ConfigLoader | None = None) -> Override:
    """Return one override, parsed by Hydra's grammar.

    Raises:
        hydra.errors.HydraException: if the grammar has no such line.
        ValueError: if its brackets are nested too deep.
    """
    try:
        (parsed,) = OverridesParser.create(config_loader=loader).parse_overrides([line])
    except RecursionError as error:
        raise ValueError(f"{line[:40]}... is nested too deep.") from error
    return parsed


@contextlib.contextmanager
def interpolations_parsed_once() -> Iterator[None]:
    """Keep the parse trees of interpolations, which OmegaConf makes anew for every value that it looks up.

    Such as `${hydra.job.num}`: a millisecond each time, in a sweep a few times a job.
    """
    module: Any = omegaconf.base
    parse = getattr(module, "parse", None)
    if parse is None:
        yield
        return
    module.parse = functools.lru_cache(1000)(parse)
    try:
        yield
    finally:
        module.parse = parse


def as_typed(lines: ListConfig) -> list[str]:
    """Return overrides that Hydra has noted as they were typed: an interpolation in them is not looked up."""
    return cast(list[str], OmegaConf.to_container(lines))


MOST_LINES = 10_000  # that are kept: a million seeds are a million lines


class Composer:
    """``loader.load_configuration(config_name, overrides, RunMode.RUN)``, fast where it is called often.

    Hydra takes some 40 ms a configuration, nearly all of it for the defaults list and for merging files. Here
    each choice of config groups is composed once, and the values are then applied. A test holds the result to
    Hydra's own, to the last flag.

    Args:
        loader: Hydra's, of the program.
        config_name: of the primary configuration.
        hydra_node: False for the configuration as a task sees it, which is the larger part of the time.
        whole: a composer of the same configurations with Hydra's node, whose choices are not composed again.
        always: overrides that all calls share; their values are applied once.
    """

    def __init__(
        self,
        loader: ConfigLoader,
        config_name: str | None = "config",
        *,
        hydra_node: bool = True,
        always: Collection[str] = (),
        whole: Composer | None = None,
    ) -> None:
        self._loader, self._name, self._hydra_node, self._whole = loader, config_name, hydra_node, whole
        self._parser = OverridesParser.create()
        self._parsed: dict[str, Override] = {}
        self._always = frozenset(always)
        self._chosen: dict[tuple[Any, ...], bytes] = {}  # pickled: copied a fifth as fast otherwise
        self._groups: dict[str, bool] = {}
        self._reused: _Reused | None = None
        self._apply = getattr(ConfigLoaderImpl, "_apply_overrides_to_config", None)
        self._repository = getattr(loader, "repository", None)

    def __call__(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of these overrides; the caller may change it.

        Raises:
            hydra.errors.HydraException, ValueError: what Hydra itself raises.
        """
        parsed = [self.parsed(line) for line in overrides]
        chosen = self.choices(overrides)
        if chosen is None:
            return self.anew(overrides)
        values = [one for one in parsed if not self.chooses(one)]
        first: list[Override] = []
        if self._always and independent({one.key_or_group: one for one in values}):
            first = [one for one in values if one.input_line in self._always]
        key = (chosen, *(one.input_line for one in first))
        if key not in self._chosen:
            made = self.anew(chosen) if self._whole is None else self._without_node(self._whole(chosen))
            self._set(made, first, parsed)
            self._chosen[key] = pickle.dumps(made)
        composed: DictConfig = pickle.loads(self._chosen[key])
        self._set(composed, [one for one in values if one not in first], parsed)
        return composed

    def reused(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of these overrides in an object that the next call of this may change.

        Where the values of the same keys alone are others than in the call before, those are set: a third of
        the time of a new object. Errors as of a call.
        """
        parsed, chosen = [self.parsed(line) for line in overrides], self.choices(overrides)
        values = {one.key_or_group: one for one in parsed if not self.chooses(one)}
        before, self._reused = self._reused, None  # an error leaves some of the values
        if chosen is None or not independent(values):
            return self(overrides)
        if before is not None and before.chosen == chosen and list(before.values) == list(values):
            composed = before.composed
            further = [one for key, one in values.items() if one is not before.values[key]]
            self._set(composed, further, parsed)
        else:
            composed = self(overrides)
        self._reused = _Reused(chosen, values, composed)
        return composed

    def choices(self, overrides: Sequence[str]) -> tuple[str, ...] | None:
        """Return the overrides that decide what is composed; None where Hydra must compose it itself."""
        chosen = tuple(line for line in overrides if self.chooses(self.parsed(line)))
        return None if self._apply is None or any("searchpath" in line for line in chosen) else chosen

    def _set(self, composed: DictConfig, values: Sequence[Override], parsed: Sequence[Override]) -> None:
        """Set values in a configuration, and note in Hydra's node all overrides that led to it."""
        assert self._apply is not None
        try:
            self._apply(values, composed)
        except OmegaConfBaseException as error:
            raise ConfigCompositionException() from error
        if self._hydra_node:
            with read_write(composed.hydra):  # a job may have run with it
                _note_overrides(composed, parsed)

    def anew(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration as Hydra itself composes it; arguments and errors as of a call."""
        return self._without_node(self._loader.load_configuration(self._name, list(overrides), RunMode.RUN))

    def _without_node(self, composed: DictConfig) -> DictConfig:
        """Remove Hydra's node, unless it is wanted."""
        if not self._hydra_node:
            with read_write(composed), open_dict(composed):
                del composed["hydra"]
        return composed

    def parsed(self, line: str) -> Override:
        """Return an override, parsed and looked at once. Errors as of a call."""
        if line not in self._parsed:
            if len(self._parsed) >= MOST_LINES:
                self._parsed.clear()
            (parsed,) = self._parser.parse_overrides([line])
            if parsed.is_sweep_override():
                self.anew([line])  # refused there, in Hydra's words
            self._parsed[line] = parsed
        return self._parsed[line]

    def chooses(self, override: Override) -> bool:
        """Return whether the override decides what is composed, beyond the value of one key."""
        key = override.key_or_group
        if override.is_hydra_override() or self._repository is None:
            return True
        if key not in self._groups:
            self._groups[key] = bool(self._repository.group_exists(key))
        return self._groups[key] and not isinstance(override.value(), dict)


class _Reused(NamedTuple):
    """The configuration that `Composer.reused` returned last."""

    chosen: tuple[str, ...]
    values: dict[str, Override]  # by their keys
    composed: DictConfig


def independent(values: Mapping[str, Override]) -> bool:
    """Return whether each override sets a number, a text or a list at a key of its own, with none above it.

    Then one of them may be set anew, and what it was leaves nothing.
    """
    for key, one in values.items():
        above = {key[:i] for i, letter in enumerate(key) if letter == "."}
        value = one.value()
        if one.type != OverrideType.CHANGE or not above.isdisjoint(values):
            return False
        if isinstance(value, dict) or "${" in str(value):
            return False
    return True


def _note_overrides(composed: DictConfig, parsed: Sequence[Override]) -> None:
    """Write into Hydra's node what Hydra notes there of the overrides."""
    app = [one for one in parsed if not one.is_hydra_override()]
    node: Any = composed.hydra
    lines: list[Any] = [one.input_line for one in app]
    noted = as_typed(node.overrides.task)
    if len(noted) == len(lines):
        for index in (i for i, line in enumerate(lines) if line != noted[i]):
            node.overrides.task[index] = lines[index]
    else:
        node.overrides.task = lines
    directory_name = getattr(config_loader_impl, "get_overrides_dirname", None)  # Hydra 1.3; then a resolver
    if directory_name is not None:
        style = node.job.config.override_dirname
        node.job.override_dirname = directory_name(
            overrides=app, kv_sep=style.kv_sep, item_sep=style.item_sep, exclude_keys=style.exclude_keys
        )


class JobLoader:
    """Hydra's loader for a sweep whose launcher is ours: jobs are composed as `Composer` does it.

    Sweepers compose each job as a test and throw the result away: they get the settings without Hydra's node,
    in an object that is used again. Our launcher takes that node from `whole`.

    Args:
        loader: Hydra's own, asked for all else.
        master: the settings of the sweep.
    """

    def __init__(self, loader: ConfigLoader, master: DictConfig) -> None:
        self._loader = loader
        name = master.hydra.job.config_name
        self._whole = Composer(loader, name)
        self._settings = Composer(loader, name, hydra_node=False, whole=self._whole)
        self.hydra_yaml: dict[tuple[str, ...], dict[str, str]] = {}  # parts of `hydra.yaml`, by `choices`
        self._unseen = bool(master.hydra.searchpath)  # groups that a `Composer` cannot see

    @classmethod
    def install(cls, context: HydraContext, master: DictConfig) -> None:
        """Let a sweep compose by a loader of this class."""
        if not isinstance(context.config_loader, cls):
            context.config_loader = cast(ConfigLoader, cls(context.config_loader, master))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """Return the settings of a job without Hydra's node, in an object that the next call may change."""
        return self._composed(self._settings, master_config, sweep_overrides, reuse=True)

    def settings(self, master: DictConfig, overrides: Sequence[str]) -> DictConfig:
        """Return the settings of a job as its task sees them, without Hydra's node."""
        return self._composed(self._settings, master, overrides, reuse=False)

    def whole(self, master: DictConfig, overrides: Sequence[str], *, reuse: bool) -> DictConfig:
        """Return the configuration of a job with Hydra's node.

        Args:
            master: settings of the sweep.
            overrides: of the job.
            reuse: whether the next call may change the object.
        """
        return self._composed(self._whole, master, overrides, reuse=reuse)

    def choices(self, master: DictConfig, overrides: Sequence[str]) -> tuple[str, ...] | None:
        """Return the lines that decide what Hydra's node holds, beside what is noted of the job itself."""
        return (
            None
            if self._unseen
            else self._whole.choices([*as_typed(master.hydra.overrides.hydra), *overrides])
        )

    def _composed(
        self, composer: Composer, master: DictConfig, overrides: Sequence[str], *, reuse: bool
    ) -> DictConfig:
        lines = [*as_typed(master.hydra.overrides.hydra), *overrides]
        if self._unseen:
            composed = composer.anew(lines)
        else:
            composed = composer.reused(lines) if reuse else composer(lines)
        # Times and the like are those at which the sweep began.
        OmegaConf.copy_cache(from_config=master, to_config=composed)
        return composed
