"""Runs command lines of the three programs in one process: `python commands.py JOBS RESULTS`."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
import sys
from pathlib import Path


def run(line: str) -> tuple[int, str]:
    """One command line, in the working directory: exit code, and output and errors together."""
    from command_line import one

    program, *arguments = shlex.split(line)
    if program == "staf":
        code, out, err = one(str(Path.cwd()), arguments)
        return code, out + err
    if program == "staf-table":
        from staf_torch.cli.table import main
    else:
        from staf_torch.cli.export import main
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            return int(main(arguments) or 0), said.getvalue()
        except SystemExit as end:
            return 1, said.getvalue() + str(end)


if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parent.parent), str(Path.cwd())]
    lines = json.loads(Path(sys.argv[1]).read_text())
    Path(sys.argv[2]).write_text(json.dumps([run(line) for line in lines]))
