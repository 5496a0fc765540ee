"""`run.json` of a run and `sweep.json` of a sweep: what ran, with which settings, and how it ended."""

from __future__ import annotations

import json
import logging
import platform
import re
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NoReturn

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from .._version import __version__
from ..numerics import COMMAND_LINE, fail
from .build import build, checksums, damaged, differences, imported, machine, record_checksum
from .files import COMPLETED, METRICS, ROWS, UnreadableError, flatten, is_free, plain, read_object, write_text
from .files import RUN as RUN
from .files import SWEEP as SWEEP
from .run import MetricInfo

_log = logging.getLogger(__name__)
_TOLD = 4  # differences that a message names
_SHOWN, _LINE = 80, 1000  # characters of a version, and of a command line, that a message repeats
SETTINGS = "sweep"
"""The group of settings that are about the sweep and not about its jobs."""


class RunRecord:
    """Write `run.json` when a run begins and again when it ends.

    Args:
        cfg: all settings but Hydra's; ``known`` is what `flat` returns of them, where that is known.
        choices: the option chosen of each group of settings.
        overrides: as typed.
        compiler: that makes machine code of the run, in its own words.
    """

    def __init__(
        self,
        cfg: DictConfig,
        choices: Mapping[str, str | None],
        overrides: Sequence[str],
        compiler: str = "",
        known: Mapping[str, Any] | None = None,
    ) -> None:
        self._start = time.monotonic()
        settings = {**(flat(cfg) if known is None else known)} | {
            g: c for g, c in choices.items() if not g.startswith("hydra/")
        }
        self._about = {
            "version": __version__,
            "task": cfg.get("task"),
            "overrides": own(overrides),
            "settings": settings,
            "build": build(settings, compiler),
        }
        # What no run is told apart by: when and where it ran, and the units of its plant.
        self._facts: dict[str, Any] = {
            "began": datetime.now(UTC).isoformat(timespec="seconds"),
            "machine": machine(),
            "python": platform.python_version(),
            "units": {},
        }
        self._files: tuple[str, ...] = ("**/*",)
        self._cfg = cfg

    def covers(self, *patterns: str) -> None:
        """Keep the checksums of files of these patterns alone, where others of the directory may change."""
        self._files = patterns

    @property
    def made_by(self) -> str:
        """Hash of settings, overrides, source, modules, torch and compiler."""
        about = {key: value for key, value in self._about.items() if key != "metrics"}
        about["settings"] = {k: value for k, value in about["settings"].items() if not is_free(k)}
        return record_checksum(about | {"overrides": _decisive(about["overrides"])})

    def declare(self, metrics: Sequence[MetricInfo]) -> None:
        """Add metrics of the user's own, so that a table knows them without their code."""
        if metrics:
            self._about["metrics"] = {info.name: info.record() for info in metrics}

    def measured_in(self, units: Mapping[str, str]) -> None:
        """Add the units of the plant: of its state and its input, where it declares them."""
        self._facts["units"] = dict(units)

    def add_seconds(self, seconds: float) -> None:
        """Count time that was spent on the run before it began: its share of a tensor batch."""
        self._start -= seconds

    def write(self, directory: Path, status: str, reason: str | None = None) -> None:
        """Write the record with a status: running, completed or failed."""
        spent = round(time.monotonic() - self._start, 3)
        record = {**self._about, **self._facts, "status": status, "reason": reason, "seconds": spent}
        if status == COMPLETED:
            made_by = self._about["build"]
            further = imported(made_by["modules"])  # as the run has ended: it imported them on its way
            record["build"] = {**made_by, "imported": further} if further else made_by
            record["files"] = checksums(directory, frozenset({RUN}), self._files)
        record["checksum"] = record_checksum(record)
        write_text(directory / RUN, json.dumps(record, indent=1, allow_nan=False) + "\n")

    def finished_before(self, directory: Path) -> dict[str, float | None] | None:
        """Return what `finished` returns where the settings resume a sweep, else None."""
        if not resumed(self._cfg):
            return None
        return self.finished(directory, anyway=resumed_anyway(self._cfg))

    def finished(self, directory: Path, *, anyway: bool = False) -> dict[str, float | None] | None:
        """Return the metrics of this very run where it was completed before, else None; of a table, nothing.

        A run whose files are damaged is none that was completed; a warning names the file. ``anyway`` lets a
        run of other settings, source, modules, torch or compiler count as well; else ValueError is raised
        where the directory holds a run that was made otherwise, and says what differs.
        """
        record = read(directory / RUN)
        if record is None or record.get("status") != COMPLETED:
            return None
        lines = record.get("overrides")
        texts = [str(line) for line in lines] if isinstance(lines, list) else None
        if texts is None or _decisive(texts) != _decisive(self._about["overrides"]):
            typed = " ".join(texts) if texts is not None else str(lines)
            typed = typed if len(typed) <= _LINE else f"{typed[: _LINE - 3]}..."
            raise ValueError(
                f"{directory} holds the run {typed!r}, where this sweep has "
                f"{' '.join(self._about['overrides'])!r}."
            )
        wrong = damaged(directory, record, thorough=True)
        if wrong is not None:
            _log.warning("%s: %s; it is run again", directory, wrong)
            return None
        if not anyway and (told := self._differences(record)):
            raise ValueError(
                f"{directory} was made with other settings or source: {told}. Numbers may "
                "differ: run the sweep anew, or keep what is there by `sweep.resume_anyway=true`; tables "
                "tell the two apart."
            )
        return {} if (directory / ROWS).exists() else read(directory / METRICS)

    def refuse_rows(self, directory: Path) -> NoReturn:
        """Refuse to go on with rows of a table that something else made.

        Raises:
            ValueError: with what differs.
        """
        told = self._differences(read(directory / RUN) or {}) or "its overrides were others"
        raise ValueError(
            f"{directory} has rows that were made with other settings or source: {told}. One table of "
            "both would mix them: run the sweep in another directory, or begin it anew by "
            "`sweep.resume_anyway=true`."
        )

    def _differences(self, record: Mapping[str, Any]) -> str:
        """Return what differs between an earlier record and this one, the first few."""
        told = [*differences(record, self._about, is_free)]
        if record.get("version") != __version__:
            then = str(record.get("version"))[:_SHOWN]
            told.insert(0, f"it was written by staf_torch {then}, and this is {__version__}")
        more = f"; and {len(told) - _TOLD} more" if len(told) > _TOLD else ""
        return "; ".join(told[:_TOLD]) + more


