"""Folders of runs that somebody made to do harm: each function spoils one run directory of a sweep."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from staf_torch import __version__

RECORD = {
    "version": __version__,
    "task": "gradient_chase",
    "status": "completed",
    "reason": None,
    "overrides": ["seed=7"],
    "settings": {"seed": 7, "kernel": "gaussian"},
    "seconds": 0.5,
}
ESCAPE = "\x1b]0;owned\x07\x1b[31m"
DEEP = "[" * 100_000 + "]" * 100_000


def spoiled(**changes: Any) -> Callable[[Path], None]:
    """A run of which some entries of the record are others; `metrics_json` is the text of `metrics.json`."""

    def write(run: Path) -> None:
        metrics = changes.get("metrics_json", '{"ball_error": 0.5}')
        record = {**RECORD, **{key: value for key, value in changes.items() if key != "metrics_json"}}
        (run / "run.json").write_text(json.dumps(record))
        (run / "metrics.json").write_text(metrics)

    return write


def text(name: str, content: str | bytes) -> Callable[[Path], None]:
    """A run of which one file has that content."""

    def write(run: Path) -> None:
        spoiled()(run)
        (run / name).parent.mkdir(exist_ok=True)
        (run / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return write


def link(name: str, target: str) -> Callable[[Path], None]:
    """A run of which one file is a link."""

    def write(run: Path) -> None:
        spoiled()(run)
        (run / name).unlink(missing_ok=True)
        (run / name).symlink_to(target)

    return write


def pipe(run: Path) -> None:
    """A pipe that nobody writes to, in place of the metrics."""
    spoiled()(run)
    (run / "metrics.json").unlink()
    os.mkfifo(run / "metrics.json")


def table(content: str) -> Callable[[Path], None]:
    """A table of rows."""
    return text("rows.json", content)


TABLES: dict[str, Callable[[Path], None]] = {
    "deep metrics": text("metrics.json", f'{{"ball_error": {DEEP}}}'),
    "deep record": text("run.json", DEEP),
    "a huge integer": text("metrics.json", f'{{"ball_error": 1{"0" * 400}}}'),
    "an integer of too many digits": text("metrics.json", f'{{"ball_error": 1{"0" * 6000}}}'),
    "infinity": text("metrics.json", '{"ball_error": 1e999}'),
    "metrics of lists": text("metrics.json", '{"ball_error": [1, 2], "gradient_error": {"a": 1}}'),
    "declared metrics that are a list": spoiled(metrics=["ball_error"]),
    "overrides that are numbers": spoiled(overrides=[1, None, {"a": 2}]),
    "a status that is a list": spoiled(status=["completed"]),
    "lone surrogates": spoiled(
        reason="\ud800 lone", overrides=["seed=\udfff"], settings={"\ud800": "\udc00"}
    ),
    "bytes that are no text": text("run.json", b"\xff\xfe{}"),
    "a null character": text("run.json", b"\x00" * 4096),
    "a pipe": pipe,
    "a link to a device": link("metrics.json", "/dev/zero"),
    "a link to a secret": link("metrics.json", "../../secret.json"),
    "a link that leads to itself": link("run.json", "run.json"),
    "a folder in place of a file": lambda run: (run / "run.json").mkdir(),
    "rows with num 1e999": table(
        '{"version": "1", "rows": [\n'
        '{"num": 1e999, "overrides": ["seed=1"], "status": "completed", "metrics": {}}\n]}\n'
    ),
    "rows that are cut off": table('{"version": "1", "rows": [\n{"num": 0, "status": "completed"},\n'),
    "rows on one endless line": table('{"version": "1", "rows": [\n' + "[" * (2**20 + 10)),
    "escapes for the terminal": spoiled(
        reason=ESCAPE, version=ESCAPE, task=ESCAPE, overrides=[f"seed={ESCAPE}"]
    ),
    "escapes in names": text("metrics.json", json.dumps({ESCAPE: 1.0})),
}
"""What `staf-table` must survive: other runs keep their rows, and nothing leaks, hangs or fills memory."""

CELLS = {
    "formula": "=cmd|' /C calc'!A0",
    "plus": "+1+cmd",
    "at": "@SUM(A1)",
    "tag": "<script>alert(1)</script>",
    "escaped tag": r"`a\<img src=x onerror=alert(1)>`\<img src=x>",
    "image": "![x](http://evil.example/pixel.png)",
    "reference": "[x]: http://evil.example/ 'y'",
    "code": "``<img src=http://evil.example/x>``",
    "backquotes": "` `` <b> `` `",
    "input": r"\input{/etc/passwd}",
    "bar": "a|b|c",
    "direction": "abc\u202egnp.exe",
    "terminal": ESCAPE,
}
"""Texts of settings that must arrive as texts in every format."""


def setting(lines: str, without: str = "kernel") -> Callable[[Path], None]:
    """A run whose settings have other lines for a group; `OWNED` and `EVIL` are files beside the run."""

    def write(run: Path) -> None:
        path = run / ".hydra" / "config.yaml"
        kept, inside = [], False
        for line in path.read_text().splitlines():
            inside = line.startswith(f"{without}:") or (inside and line.startswith((" ", "-")))
            kept += [] if inside else [line]
        told = lines.replace("OWNED", str(run.parent / "owned")).replace("EVIL", str(run.parent / "evil.pt"))
        path.write_text("\n".join([*kept, told]) + "\n")

    return write


def arrays(**changes: Any) -> Callable[[Path], None]:
    """A run of which some arrays of the history are others."""

    def write(run: Path) -> None:
        with np.load(run / "history.npz") as found:
            whole = {name: found[name] for name in found.files}
        np.savez(run / "history.npz", **{**whole, **changes})

    return write


def replaced(name: str, content: bytes) -> Callable[[Path], None]:
    def write(run: Path) -> None:
        (run / name).write_bytes(content)

    return write


def history_pipe(run: Path) -> None:
    (run / "history.npz").unlink()
    os.mkfifo(run / "history.npz")


def history_link(run: Path) -> None:
    (run / "history.npz").rename(run.parent / "elsewhere.npz")
    (run / "history.npz").symlink_to(run.parent / "elsewhere.npz")


CALL = "_target_: torch.load, f: EVIL, weights_only: false"
EXPORTS: dict[str, Callable[[Path], None]] = {
    "a target": setting(f"kernel: {{{CALL}}}"),
    "a target in the decoded text of another key": setting(
        f"k: '{{{CALL}}}'\nkernel: ${{oc.create:${{oc.decode:${{k}}}}}}"
    ),
    "a target behind the library's name": setting(
        "x: module.torch.load\nkernel: {_target_: 'staf_torch.${x}', f: EVIL, weights_only: false}"
    ),
    "a target through the library": setting(
        "kernel: {_target_: staf_torch.approximation.staf.torch.load, f: EVIL, weights_only: false}"
    ),
    "a function of ours that writes": setting(
        "kernel: {_target_: staf_torch.cli.table.main, _args_: [[., --output, OWNED]]}"
    ),
    "a file for a parser of C": setting("system: {_target_: staf_torch.systems.MujocoPlant, model: EVIL}"),
    "a target in a list": setting(
        f"kernel: {{_target_: staf_torch.GaussianKernel, width: [1.0, [{{{CALL}}}]]}}"
    ),
    "a task of somebody else": setting("task: os.abort", "task"),
    "a YAML bomb": setting("a0: &a0 [x, x]\na1: &a1 [*a0, *a0]"),
    "references in a circle": setting("kernel: '${x}'\nx: '${kernel}'"),
    "deep settings": setting("kernel: " + "{a: " * 200 + "1" + "}" * 200),
    "a Python object": setting("kernel: !!python/object/apply:os.system ['touch OWNED']"),
    "a pickled history": arrays(weights=np.array([[{}] * 11] * 2, dtype=object)),
    "a history of other sizes": arrays(weights=np.zeros((2, 11, 5))),
    "a history that is text": replaced("history.npz", b"PK\x05\x06"),
    "a history that is a pipe": history_pipe,
    "a history behind a link": history_link,
}
"""What `staf-export` must refuse without `--trust`, in a sentence."""
