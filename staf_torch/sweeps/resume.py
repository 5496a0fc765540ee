"""`staf -m sweep.resume=runs/<sweep>`: the command line of a sweep that is taken up again."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from .. import __version__
from ..results import run_record as records
from .hydra_compat import overrides_in

_RESUME = "sweep.resume="
_NOT_TAKEN_OVER = ("hydra.mode", "hydra.sweep.dir", "sweep.resume")


def command_line(argv: Sequence[str]) -> list[str]:
    """Return the arguments with those of the sweep that `sweep.resume` names, if it names one.

    Raises:
        ValueError: if no sweep is there, or it is one of other settings or of another version.
    """
    given = overrides_in(argv)
    resumed = [line.removeprefix(_RESUME) for line in given if line.startswith(_RESUME)]
    if not resumed or resumed[-1] == "null":
        return list(argv)
    directory = Path(resumed[-1].strip("'\""))
    typed, hydra = recorded(directory)
    own = [line for line in given if not _is_hydra(line) and line in records.own([line])]
    if own and sorted(own) != sorted(typed):
        raise ValueError(_difference(directory, own, typed))
    about_sweep = [line for line in given if line not in records.own([line]) and not line.startswith(_RESUME)]
    place = records.quoted(os.path.normpath(directory))
    flags = [word for word in argv if word not in given]
    return [
        *(flags if {"-m", "--multirun"} & set(flags) else [*flags, "--multirun"]),
        *typed,
        *_merged(hydra, [*about_sweep, *filter(_is_hydra, given)]),
        f"hydra.sweep.dir={place}",
        f"{_RESUME}{place}",
    ]


def recorded(directory: Path) -> tuple[list[str], list[str]]:
    """Return the overrides of a sweep as they were typed: the jobs' own, and Hydra's.

    Raises:
        ValueError: if no sweep of this version is there.
    """
    record = records.read(directory / records.SWEEP)
    if record is None or "overrides" not in record:
        raise ValueError(
            f"`staf sweep.resume=...` must be the directory of a sweep, with its {records.SWEEP}; "
            f"got {str(directory)!r}."
        )
    if record.get("version") != __version__:
        raise ValueError(
            f"`staf sweep.resume=...` must be a sweep of this version ({__version__}), or its rows would not "
            f"be comparable; {directory} was written by {record.get('version')}."
        )
    return record["overrides"], record["hydra"]


def _is_hydra(line: str) -> bool:
    return line.lstrip("+~").startswith(("hydra.", "hydra/"))


def _key(line: str) -> str:
    return line.lstrip("+~").partition("=")[0]


def _merged(before: Sequence[str], now: Sequence[str]) -> list[str]:
    """Return Hydra's settings, of which some may change: where jobs run does not change what they find."""
    replaced = {*map(_key, now), *_NOT_TAKEN_OVER}
    # The settings of a launcher that is exchanged for another one go with it.
    gone = tuple(f"{key.replace('/', '.')}." for key in replaced if key.startswith("hydra/"))
    kept = [line for line in before if _key(line) not in replaced and not _key(line).startswith(gone)]
    return kept + [line for line in now if _key(line) not in _NOT_TAKEN_OVER]


def _difference(directory: Path, given: Sequence[str], typed: Sequence[str]) -> str:
    missing = " ".join(line for line in typed if line not in given)
    added = " ".join(line for line in given if line not in typed)
    parts = [f"without {missing!r}"] * bool(missing) + [f"with {added!r}"] * bool(added)
    return (
        f"`staf sweep.resume={directory}` must have the overrides of that sweep, or none; "
        f"got them {' and '.join(parts) or 'more than once'}. The sweep is: staf -m {' '.join(typed)}"
    )
