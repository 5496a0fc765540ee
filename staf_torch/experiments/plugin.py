"""Hydra finds launchers in the package `hydra_plugins`; here it is told of ours in a bare checkout too."""

from __future__ import annotations

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
    sys.path.insert(0, folder)
    # Workers of other launchers unpickle names of `hydra_plugins` before they import this package.
    inherited = os.environ.get("PYTHONPATH", "")
    if folder not in inherited.split(os.pathsep):
        os.environ["PYTHONPATH"] = os.pathsep.join(
            filter(None, [inherited, folder, str(_PLUGINS.parents[1])])
        )
