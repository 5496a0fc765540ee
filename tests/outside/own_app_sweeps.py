"""Sweeps somebody's application under several launchers in one process: `own_app_sweeps.py APP LINES`."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import runpy
import sys
from pathlib import Path


def sweep(app: Path, line: list[str]) -> dict[str, str]:
    """One command line: what it printed and logged, and the error that ended it."""
    said, error = io.StringIO(), ""
    sys.argv = [str(app), *line]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            runpy.run_path(str(app), run_name="__main__")
        except (Exception, SystemExit) as raised:
            error = str(raised)
    logging.getLogger().handlers.clear()  # which would write to a stream that is gone
    return {"out": said.getvalue(), "error": error}


if __name__ == "__main__":
    app, lines = Path(sys.argv[1]), json.loads(sys.argv[2])
    found = [sweep(app, line) for line in lines]
    Path("said.json").write_text(json.dumps(found))
