"""`run.json` of a run and `sweep.json` of a sweep: what ran, with which settings, and how it ended."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ... import __version__
from ...report import write_text

RUN, SWEEP, METRICS = "run.json", "sweep.json", "metrics.json"
SETTINGS = "sweep"
"""The group of settings that are about the sweep and not about its jobs."""


class RunRecord:
    """`run.json`, written when a run begins and again when it ends.

    Args:
        cfg: all settings but Hydra's.
        choices: the option chosen of each group of settings.
        overrides: as typed.
    """

    def __init__(self, cfg: DictConfig, choices: Mapping[str, str | None], overrides: Sequence[str]) -> None:
        self._start = time.monotonic()
        self._about = {
            "version": __version__,
            "task": cfg.get("task"),
            "overrides": own(overrides),
            "settings": flat(cfg) | {g: c for g, c in choices.items() if not g.startswith("hydra/")},
        }

    def add_seconds(self, seconds: float) -> None:
        """Spent on the run before it began, its share of a tensor batch."""
        self._start -= seconds

    def write(self, directory: Path, status: str, reason: str | None = None) -> None:
        """The record with that status: running, completed or failed."""
        spent = round(time.monotonic() - self._start, 3)
        record = {**self._about, "status": status, "reason": reason, "seconds": spent}
        write_text(directory / RUN, json.dumps(record, indent=1, allow_nan=False) + "\n")


def own(overrides: Sequence[str]) -> list[str]:
    """The overrides of a job itself, without those about the sweep that it is part of."""
    return [line for line in overrides if not line.lstrip("+~").startswith(f"{SETTINGS}.")]


def flat(cfg: DictConfig) -> dict[str, Any]:
    """Dotted key to number, text, null or list, for every setting but those of the sweep."""
    try:
        settings = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException:  # something refers to what is not there: as it is written
        settings = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(settings, dict)
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if key not in (SETTINGS, "hydra"):
            _flatten(str(key), value, found)
    return found


def _flatten(prefix: str, value: Any, found: dict[str, Any]) -> None:
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            _flatten(f"{prefix}.{key}", inner, found)
    else:
        found[prefix] = plain(value)


def plain(value: Any) -> Any:
    """What JSON can hold; a number that is not finite becomes its name."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def read(path: Path) -> dict[str, Any] | None:
    """A JSON object, or None where there is none that can be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def metrics_of(directory: Path, overrides: Sequence[str]) -> dict[str, float | None] | None:
    """The metrics of a run that was completed by this version with these overrides, else None.

    Raises:
        ValueError: if the directory holds a run of other settings or of another version.
    """
    record = read(directory / RUN)
    if record is None:
        return None
    if record.get("version") != __version__:
        raise ValueError(
            f"{directory} was written by staf_torch {record.get('version')}, and this is {__version__}: "
            "their numbers may differ. Run the sweep anew, or with that version."
        )
    if record.get("overrides") != own(overrides):
        raise ValueError(
            f"{directory} holds the run {' '.join(record.get('overrides', []))!r}, "
            f"where this sweep has {' '.join(own(overrides))!r}."
        )
    return read(directory / METRICS) if record.get("status") == "completed" else None


def resumed(cfg: DictConfig) -> bool:
    """Whether the sweep of these settings takes up an earlier one."""
    return OmegaConf.select(cfg, f"{SETTINGS}.resume") is not None


def without_hydra(config: DictConfig) -> DictConfig:
    """The settings as a task sees them, a copy."""
    return OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])


def begin_sweep(directory: Path, overrides: Sequence[str], hydra: Sequence[str]) -> None:
    """`sweep.json` of a sweep that begins: what was typed, of the jobs and of Hydra and the sweep."""
    jobs = own(overrides)
    others = [*hydra, *(line for line in overrides if line not in jobs)]
    _write_sweep(directory, {"version": __version__, "overrides": jobs, "hydra": others})


def list_jobs(directory: Path, numbered: Mapping[int, Sequence[str]]) -> None:
    """Add jobs to `sweep.json`, number to overrides, before the first of them starts."""
    record = read(directory / SWEEP) or {"version": __version__}
    jobs = {job["num"]: job["overrides"] for job in record.get("jobs", ())}
    jobs |= {num: own(overrides) for num, overrides in numbered.items()}
    listed = [{"num": num, "overrides": overrides} for num, overrides in sorted(jobs.items())]
    _write_sweep(directory, {**record, "jobs": listed})


def _write_sweep(directory: Path, record: Mapping[str, Any]) -> None:
    write_text(directory / SWEEP, json.dumps({"jobs": [], **record}, indent=1, allow_nan=False) + "\n")


def quoted(value: str) -> str:
    """A text as a value in Hydra's grammar of overrides."""
    if re.fullmatch(r"[A-Za-z0-9_./@+-]+", value):
        return value
    return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
