"""Hydra finds launchers in the package `hydra_plugins`; here it is told of ours in a bare checkout too."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

_PLUGINS = Path(__file__).resolve().parent.parent / "plugins"


def find_launcher() -> None:
    """Put this package's own `hydra_plugins` before any other, also for processes that begin later.

    In a wheel it lies at the top level too, for programs that do not import this module; an editable install
    has a copy there, which may be of another day.
    """
    folder = str(_PLUGINS)
    if folder in sys.path:
        return
    installed = _is_installed()
    sys.path.insert(0, folder)
    if installed:
        return
    # A bare checkout: workers of other launchers unpickle names of `hydra_plugins` before they import us.
    inherited = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [inherited, folder, str(_PLUGINS.parents[1])]))


def _is_installed() -> bool:
    try:
        return importlib.util.find_spec("hydra_plugins.staf_batched") is not None
    except ModuleNotFoundError:  # there is no `hydra_plugins` at all
        return False
