"""A run directory to its runs: one, or one a member. The run may go on, or be killed or damaged."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .overrides import Value, flatten, parse_overrides
from .run import COMPLETED, FAILED, RUNNING, UNFINISHED, Run

RUN, MEMBERS, METRICS, SWEEP = "run.json", "members.json", "metrics.json", "sweep.json"
OVERRIDES = Path(".hydra", "overrides.yaml")


class UnreadableError(Exception):
    """A directory or file that cannot be read; the message says why."""


def is_run(directory: Path) -> bool:
    """Whether a run left its files there."""
    return any((directory / name).exists() for name in (RUN, MEMBERS, METRICS, OVERRIDES))


def read_run(directory: Path) -> list[Run]:
    """The runs of a run directory.

    Raises:
        UnreadableError: if not even the settings can be read.
    """
    if not (directory / RUN).exists():
        return [_without_record(directory, None)]
    try:
        record = read_object(directory / RUN)
        run = _of_record(directory, record)
    except UnreadableError as error:
        return [_without_record(directory, str(error))]
    return _members(run) if (directory / MEMBERS).exists() else [run]


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        UnreadableError: if there is none.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UnreadableError(f"{path.name} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise UnreadableError(f"{path.name} is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise UnreadableError(f"{path.name} holds no object")
    return found


def _of_record(directory: Path, record: Mapping[str, Any]) -> Run:
    status, reason = _status(record)
    metrics: dict[str, float | None] = {}
    lost: dict[str, str] = {}
    if status == COMPLETED:
        try:
            metrics, lost = _metrics(read_object(directory / METRICS))
        except UnreadableError as error:
            reason = str(error)
    return Run(
        directory=directory,
        overrides=parse_overrides(_lines(record)),
        settings=_settings(record),
        metrics=metrics,
        status=status,
        reason=reason,
        version=_text(record.get("version")),
        task=_text(record.get("task")),
        seconds=_number(record.get("seconds")),
        lost=lost,
    )


def _status(record: Mapping[str, Any]) -> tuple[str, str | None]:
    status, reason = record.get("status"), _text(record.get("reason"))
    if status == RUNNING:
        return RUNNING, reason or "has not ended: it goes on, or was killed"
    if status == FAILED:
        return FAILED, reason or "no reason was left"
    if status != COMPLETED:
        by = f", written by staf_torch {record.get('version', 'of an unknown version')}"
        raise UnreadableError(f"{RUN}{by}: the status {status!r} is not known here")
    return COMPLETED, reason


def _members(run: Run) -> list[Run]:
    """One a member; its overrides come on top of the run's."""
    listed = read_object(run.directory / MEMBERS).get("members")
    if not isinstance(listed, list) or not all(isinstance(member, dict) for member in listed):
        raise UnreadableError(f"{MEMBERS} has no list of members")
    return [_member(run, number, member) for number, member in enumerate(listed)]


def _member(run: Run, number: int, member: Mapping[str, Any]) -> Run:
    status, reason = _status(member)
    own = parse_overrides(_lines(member))
    metrics, lost = _metrics(member.get("metrics") or {}) if status == COMPLETED else ({}, {})
    stated = _settings(member) or {**run.settings, **own}
    return Run(
        directory=run.directory,
        overrides={key: value for key, value in run.overrides.items() if not _of_axis(key)} | own,
        settings={key: value for key, value in stated.items() if not _of_axis(key)},
        metrics=metrics,
        status=status,
        reason=reason,
        member=int(_number(member.get("num")) or number),
        version=run.version,
        task=run.task,
        lost=lost,
    )


def _of_axis(key: str) -> bool:
    """Whether a setting lists the members themselves."""
    return key == "members" or key.startswith("members.")


def _without_record(directory: Path, why: str | None) -> Run:
    """What Hydra's own files and the metrics say: a run of a version without `run.json`, or a damaged one."""
    try:
        overrides, settings = _of_hydra(directory)
    except UnreadableError as error:
        raise UnreadableError("; ".join(filter(None, (why, str(error))))) from error
    reason, status = why, COMPLETED
    metrics: dict[str, float | None] = {}
    lost: dict[str, str] = {}
    try:
        metrics, lost = _metrics(read_object(directory / METRICS))
    except UnreadableError as error:
        exists = (directory / METRICS).exists()
        end = str(error) if exists else f"has no {METRICS}: it goes on, failed or was killed"
        reason, status = "; ".join(filter(None, (why, end))), UNFINISHED
    return Run(
        directory, overrides, settings, metrics, status, reason, task=_text(settings.get("task")), lost=lost
    )


def _of_hydra(directory: Path) -> tuple[dict[str, Value], dict[str, Value]]:
    import yaml  # Hydra brings it; only runs without `run.json` need it

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

    def load(name: str) -> Any:
        try:
            return yaml.load((directory / ".hydra" / name).read_text(encoding="utf-8"), loader)
        except OSError as error:
            raise UnreadableError(f".hydra/{name} cannot be read: {error.strerror}") from error
        except yaml.YAMLError as error:
            raise UnreadableError(f".hydra/{name} is not YAML: {error}") from error

    lines = load(OVERRIDES.name)
    if not isinstance(lines, list):
        raise UnreadableError(f"{OVERRIDES} holds no list")
    try:
        composed, choices = load("config.yaml"), load("hydra.yaml")["hydra"]["runtime"]["choices"]
        options = {group: option for group, option in choices.items() if not group.startswith("hydra/")}
        settings = flatten(composed) | options
    except (UnreadableError, KeyError, TypeError, AttributeError):
        settings = {}  # the overrides tell runs apart without them
    return parse_overrides(str(line) for line in lines), settings


def _metrics(found: Mapping[str, Any]) -> tuple[dict[str, float | None], dict[str, str]]:
    """The numbers, and what stood in the place of one; nested or other values are no metrics."""
    metrics: dict[str, float | None] = {}
    lost: dict[str, str] = {}
    for name, value in found.items():
        if value is None or (isinstance(value, int) and not isinstance(value, bool)):
            metrics[name] = value
        elif isinstance(value, float):
            metrics[name] = value if math.isfinite(value) else None
            if not math.isfinite(value):
                lost[name] = repr(value)
    return metrics, lost


def _lines(record: Mapping[str, Any]) -> list[str]:
    lines = record.get("overrides")
    return [str(line) for line in lines] if isinstance(lines, list) else []


def _settings(record: Mapping[str, Any]) -> dict[str, Value]:
    found = record.get("settings")
    return dict(found) if isinstance(found, dict) else {}


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _number(value: object) -> float | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None
