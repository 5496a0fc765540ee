"""Settings from overrides: Hydra composes each choice of config groups once, and values are set in copies.

Hydra takes 40 to 110 ms a configuration, nearly all of it for the defaults list and for merging files, and
runs and jobs differ in values mostly. A test holds the results to Hydra's own, to the last flag.
"""

from __future__ import annotations

import math
import os
import pickle
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType, RangeSweep
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from ...results import run_record as records
from ...results.files import plain as as_json
from ...settings.plain import ManySettings, PlainSettings

_MOST_LINES = 10_000  # that are kept: a million seeds are a million lines
_MOST_COMPOSED = 1000  # configurations that are kept
_READ_BY_HYDRA = ("hydra.searchpath", "hydra.job.", "hydra.overrides", "hydra.runtime")  # while it composes


def directory_of(config: DictConfig) -> Path:
    """Return the run directory of a job whose configuration has Hydra's node."""
    return Path(str(config.hydra.sweep.dir), str(config.hydra.sweep.subdir))


def take_directory(taken: dict[str, str], directory: Path, job: str) -> None:
    """Note that this is the directory of a job.

    Raises:
        ValueError: if it is another job's.
    """
    other = taken.setdefault(os.path.abspath(directory), job)
    if other != job:
        raise ValueError(
            f"`hydra.sweep.subdir` gives two jobs one directory, {directory}: {other} and {job}. "
            "Name there all that is swept, or ${hydra.job.num}."
        )


def parse_override(line: str) -> Override:
    """Return one override, parsed by Hydra's grammar.

    Raises:
        hydra.errors.HydraException: if the grammar has no such line.
        ValueError: if its brackets are nested too deep.
    """
    try:
        (parsed,) = OverridesParser.create().parse_overrides([line])
    except RecursionError as error:
        raise ValueError(f"{line[:40]}... is nested too deep.") from error
    return parsed


def as_typed(lines: ListConfig) -> list[str]:
    """Return overrides that Hydra has noted as they were typed: an interpolation in them is not looked up."""
    return cast(list[str], OmegaConf.to_container(lines))


class _Line(NamedTuple):
    """A parsed override."""

    override: Override
    key: str
    value: Any
    sets: bool  # a number, a text or a list at a key that is there, and nothing else
    of_hydra: bool  # whether it concerns Hydra's own node
    refers: bool  # whether the value is known with the other settings alone
    path: str | None  # the key with a dot behind every part; None: what is composed depends on it


class _Composed(NamedTuple):
    """The configuration of one choice of groups, pickled: copied a fifth as fast otherwise."""

    whole: bytes
    settings: bytes  # without Hydra's node


