"""The part of Hydra in a job of a sweep, made of plain values: its node, its log, the texts of `.hydra/`.

OmegaConf takes ten milliseconds a job for them. Jobs of a sweep differ in a few lines there, so that the
first job of a kind is asked, and the others are changed copies.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import yaml
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from omegaconf._utils import OmegaConfDumper

from .composing import as_typed, directory_name

_KNOWN = ("hydra.runtime.output_dir", "hydra.job.name")  # what a log may refer to in a job that follows
_MOST = 1000  # entries of YAML that are kept


class NodeOfJob(NamedTuple):
    """Facts that Hydra's node of a job says."""

    directory: str  # absolute
    node: Mapping[str, Any]  # as it is written: interpolations are not looked up
    log: Any  # `hydra.job_logging`, resolved; None: Hydra's own
    verbose: Any
    env: Mapping[str, str]  # variables of the job's own
    folder: str | None  # for the settings
    choices: Mapping[str, str | None]  # of each group
    overrides: list[str]

    @classmethod
    def of(cls, config: DictConfig) -> NodeOfJob:
        """Read it in a configuration with Hydra's node."""
        node: Any = config.hydra
        log = node.job_logging
        return cls(
            str(node.runtime.output_dir),
            cast(dict[str, Any], OmegaConf.to_container(node, enum_to_str=True)),
            None if log is None else OmegaConf.to_container(log, resolve=True),
            node.verbose,
            {str(name): str(value) for name, value in node.job.env_set.items()},
            node.output_subdir,
            {str(group): choice for group, choice in node.runtime.choices.items()},
            as_typed(node.overrides.task),
        )

    @property
    def leads(self) -> bool:
        """Return whether that of other jobs follows from this one."""
        refers = re.findall(r"\$\{([^}]*)\}", str(self.node["job_logging"]))
        own = str((self.node["job"]["name"], self.node["job"]["env_set"], self.node["output_subdir"]))
        return set(refers) <= set(_KNOWN) and "${" not in own

    def followed(self, num: int, parsed: Sequence[Override], directory: str) -> NodeOfJob:
        """Return that of job ``num``, which differs in these overrides and in its directory alone."""
        node, job = dict(self.node), dict(self.node["job"])
        lines = [str(one.input_line) for one in parsed]
        job |= {"id": str(num), "num": num}
        if "${" not in str(job["override_dirname"]):  # it is one in Hydra 1.4
            job["override_dirname"] = directory_name(job["config"]["override_dirname"], parsed)
        node["overrides"] = {**node["overrides"], "task": lines}
        node["runtime"] = {**node["runtime"], "output_dir": directory}
        node["job"] = job
        log = _moved(self.log, self.node["job_logging"], self.directory, directory)
        return self._replace(directory=directory, node=node, log=log, overrides=lines)


def _moved(value: Any, written: Any, before: str, now: str) -> Any:
    """Return resolved settings with another directory, where ``written`` names it."""
    if isinstance(value, dict):
        return {key: _moved(inner, written[key], before, now) for key, inner in value.items()}
    if isinstance(value, list):
        return [_moved(inner, own, before, now) for inner, own in zip(value, written, strict=True)]
    return value.replace(before, now) if isinstance(value, str) and _KNOWN[0] in str(written) else value


class Texts:
    """YAML as OmegaConf writes it; an entry is emitted once, however many files have it."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, int], str] = {}

    def mapping(self, content: Mapping[Any, Any], depth: int = 0) -> str:
        """Return the lines of a mapping that is in so many others."""
        return "".join(self._entry(key, value, depth) for key, value in content.items()) or "{}\n"

    def lines(self, content: Sequence[str]) -> str:
        """Return a list of texts."""
        return "".join(self._kept("", one, 0, functools.partial(_yaml, [one])) for one in content) or "[]\n"

    def _entry(self, key: Any, value: Any, depth: int) -> str:
        nested = isinstance(value, Mapping) and bool(value)

        def emitted() -> str:
            if nested:
                return _line(key, 0, depth).removesuffix(" 0\n") + "\n" + self.mapping(value, depth + 1)
            return _line(key, dict(value) if isinstance(value, Mapping) else value, depth)

        # The whole node of Hydra is another one in every job.
        return emitted() if nested and not depth else self._kept(repr(key), value, depth, emitted)

    def _kept(self, key: str, value: Any, depth: int, emitted: Callable[[], str]) -> str:
        known = key, repr(value), depth
        if known not in self._known:
            if len(self._known) >= _MOST:
                self._known.clear()
            self._known[known] = emitted()
        return self._known[known]


def _line(key: Any, value: Any, depth: int) -> str:
    """Return the lines of a key whose value is no mapping."""
    nested = {key: value}
    for _ in range(depth):
        nested = {"x": nested}
    return _yaml(nested).split("\n", depth)[-1]


def _yaml(content: Any) -> str:
    text: str = yaml.dump(content, Dumper=_DUMPER, allow_unicode=True, sort_keys=False)
    return text


_BASE: Any = getattr(yaml, "CDumper", yaml.Dumper)  # emitted in C where that is built: a tenth of the time
_DUMPER: Any = type("_Dumper", (_BASE,), {})
_DUMPER.add_representer(str, OmegaConfDumper.str_representer)


def absolute(directory: Path) -> str:
    """Return a directory as Hydra's node has it."""
    return os.path.normpath(directory.absolute())