def own(overrides: Sequence[str]) -> list[str]:
    """Return the overrides of a job itself, without those about the sweep that it is part of."""
    return [line for line in overrides if not line.lstrip("+~").startswith(f"{SETTINGS}.")]


def _decisive(overrides: Sequence[str]) -> list[str]:
    return [line for line in overrides if not is_free(line)]


def flat(cfg: DictConfig) -> dict[str, Any]:
    """Return every setting but those of the sweep: dotted key to number, text, null or list."""
    try:
        settings = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException:  # something refers to what is not there: as it is written
        settings = OmegaConf.to_container(cfg)
    assert isinstance(settings, dict)
    own_ones = {key: value for key, value in settings.items() if key not in (SETTINGS, "hydra")}
    return {key: plain(value) for key, value in flatten(own_ones).items()}


def read(path: Path) -> dict[str, Any] | None:
    """Return a JSON object, or None where there is none that can be read."""
    try:
        return read_object(path)
    except UnreadableError:
        return None


def completed(directory: Path) -> list[str] | None:
    """Return the overrides of the completed run in a directory, None where there is none."""
    record = read(directory / RUN) or {}
    lines = record.get("overrides")
    return [*map(str, lines)] if record.get("status") == COMPLETED and isinstance(lines, list) else None


def resumed(cfg: DictConfig) -> bool:
    """Return whether the sweep of these settings takes up an earlier one."""
    return OmegaConf.select(cfg, f"{SETTINGS}.resume") is not None


def resumed_anyway(cfg: DictConfig) -> bool:
    """Return whether runs count that were made by other settings or another source than those of today."""
    return OmegaConf.select(cfg, f"{SETTINGS}.resume_anyway") is True


def in_table(cfg: DictConfig) -> bool:
    """Return whether the jobs of a sweep with these settings leave rows of one table.

    Raises:
        ValueError: if `sweep.records` is neither `directories` nor `table`.
    """
    chosen = OmegaConf.select(cfg, f"{SETTINGS}.records", default="directories")
    if chosen not in ("directories", "table"):
        raise fail(COMMAND_LINE, f"{SETTINGS}.records", "must be one of 'directories', 'table'", chosen)
    return bool(chosen == "table")


def begin_sweep(directory: Path, overrides: Sequence[str], hydra: Sequence[str]) -> None:
    """Write `sweep.json` of a sweep that begins: what was typed, about the jobs and about the sweep."""
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
    """Return a text as a value in Hydra's grammar of overrides."""
    if re.fullmatch(r"[A-Za-z0-9_./@+-]+", value) and not _is_other(value):
        return value
    # Backslashes count there before a quote alone.
    inner = re.sub(r"(\\*)('|\Z)", lambda found: 2 * found[1] + found[2].replace("'", "\\'"), value)
    return f"'{inner}'"


def _is_other(word: str) -> bool:
    """Return whether a word without quotes is a number, a truth value or null."""
    try:
        float(word)
    except ValueError:
        return word.lower() in ("null", "true", "false")
    return True