class Composer:
    """The configurations of a program by their overrides, as its loader composes them; else, that loader.

    ``searched`` are folders that the primary configuration itself adds to Hydra's search path.
    """

    def __init__(
        self, loader: ConfigLoader, config_name: str | None = "config", searched: Sequence[str] = ()
    ) -> None:
        self._loader, self._name = loader, config_name
        folders = ",".join(map(records.quoted, searched))
        self._searched = (f"hydra.searchpath=[{folders}]",) if folders else ()
        self._lines: dict[str, _Line] = {}
        self._groups: dict[tuple[str, ...], bool] = {}
        self._composed: dict[tuple[str, ...], _Composed] = {}
        self._nodes: dict[tuple[str, ...], bytes] = {}  # the same with Hydra's own values
        self._bases: dict[tuple[tuple[str, ...], ...], _Base | None] = {}
        self._taken: dict[str, str] = {}  # directories of the latest sweep's jobs, by other launchers
        self.latest_sweep: DictConfig | None = None
        """What `load_configuration` returned last for a sweep."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_configuration(
        self,
        config_name: str | None,
        overrides: Sequence[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Return what the method of Hydra's loader returns; what Hydra refuses, it refuses itself."""
        found = self._alike(config_name, overrides, run_mode)
        if found is None:
            found = self._loader.load_configuration(
                config_name, list(overrides), run_mode, from_shell, validate_sweep_overrides
            )
        if run_mode == RunMode.MULTIRUN:
            self.latest_sweep, self._taken = found, {}
        return found

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of a job, as the method of Hydra's loader does for other launchers.

        Raises:
            ValueError: if another job of the sweep has its directory.
        """
        node = master_config.hydra
        lines = [*as_typed(node.overrides.hydra), *sweep_overrides]
        config = self.load_configuration(node.job.config_name, lines, RunMode.RUN)
        OmegaConf.copy_cache(from_config=master_config, to_config=config)
        try:
            directory = directory_of(config)
        except OmegaConfBaseException:  # it has the number of the job, which Hydra sets later
            return config
        take_directory(self._taken, directory, " ".join(sweep_overrides))
        return config

    def _alike(self, name: str | None, overrides: Sequence[str], mode: RunMode) -> DictConfig | None:
        """Return the configuration of a run or a sweep from one with the same groups; None: it has none."""
        try:
            lines = self._read(overrides)
            single = [line for line in lines if not line.override.is_sweep_override()]
            swept_by_hydra = any(line.of_hydra and line not in single for line in lines)
            refused = swept_by_hydra or (mode == RunMode.RUN and len(single) < len(lines))
            return None if refused or name != self._name else self._noted(lines, single)
        except (HydraException, OmegaConfBaseException):
            return None

    def __call__(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of these overrides as a task sees it, without Hydra's node.

        The caller may change it.

        Raises:
            hydra.errors.HydraException, ValueError: what Hydra itself raises.
        """
        return self._with_values(self._read(overrides), hydra_node=False)

    def whole(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of these overrides with Hydra's node; all else as of a call."""
        lines = self._read(overrides)
        return self._noted(lines, lines)

    def kind(self, overrides: Sequence[str]) -> tuple[Hashable, list[Override]]:
        """Return what Hydra's node depends on but the texts of the others, and those overrides, parsed.

        It is equal for jobs whose overrides differ in values of settings alone.
        """
        lines = self._read(overrides)
        kept = tuple(str(line.override.input_line) for line in lines if not line.sets or line.of_hydra)
        own = [line for line in lines if line.sets and not line.of_hydra]
        others = [line for line in lines if not line.sets]
        alone = not any(_overlap(one, other) for one in own for other in others)
        return (kept if alone else tuple(overrides)), [line.override for line in lines if not line.of_hydra]

    def _noted(self, lines: Sequence[_Line], applied: Sequence[_Line]) -> DictConfig:
        """Compose some of the overrides, with Hydra's node, and note all of them there."""
        config = self._with_values(applied, hydra_node=True)
        with read_write(config.hydra):
            config.hydra.runtime.cwd = os.getcwd()
            _note_overrides(config.hydra, [line.override for line in lines if not line.of_hydra])
        return config

    def many(
        self, jobs: Sequence[Sequence[str]], prepared: Callable[[DictConfig], DictConfig] = lambda cfg: cfg
    ) -> tuple[ManySettings, list[Mapping[str, Any]]]:
        """Return the settings of many jobs, and the same by dotted keys; errors are those of a call.

        They are plain dictionaries where no setting refers to another one and jobs set the same keys, each a
        number, a text or a list at a place of its own: the first of such jobs alone is composed. The others
        are ``prepared`` before anything in them is resolved.
        """
        found: list[DictConfig | PlainSettings] = []
        flat: list[Mapping[str, Any]] = []
        for overrides in jobs:
            lines = [line for line in self._read(overrides) if not (line.sets and line.of_hydra)]
            values = {line.key: line for line in lines if line.sets}
            key = _others(lines), tuple(values)
            if key not in self._bases:
                self._bases[key] = self._base(overrides, lines, values)
            base = self._bases[key]
            if base is None or any(line.refers for line in values.values()):
                config = prepared(self(overrides))
                found.append(config)
                flat.append(records.flat(config))
            else:
                tree, by_key = base.with_values(values)
                found.append(tree)
                flat.append(by_key)
        return ManySettings(found), flat

    def _read(self, overrides: Sequence[str]) -> list[_Line]:
        searched = tuple(line for line in overrides if line.lstrip("+~").startswith("hydra.searchpath"))
        return [self._lines.get(line) or self._line(line, searched) for line in overrides]

    def _line(self, text: str, searched: tuple[str, ...]) -> _Line:
        override = parse_override(text)
        key, value = override.key_or_group, override.value()
        groups = (key, *searched)
        if groups not in self._groups:
            where = [*(searched or self._searched)]
            self._groups[groups] = bool(self._loader.get_group_options(key, None, overrides=where))
        sweeps, is_value = override.is_sweep_override(), isinstance(value, dict) or not self._groups[groups]
        chooses = sweeps or override.package is not None or not is_value or key.startswith(_READ_BY_HYDRA)
        path = None if chooses else re.sub(r"[\[\].]+", ".", key).rstrip(".") + "."
        sets = not chooses and override.type == OverrideType.CHANGE and not isinstance(value, dict)
        line = _Line(override, key, value, sets, override.is_hydra_override(), _refers(value), path)
        if not searched:
            if len(self._lines) >= _MOST_LINES:
                self._lines.clear()
            self._lines[text] = line
        return line

    def _with_values(self, lines: Sequence[_Line], *, hydra_node: bool) -> DictConfig:
        """Set values in a copy of what Hydra composes of the other overrides, or let it compose all."""
        values = [line for line in lines if line.sets]
        others = [line for line in lines if not line.sets]
        overrides = [str(line.override.input_line) for line in lines]
        if any(_overlap(one, other) for one in others for other in values):
            return self._copy(overrides, hydra_node)  # their order counts
        try:
            config = self._with_node(lines) if hydra_node else self._copy(_others(lines), False)
            for line in values:
                if not line.of_hydra:
                    OmegaConf.update(config, line.key, line.value, merge=True)
        except OmegaConfBaseException:
            return self._copy(overrides, hydra_node)  # which raises in Hydra's words
        return config

    def _with_node(self, lines: Sequence[_Line]) -> DictConfig:
        """Return a copy whose node has Hydra's own values of these overrides, and has noted them."""
        own = [line for line in lines if line.of_hydra]
        texts = [str(line.override.input_line) for line in own]
        key = (*_others(lines), "", *texts)
        if key not in self._nodes:
            config = self._copy(_others(lines), True)
            for line in own:
                if line.sets:
                    OmegaConf.update(config, line.key, line.value, merge=True)
            with read_write(config.hydra):
                config.hydra.overrides.hydra = texts
            if len(self._nodes) >= _MOST_COMPOSED:
                self._nodes.clear()
            self._nodes[key] = pickle.dumps(config)
        return cast(DictConfig, pickle.loads(self._nodes[key]))

    def _copy(self, overrides: Sequence[str], hydra_node: bool) -> DictConfig:
        """Return a copy of what Hydra composes of these overrides."""
        key = tuple(overrides)
        if key not in self._composed:
            config = self._loader.load_configuration(self._name, list(overrides), RunMode.RUN)
            whole = pickle.dumps(config)
            with read_write(config), open_dict(config):
                del config["hydra"]
            if len(self._composed) >= _MOST_COMPOSED:
                self._composed.clear()
            self._composed[key] = _Composed(whole, pickle.dumps(config))
        composed = self._composed[key]
        return cast(DictConfig, pickle.loads(composed.whole if hydra_node else composed.settings))

    def _base(
        self, overrides: Sequence[str], lines: Sequence[_Line], values: Mapping[str, _Line]
    ) -> _Base | None:
        """Compose one job for all of its kind; None where their settings are not plain."""
        others = [line for line in lines if not line.sets]
        own = list(values.values())
        if any(_overlap(one, other) for i, one in enumerate(own) for other in (*own[:i], *others)):
            return None
        composed = self(overrides)
        tree = OmegaConf.to_container(composed)
        assert isinstance(tree, dict)
        if _refers(tree):
            return None
        settings = PlainSettings.of(tree)
        if any(_at(settings, key) != line.value for key, line in values.items()):
            return None  # an entry of a list, or a key that is written in another way
        return _Base(settings, records.flat(composed), dict(values))


class _Base(NamedTuple):
    """The settings of one job, from which those of others follow."""

    tree: PlainSettings
    flat: Mapping[str, Any]
    values: Mapping[str, _Line]

    def with_values(self, values: Mapping[str, _Line]) -> tuple[PlainSettings, Mapping[str, Any]]:
        """Return the settings, nested and by dotted keys, with other values of the same keys."""
        tree, flat = PlainSettings(self.tree), dict(self.flat)
        for key, line in values.items():
            if line is self.values[key]:
                continue
            *path, last = key.split(".")
            node = tree
            for part in path:
                node[part] = PlainSettings(node[part])
                node = node[part]
            node[last] = line.value
            if key in flat:
                flat[key] = as_json(line.value)
        return tree, flat


def _others(lines: Sequence[_Line]) -> tuple[str, ...]:
    """Return the overrides that do more than to set a value."""
    return tuple(str(line.override.input_line) for line in lines if not line.sets)


def _overlap(one: _Line, other: _Line) -> bool:
    """Return whether two overrides concern the same setting, or one a part of the other's."""
    if one.path is None or other.path is None:
        return False
    return one.path.startswith(other.path) or other.path.startswith(one.path)


def _at(tree: Any, key: str) -> Any:
    """Return the value at a dotted key; the tree itself where there is none."""
    node = tree
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return tree
        node = node[part]
    return node


def _refers(value: Any) -> bool:
    """Return whether something in a value refers to other settings, or is missing."""
    return "${" in str(value) or "???" in str(value)


def _note_overrides(node: Any, parsed: Sequence[Override]) -> None:
    """Write into Hydra's node what Hydra notes there of all overrides but its own."""
    lines = [str(one.input_line) for one in parsed]
    if as_typed(node.overrides.task) == lines:
        return
    node.overrides.task = lines
    if not OmegaConf.is_interpolation(node.job, "override_dirname"):  # it is one in Hydra 1.4
        node.job.override_dirname = directory_name(node.job.config.override_dirname, parsed)


def directory_name(style: Any, parsed: Sequence[Override]) -> str:
    """Return overrides as the name of a directory, in a style of `hydra.job.config.override_dirname`."""
    named = sorted(str(one.input_line) for one in parsed if one.key_or_group not in style["exclude_keys"])
    joined: str = style["item_sep"].join(named)
    return joined.replace("=", style["kv_sep"])


def sweep_size(overrides: Sequence[Override]) -> float:
    """Return how many jobs these overrides make; a range of a billion numbers is not written out for it."""
    return math.prod(_length(one) for one in overrides if one.is_sweep_override())


def _length(override: Override) -> float:
    value = override._value
    if not isinstance(value, RangeSweep):
        return sum(1 for _ in override.sweep_string_iterator()) if override.is_discrete_sweep() else 1
    start, stop, step = (float(number or 0) for number in (value.start, value.stop, value.step))
    steps = (stop - start) / step if step else math.inf
    return max(0, math.ceil(steps)) if math.isfinite(steps) else math.inf
