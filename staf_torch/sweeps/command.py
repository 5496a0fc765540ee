"""The command line of `staf`, and how it ends.

`staf -m sweep.resume=runs/<sweep>` becomes the command line of the sweep that is taken up again.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from omegaconf import DictConfig

from .. import __version__
from ..results import run_record as records
from ..results.files import FREE, is_free, visible
from ..settings.trust import may_run_code
from .callbacks import farewell, refuse_many
from .hydra_compat import overrides_in, parse_override
from .job import USER_ERRORS, sentence
from .workers import name_and_code, what_ended

_RESUME = "sweep.resume="
_ANYWAY = "sweep.resume_anyway=true"
_YES = "--trust"
_NOT_TAKEN_OVER = ("hydra.mode", "hydra.run.dir", "hydra.sweep.dir", "sweep.resume", "sweep.resume_anyway")
_LONGEST = (
    10_000  # characters: a list in brackets of that length takes Hydra's grammar 1.7 s, one of 50 000 86 s
)


def command_line(argv: Sequence[str]) -> list[str]:
    """Return the arguments with those of the sweep that `sweep.resume` names, if it names one.

    Lines of the sweep that may run code of somebody else are shown, and need a yes at the terminal,
    `--trust`, or to be repeated on the command line.

    Raises:
        ValueError: if no sweep is there, one of other settings or of another version is, or nobody said yes.
    """
    given = overrides_in(argv)
    resumed = [line.removeprefix(_RESUME) for line in given if line.startswith(_RESUME)]
    if not resumed or resumed[-1] == "null":
        return list(argv)
    directory = Path(resumed[-1].strip("'\""))
    typed, hydra = recorded(directory, anyway=_ANYWAY in given)
    if _YES not in argv:
        _check_length(directory, [line for line in (*typed, *hydra) if line not in given])
    refuse_many(directory, typed)
    own = [line for line in given if not _is_hydra(line) and line in records.own([line])]
    free = [*dict.fromkeys(line for line in own if _is_free(line) and line not in typed)]
    own, decisive = ([line for line in lines if not _is_free(line)] for lines in (own, typed))
    if own and sorted(own) != sorted(decisive):
        raise ValueError(_difference(directory, own, decisive))
    typed = [line for line in typed if not any(_replaces(new, line) for new in free)] + free
    about_sweep = [line for line in given if line not in records.own([line]) and not line.startswith(_RESUME)]
    hydra = _merged(hydra, [*about_sweep, *filter(_is_hydra, given)])
    foreign = [line for line in (*typed, *hydra) if line not in given and may_run_code(line)]
    if foreign and _YES not in argv:
        _confirm(directory, foreign)
    place = records.quoted(os.path.normpath(directory))
    flags = [word for word in argv if word not in given and word != _YES]
    return [
        *(flags if {"-m", "--multirun"} & set(flags) else [*flags, "--multirun"]),
        *typed,
        *hydra,
        *filter(_ANYWAY.__eq__, given),
        f"hydra.sweep.dir={place}",
        f"{_RESUME}{place}",
    ]


def _check_length(directory: Path, lines: Sequence[str]) -> None:
    """Raise ValueError for lines that nobody has typed and that Hydra's grammar would take long to read."""
    length = sum(map(len, lines))
    if length > _LONGEST:
        raise ValueError(
            f"{directory} was started with lines of {length} characters, and {_LONGEST} are the most that "
            f"are read unasked: longer ones may take minutes. If you know them, add {_YES}."
        )


def _confirm(directory: Path, foreign: Sequence[str]) -> None:
    """Ask at the terminal.

    Raises:
        ValueError: if there is no terminal, or the answer is not yes.
    """
    shown = "".join(f"\n  {visible(line)}" for line in foreign)
    if sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty():
        sys.stderr.write(f"staf: {directory} was started with lines that may run code:{shown}\n")
        sys.stderr.write("Run them? [y/N] ")
        sys.stderr.flush()
        if sys.stdin.readline().strip().lower() in ("y", "yes"):
            return
    raise ValueError(
        f"{directory} was started with lines that may run code of whoever started it:{shown}\n"
        f"If you know them, repeat them, or add {_YES}."
    )


def recorded(directory: Path, *, anyway: bool = False) -> tuple[list[str], list[str]]:
    """Return the overrides of a sweep as they were typed: the jobs' own, and Hydra's.

    Raises ValueError if no sweep is there, or one of another version, which ``anyway`` allows.
    """
    record = records.read(directory / records.SWEEP)
    if record is None or not _texts(record.get("overrides")) or not _texts(record.get("hydra")):
        raise ValueError(
            f"`staf sweep.resume=...` must be the directory of a sweep, with its {records.SWEEP}; "
            f"got {str(directory)!r}."
        )
    if record.get("version") != __version__ and not anyway:
        raise ValueError(
            f"`staf sweep.resume=...` must be a sweep of this version ({__version__}), or its rows would not "
            f"be comparable; {directory} was written by {str(record.get('version'))[:80]}."
        )
    return record["overrides"], record["hydra"]


def _texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(line, str) for line in value)


def _is_hydra(line: str) -> bool:
    return line.lstrip("+~").startswith(("hydra.", "hydra/"))


def _is_free(line: str) -> bool:
    """Return whether a line may change: no number does with it, and it makes no jobs."""
    return is_free(line) and not parse_override(line).is_sweep_override()


def _replaces(new: str, old: str) -> bool:
    """Return whether a setting takes the place of another: it is the same, or a part of it, or its group."""
    after, before = _key(new), _key(old)
    return _is_free(old) and (f"{after}.".startswith(f"{before}.") or f"{before}.".startswith(f"{after}."))


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
        f"`staf -m sweep.resume={directory}` must have the overrides of that sweep, or none; "
        f"got them {' and '.join(parts) or 'more than once'}. Only settings that change no number may be "
        f"others (hydra. ..., sweep. ..., {', '.join(FREE)}). The sweep is: staf -m {' '.join(typed)}"
    )


def end(error: BaseException, wants_trace: bool, sweep: DictConfig | None = None) -> NoReturn:
    """End the program as an error asks for: by a sentence, by the code of a signal, or by its trace."""
    ended_by = what_ended(error)
    if isinstance(ended_by, KeyboardInterrupt):
        end_by_signal(sweep, ended_by)
    if wants_trace or not isinstance(error, USER_ERRORS):
        raise error
    sys.exit(f"staf: {sentence(error)}")


def end_by_signal(sweep: DictConfig | None, error: KeyboardInterrupt) -> NoReturn:
    """Say which signal ended the program and how to resume, and exit with the code that shells expect."""
    said, code = name_and_code(error)
    with contextlib.suppress(OSError):  # the terminal may be gone
        sys.stderr.write(farewell(sweep, error, said) + "\n")
    sys.exit(code)
