"""The tables of CHOOSING.md and CHOOSING_LAWS.md, computed again by the commands above them.

`python tests/benchmarks/choosing.py [WORD ...]` runs the commands (those that have all words), and prints for
each table how many of its numbers the runs gave again to three digits, and which they did not. Where rounding
decides, a cell is a range ("0.2 to 0.3") or a limit ("below 2e-11") for a number of the runs.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("CHOOSING.md", "CHOOSING_LAWS.md")
SHOWN = re.compile(
    r"^```text\n((?:staf [^\n]*\n)+)```\n(?:(?!```).)*?^\|([^\n]*)\n\|[-:|]+\n((?:\|[^\n]*\n)+)", re.M | re.S
)
FIGURE = r"[\d.]+(?:e[-+]?\d+)?"
CELL = re.compile(rf"^ *(?:(below) |({FIGURE}) to )?({FIGURE}) *$")
SWEPT = ("ball_error", "ultimate_excess_before")  # metrics that tables of sweeps show


def tables(page: str) -> Iterator[tuple[list[str], list[tuple[float, float]]]]:
    """Yield the commands above each table of a page, and the bounds of its cells without the labels."""
    text = (ROOT / "staf_torch" / "approximation" / page).read_text(encoding="utf-8")
    for found in SHOWN.finditer(text):
        labels = [i for i, head in enumerate(found[2].split("|")) if head.strip() == "M"]
        rows = [row.strip("|").split("|") for row in found[3].splitlines() if not row.startswith("| order")]
        cells = [cell for row in rows for i, cell in enumerate(row) if i and i not in labels]
        shown = [CELL.match(cell) for cell in cells]
        bounds = [(0.0 if cell[1] else float(cell[2] or cell[3]), float(cell[3])) for cell in shown if cell]
        yield found[1].splitlines(), bounds


def given(command: str, folder: Path) -> list[float]:
    """Run a command; return the numbers of its runs."""
    words = [
        *shlex.split(command)[1:],
        "figures=false",
        f"hydra.run.dir={folder}",
        f"hydra.sweep.dir={folder}",
    ]
    program = "from staf_torch.cli.staf import main; main()"
    ended = subprocess.run(
        [sys.executable, "-c", program, *dict.fromkeys(words)], cwd=ROOT, capture_output=True, text=True
    )
    if ended.returncode:
        raise SystemExit(f"{command}\n{ended.stderr}")
    files = sorted(folder.rglob("metrics.json"))
    assert files, command
    runs = [json.loads(file.read_text(encoding="utf-8")) for file in files]
    kept = [run if len(runs) == 1 else {name: run.get(name) for name in SWEPT} for run in runs]
    return [float(value) for run in kept for value in run.values() if isinstance(value, int | float)]


def main() -> int:
    total = again = 0
    for page in PAGES:
        for commands, wanted in tables(page):
            if not all(word in " ".join(commands) for word in sys.argv[1:]):
                continue
            with tempfile.TemporaryDirectory() as base:
                found = [
                    value for i, each in enumerate(commands) for value in given(each, Path(base) / str(i))
                ]
            lost = [
                (low, high)
                for low, high in wanted
                if not any(0.994 * low <= value <= 1.006 * high for value in found)
            ]
            total, again = total + len(wanted), again + len(wanted) - len(lost)
            print(
                f"{page}: {len(wanted) - len(lost)} of {len(wanted)}, without {lost}: {commands[0]}",
                flush=True,
            )
    print(f"all tables: {again} of {total} numbers came again")
    return 0 if again == total else 1


if __name__ == "__main__":
    sys.exit(main())
