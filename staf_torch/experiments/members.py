"""Many configurations side by side: which may share a tensor batch, and solving them as one.

An experiment takes part by five names in its module: BATCHABLE, settings whose numbers may differ within a
batch; `shape(settings)`, what follows from those and must be equal all the same; `size(settings)`, the bytes
that a member keeps; `solve_members(cfgs)` and `write(cfg, directory, solved)`. Every other experiment is run
one by one. Messages of the members of a batch are kept for `write`.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from .._checks import choice
from .composition import settings
from .wording import reason

_log = logging.getLogger(__name__)
Metrics = dict[str, float | None]
_KEPT_BYTES = 2**28
"""What the members of a chunk may keep until they are written."""
_CHUNK = 128
"""Members a chunk: more gain nothing, and what is done is written that much later."""


@dataclasses.dataclass(frozen=True)
class Deferred:
    """In place of a solution: this experiment runs when it is written."""


Solved = Any
"""What an experiment's `write` takes: picklable."""


def groups(cfgs: Sequence[DictConfig]) -> list[list[int]]:
    """Indices of the configurations that may share one tensor batch, in order of appearance.

    They differ in what their experiment declares batchable, and there in numbers alone.
    """
    found: dict[str, list[int]] = {}
    for index, cfg in enumerate(cfgs):
        found.setdefault(_group(cfg, index), []).append(index)
    return list(found.values())


def chunks(cfgs: Sequence[DictConfig], indices: Sequence[int]) -> list[list[int]]:
    """The indices of a group in pieces that fit into memory together."""
    parts: list[list[int]] = []
    total = 0
    for index in indices:
        bytes_ = _size(cfgs[index])
        if not parts or len(parts[-1]) >= _CHUNK or total + bytes_ > _KEPT_BYTES:
            parts.append([])
            total = 0
        parts[-1].append(index)
        total += bytes_
    return parts


def solve(cfgs: Sequence[DictConfig]) -> list[Solved | Exception]:
    """One chunk as one tensor batch; an exception in the place of a member that failed.

    Where the batch as a whole raises, its members are tried one by one, so that only the culprit fails.
    """
    try:
        experiment = _module(cfgs[0])
        if any(cfg.get("members") is not None for cfg in cfgs) or not hasattr(experiment, "solve_members"):
            return [Deferred() for _ in cfgs]
        solved: list[Solved | Exception] = experiment.solve_members(cfgs)
        return solved
    except Exception as error:
        if len(cfgs) == 1:
            return [error]
        _log.warning("a batch of %d cannot run as one (%s); each runs alone", len(cfgs), reason(error))
        return [found for cfg in cfgs for found in solve([cfg])]


def write(cfg: DictConfig, directory: Path, solved: Solved | Exception) -> Metrics:
    """Fill the run directory with what `solve` found.

    Raises:
        Exception: what it found, where that is one.
    """
    if isinstance(solved, Exception):
        raise solved
    if isinstance(solved, Deferred):
        return run(cfg, directory)
    metrics: Metrics = _module(cfg).write(cfg, directory, solved)
    return metrics


def run(cfg: DictConfig, directory: Path) -> Metrics:
    """Run what the settings describe, one configuration or the `members` of one, and fill the directory."""
    from . import batch_axis  # which imports this module

    if cfg.get("members") is not None:
        return batch_axis.run(cfg, directory)
    metrics: Metrics = _module(cfg).run(cfg, directory)
    return metrics


def _module(cfg: DictConfig) -> ModuleType:
    from .app import EXPERIMENTS  # which imports this module

    choice("staf", "task", cfg.task, EXPERIMENTS)
    return importlib.import_module(f"{__package__}.{cfg.task}")


def _group(cfg: DictConfig, index: int) -> str:
    """A text that is equal for the members of a group."""
    alone = json.dumps(index)
    try:
        experiment, flat = _module(cfg), settings(cfg)
        batchable = getattr(experiment, "BATCHABLE", None)
        if batchable is None:
            return alone
        static = [experiment.shape(flat)]
        for name, value in flat.items():
            static.append([name, _form(value) if name in batchable else value])
        return json.dumps(static)
    except (ValueError, TypeError, KeyError, AttributeError, OmegaConfBaseException):
        return alone  # what is wrong with it, it will say itself


def _form(value: object) -> object:
    """What a batch shares of a batchable value: nothing of a number, the form of a list, all of a word."""
    if isinstance(value, list):
        return [_form(entry) for entry in value]
    return "number" if isinstance(value, int | float) and not isinstance(value, bool) else [value]


def _size(cfg: DictConfig) -> int:
    try:
        bytes_: int = _module(cfg).size(settings(cfg))
    except (ValueError, TypeError, KeyError, AttributeError, OmegaConfBaseException):
        return 0
    return bytes_
