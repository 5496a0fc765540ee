"""The command `staf`: which of its parts a command line asks for. Only what runs something imports torch."""

from __future__ import annotations

import contextlib
import difflib
import gc
import importlib
import re
import string
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir

from .. import __version__
from ..results.build import source
from ..settings import config_directory
from ..signs import Sign, printed
from ..sweeps.hydra_compat import VERSION, application, find_launcher, full_errors, is_about_settings, program

find_launcher()
_PARTS = {
    "doctor": "staf_torch.cli.doctor",
    "schema": "staf_torch.cli.schema",
    "docs": "staf_torch.cli.site.build",
}
_LINES = {
    "doctor": "staf doctor: check this machine; exit code 1 where something is wrong.",
    "schema": "staf schema [GROUP]: print the settings, or those of one group, as a JSON schema.",
    "docs": "staf docs [FOLDER [ROOM ...]]: build the site of guides and reference pages (into `site`).",
}
"""What `--help` says of each."""


def main() -> None:
    """Run the command line. What a user got wrong ends as one sentence and the exit code 1.

    `staf doctor`, `staf schema`, `staf docs` and `staf --version` are no runs, and Hydra is not asked.
    """
    words = sys.argv[1:]
    _answer(words)
    gc.disable()  # what torch makes stays: searches for garbage are a fifth of the time to load it
    with Sign("loading torch", log=False):
        from ..sweeps import callbacks
        from ..sweeps.command import command_line, end, end_by_signal
        from ..sweeps.job import Refused, execute
        from ..sweeps.workers import stopped_by_signals
    gc.freeze()
    gc.enable()
    typed = sys.argv
    try:
        with full_errors() as wants_trace, stopped_by_signals():
            try:
                argv = command_line(words)
                if is_about_settings(argv):
                    sys.argv = [typed[0], *argv]
                    _showing()
                    return
                with application(argv) as app:
                    try:
                        (app.sweep if app.is_sweep() else app.run)(execute)
                    except (Exception, KeyboardInterrupt) as error:
                        if app.begun is None:
                            raise
                        callbacks.close(app.begun)
                        end(error, wants_trace, app.begun)
            except Refused as refused:
                if wants_trace and refused.__cause__ is not None:
                    raise refused.__cause__ from None
                raise
            except (Exception, KeyboardInterrupt) as error:
                end(error, wants_trace)
            finally:
                sys.argv = typed
    except KeyboardInterrupt as error:  # where a signal comes before the program has begun, or after its end
        end_by_signal(None, error)


def _answer(words: list[str]) -> None:
    """Do what is no run, and exit: parts of their own, versions, help and settings."""
    if words == ["--version"]:
        sys.exit(print(f"staf_torch {__version__} (source {source()})"))
    if words and words[0] in _PARTS:
        if {"--help", "-h"} & set(words[1:]):
            sys.exit(print(_LINES[words[0]]))
        sys.exit(_ended(importlib.import_module(_PARTS[words[0]]).main, words[1:]))
    if words and re.fullmatch(r"[A-Za-z_]\w*", words[0]):  # Hydra's grammar would say what is missing at EOF
        sys.exit(f"staf: {_unknown(words[0])}")
    if words in (["--help"], ["-h"]):
        sys.exit(printed(f"{_help()}\n"))
    with contextlib.suppress(Exception):  # what a user got wrong, in the words of what runs something
        if not any(word.startswith("sweep.resume=") for word in words) and is_about_settings(words):
            with full_errors():
                _showing()
            sys.exit()


def _help() -> str:
    """Return the help, one screen, without Hydra, which would take half a second more."""
    folder = Path(config_directory())
    with initialize_config_dir(str(folder), "staf", **VERSION):
        config = compose("config", return_hydra_config=True)
        template = str(config.hydra.help.template)
    groups: dict[str, list[str]] = {}
    for path in sorted(folder.rglob("*.yaml")):
        group = path.parent.relative_to(folder).as_posix()
        if group.partition("/")[0] not in (".", "hydra"):
            groups.setdefault(group, []).append(path.stem)
    lines = (f"{group}: {', '.join(options)}" for group, options in sorted(groups.items()))
    wrapped = [textwrap.fill(line, 100, subsequent_indent="    ") for line in lines]
    return string.Template(template).safe_substitute(APP_CONFIG_GROUPS="\n".join(wrapped)).rstrip()


def _ended(part: Callable[[list[str]], str | int], words: list[str]) -> str | int | None:
    """Print what a command that is no run returns; return its exit code, or what to say where it cannot."""
    try:
        found = part(words)
    except ValueError as error:
        return f"staf: {error}"
    return found if isinstance(found, int) else printed(f"{found}\n")


def _unknown(word: str) -> str:
    """Return what to say of a word that is neither a command nor a setting."""
    near = difflib.get_close_matches(word, _PARTS, n=1)
    meant = f"did you mean `{near[0]}`?" if near else f"there are {', '.join(_PARTS)}."
    return f"there is no command `{word}`; {meant} A setting is written `{word}=value`."


def _execute(cfg: Any) -> Any:
    return importlib.import_module("staf_torch.sweeps.job").execute(cfg)


_showing = program(_execute)
