"""The setting `members`: a sweep inside one job, for more members than run directories are good for.

The members are the product of the lists, as `staf -m` would take it; they run in tensor batches and leave one
row each in `members.json`, the row that the same job of a sweep leaves in its own directory.
"""

from __future__ import annotations

import json
import logging
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from .. import __version__
from .._checks import COMMAND_LINE, fail, flag
from ..report import write_metrics, write_text
from ..report.tables import Row, markdown_table
from . import members
from .composition import Composer, config_loader
from .progress import Progress
from .wording import reason

_log = logging.getLogger(__name__)
_LISTED = 20  # members that the log shows one by one
_SHOWN = ("ultimate_error", "floor_error", "ball_error", "ultimate_excess", "diverged_fraction")


def run(cfg: DictConfig, directory: Path, base: Sequence[str] | None = None) -> dict[str, float | None]:
    """Run all members and write `members.json` and `metrics.json`: how many there are, failed and diverged.

    Args:
        cfg: the settings; `members` is not null.
        directory: the run directory.
        base: overrides that led to ``cfg``; Hydra knows them in a program of its own.

    Raises:
        ValueError, hydra.errors.HydraException: if `members` is no list of overrides, or names what is not
            there. What is wrong with one member alone fails it alone.
    """
    name: str | None = "config"
    if base is None and HydraConfig.initialized():
        node = HydraConfig.get()
        base, name = list(node.overrides.task), node.job.config_name
    base = [line for line in base or () if line.lstrip("+~").partition("=")[0] != "members"]
    keep = flag(COMMAND_LINE, "history", cfg.history) and "history=true" in base
    loader = config_loader()
    jobs = product(cfg.members, loader)
    composer = Composer(loader, name, hydra_node=False)
    cfgs = [composer([*base, *job, "figures=false", f"history={str(keep).lower()}"]) for job in jobs]
    rows = _solve(cfgs, jobs, directory, keep)
    write_text(directory / "members.json", _json({"version": __version__, "members": rows}))
    _report(rows)
    counts: dict[str, float | None] = {
        "members": len(rows),
        "failed": sum(row["status"] == "failed" for row in rows),
        "diverged": sum(bool(row["metrics"].get("diverged_fraction")) for row in rows),
    }
    write_metrics(directory / "metrics.json", counts)
    return counts


def product(setting: Any, loader: ConfigLoader) -> list[list[str]]:
    """The overrides of every member, in the order of Hydra's own sweeper.

    Raises:
        ValueError: if the setting is not a list of overrides in Hydra's grammar.
    """
    lines = OmegaConf.to_container(setting) if OmegaConf.is_config(setting) else setting
    lines = [lines] if isinstance(lines, str) else lines
    if not isinstance(lines, list) or not lines or not all(isinstance(line, str) for line in lines):
        raise fail(COMMAND_LINE, "members", "must be a list of overrides, like 'seed=range(100)'", lines)
    parser = OverridesParser.create(config_loader=loader)
    overrides = []
    for line in lines:
        try:
            (override,) = parser.parse_overrides([line])
        except HydraException as error:
            rule = f"must be overrides in Hydra's grammar ({str(error).splitlines()[0]})"
            raise fail(COMMAND_LINE, "members", rule, line) from error
        overrides.append(override)
        if override.is_hydra_override() or override.key_or_group == "members":
            raise fail(COMMAND_LINE, "members", "must be about the experiment alone", line)
    (batch,) = BasicSweeper.split_arguments(overrides, None)
    return batch


def _solve(
    cfgs: Sequence[DictConfig], jobs: Sequence[list[str]], directory: Path, keep: bool
) -> list[dict[str, Any]]:
    """A row a member, in order."""
    rows: list[dict[str, Any]] = [{} for _ in cfgs]
    progress = Progress(len(cfgs), "members")
    for group in members.groups(cfgs):
        for chunk in members.chunks(cfgs, group):
            for index, solved in zip(chunk, members.solve([cfgs[i] for i in chunk]), strict=True):
                rows[index] = _row(cfgs[index], index, jobs[index], solved, directory, keep)
            progress.advance(len(chunk))
    progress.close()
    return rows


def _row(
    cfg: DictConfig, number: int, overrides: list[str], solved: Any, directory: Path, keep: bool
) -> dict[str, Any]:
    row = {"num": number, "overrides": overrides, "status": "completed", "reason": None, "metrics": {}}
    try:
        if isinstance(solved, Exception):
            raise solved
        row["metrics"] = getattr(solved, "metrics", None)
        if keep or row["metrics"] is None:  # it has files, or it runs only now
            own = directory / "members" / str(number)
            own.mkdir(parents=True, exist_ok=True)
            row["metrics"] = members.write(cfg, own, solved)
    except Exception as error:
        row |= {"status": "failed", "reason": reason(error), "metrics": {}}
    return row


def _report(rows: Sequence[dict[str, Any]]) -> None:
    """A short table: the members themselves where they are few, else the spread of each metric."""
    for row in [row for row in rows if row["status"] == "failed"][:_LISTED]:
        _log.error("member %d (%s): %s", row["num"], " ".join(row["overrides"]), row["reason"])
    if len(rows) <= _LISTED:
        shown = [name for name in _SHOWN if any(name in row["metrics"] for row in rows)]
        cells: list[Row] = [{"member": " ".join(row["overrides"]), **row["metrics"]} for row in rows]
        _say(markdown_table(cells, {"member": "member"} | {name: name for name in shown}))
        return
    spread: list[Row] = []
    for name in dict.fromkeys(name for row in rows for name in row["metrics"]):
        found = [row["metrics"][name] for row in rows if row["metrics"].get(name) is not None]
        if found:
            middle = statistics.median(found)
            spread.append(
                {
                    "metric": name,
                    "least": min(found),
                    "median": middle,
                    "most": max(found),
                    "members": len(found),
                }
            )
    _say(markdown_table(spread, {name: name for name in ("metric", "least", "median", "most", "members")}))


def _say(table: str) -> None:
    for line in table.splitlines():
        _log.info("%s", line)


def _json(record: dict[str, Any]) -> str:
    """One member a line."""
    rows = ",\n".join(json.dumps(row, allow_nan=False) for row in record["members"])
    return f'{{"version": {json.dumps(record["version"])}, "members": [\n{rows}\n]}}\n'
