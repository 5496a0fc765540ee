"""The command `staf`: a Hydra application over `conf/`, whose task is `staf_torch.sweeps.job.execute`.

`staf -m sweep.resume=runs/<sweep>` becomes the command line of the sweep that is taken up again.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from typing import NoReturn

from ..settings import config_directory as config_directory
from ..sweeps import callbacks
from ..sweeps.batching import USER_ERRORS, sentence
from ..sweeps.hydra_compat import (
    BrokenSweep,
    broken_sweep,
    find_launcher,
    full_errors,
    named_packages,
    program,
    trusted,
    with_mode,
)
from ..sweeps.job import Refused, execute
from ..sweeps.resume import command_line
from ..sweeps.signals import name_and_code, stopped_by_signals, what_ended
from . import doctor, reference, schema

_WRITERS = {"schema": schema.main, "docs": reference.main}
find_launcher()
_staf = program(execute)


def main() -> None:
    """Run the command line. What a user got wrong ends as one sentence and the exit code 1.

    `staf doctor`, `staf schema`, `staf docs` and `staf --version` are no runs, and Hydra is not asked.
    """
    if sys.argv[1:] == ["--version"]:
        sys.exit(print(doctor.version()))
    if sys.argv[1:] == ["doctor"]:
        sys.exit(doctor.main())
    if sys.argv[1:2] and sys.argv[1] in _WRITERS:
        sys.exit(_written(_WRITERS[sys.argv[1]], sys.argv[2:]))
    sys.path.insert(0, os.getcwd())  # so that `target.path=my_module.my_function` finds the user's file
    typed = sys.argv
    with _told_between_lines(), full_errors() as wants_trace, stopped_by_signals():
        try:
            argv = command_line(typed[1:])
            sys.argv = [typed[0], *with_mode(argv)]
            with trusted(named_packages(argv)):
                _staf()
        except Refused as refused:
            if wants_trace and refused.__cause__ is not None:
                raise refused.__cause__ from None
            raise
        except (Exception, KeyboardInterrupt) as error:
            sweep = broken_sweep(error)
            if sweep is not None:
                callbacks.close(sweep)
            ended_by = what_ended(error)
            if isinstance(ended_by, KeyboardInterrupt):
                _end_by_signal(sweep, ended_by)
            if wants_trace or not isinstance(error, USER_ERRORS):
                raise
            sys.exit(f"staf: {sentence(error)}")
        finally:
            sys.argv = typed


@contextlib.contextmanager
def _told_between_lines() -> Iterator[None]:
    """End in a sentence also where a signal comes before the program has begun, or after it has ended."""
    try:
        yield
    except KeyboardInterrupt as error:
        _end_by_signal(None, error)


def _end_by_signal(sweep: BrokenSweep | None, error: KeyboardInterrupt) -> NoReturn:
    """Say which signal ended the program and how to resume, and exit with the code that shells expect."""
    said, code = name_and_code(error)
    with contextlib.suppress(OSError):  # the terminal may be gone
        sys.stderr.write(callbacks.farewell(sweep, error, said) + "\n")
    sys.exit(code)


def _written(write: Callable[[list[str]], str], words: list[str]) -> str | None:
    """Print what a command that is no run returns; return what to say where it cannot."""
    try:
        sys.stdout.write(write(words) + "\n")
    except ValueError as error:
        return f"staf: {error}"
    return None
