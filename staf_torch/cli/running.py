"""Runs and sweeps of `staf`: a Hydra application over `conf/`, whose task is `sweeps.job.execute`.

`staf -m sweep.resume=runs/<sweep>` becomes the command line of the sweep that is taken up again.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import NoReturn

from omegaconf import DictConfig

from ..sweeps import callbacks
from ..sweeps.batching import USER_ERRORS, sentence
from ..sweeps.hydra_compat import (
    application,
    find_launcher,
    full_errors,
    is_about_settings,
    program,
)
from ..sweeps.job import Refused, execute
from ..sweeps.resume import command_line
from ..sweeps.workers import name_and_code, stopped_by_signals, what_ended

find_launcher()
_showing = program(execute)


def main() -> None:
    """Run the command line. What a user got wrong ends as one sentence and the exit code 1."""
    typed = sys.argv
    with _told_between_lines(), full_errors() as wants_trace, stopped_by_signals():
        try:
            argv = command_line(typed[1:])
            if is_about_settings(argv):
                sys.argv = [typed[0], *argv]
                _showing()
                return
            with application(argv) as app:
                try:
                    if app.multirun or app.is_sweep():
                        app.sweep(execute)
                    else:
                        app.run(execute)
                except (Exception, KeyboardInterrupt) as error:
                    if app.begun is None:
                        raise
                    callbacks.close(app.begun)
                    _end(error, wants_trace, app.begun)
        except Refused as refused:
            if wants_trace and refused.__cause__ is not None:
                raise refused.__cause__ from None
            raise
        except (Exception, KeyboardInterrupt) as error:
            _end(error, wants_trace)
        finally:
            sys.argv = typed


def _end(error: BaseException, wants_trace: bool, sweep: DictConfig | None = None) -> NoReturn:
    """End the program as an error asks for: by a sentence, by the code of a signal, or by its trace."""
    ended_by = what_ended(error)
    if isinstance(ended_by, KeyboardInterrupt):
        _end_by_signal(sweep, ended_by)
    if wants_trace or not isinstance(error, USER_ERRORS):
        raise error
    sys.exit(f"staf: {sentence(error)}")


@contextlib.contextmanager
def _told_between_lines() -> Iterator[None]:
    """End in a sentence also where a signal comes before the program has begun, or after it has ended."""
    try:
        yield
    except KeyboardInterrupt as error:
        _end_by_signal(None, error)


def _end_by_signal(sweep: DictConfig | None, error: KeyboardInterrupt) -> NoReturn:
    """Say which signal ended the program and how to resume, and exit with the code that shells expect."""
    said, code = name_and_code(error)
    with contextlib.suppress(OSError):  # the terminal may be gone
        sys.stderr.write(callbacks.farewell(sweep, error, said) + "\n")
    sys.exit(code)
