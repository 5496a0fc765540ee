"""Every reader of a folder of results, over files that nobody meant.

Ten thousand cases: `STAF_FUZZ=1700 pytest tests/trust/test_fuzz.py` (so many for each of six readers). No
case may take five seconds, start a process, import a module from where the files are, or write elsewhere.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_runs import RECORD
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_runs import write_run

from staf_torch.results.reader import collect
from staf_torch.results.run_directory import History
from staf_torch.results.untrusted import UnreadableError
from staf_torch.sweeps.resume import command_line
from staf_torch.tables import html_text, json_text, latex_text, tabulate

CASES = int(os.environ.get("STAF_FUZZ", "25"))
fuzz = settings(max_examples=CASES, deadline=None, derandomize=CASES == 25)
TEXT = st.text(max_size=20) | st.sampled_from(
    ["completed", "ball_error", "=1", "\x1b[31m", "\ud800", "a|b", "${a}"]
)
NUMBER = st.floats() | st.integers() | st.integers(min_value=-(10**40), max_value=10**40)
VALUE = st.recursive(
    st.none() | st.booleans() | NUMBER | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)
OBJECT = st.dictionaries(
    st.sampled_from([*RECORD, "metrics", "files", "build", "checksum", "jobs"]) | TEXT, VALUE
)


SECONDS, WAIT = 5.0, 60.0  # s of computing, and of waiting, that a case may take
FORBIDDEN = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect", "ctypes.dlopen")
WATCHED: list[str] = []  # folders of the cases that are running


SEEN: list[str] = []  # what they did that no reader does; a reader may swallow an exception


def _watch(event: str, arguments: tuple[Any, ...]) -> None:
    if not WATCHED:
        return
    writes = event == "open" and isinstance(arguments[0], str) and "w" in str(arguments[1])
    elsewhere = writes and not arguments[0].startswith(WATCHED[-1])
    foreign = event == "import" and str(arguments[1]).startswith(WATCHED[-1])
    if event in FORBIDDEN or elsewhere or foreign:
        SEEN.append(f"{event} {arguments}")
        raise RuntimeError(SEEN[-1])


sys.addaudithook(_watch)


@contextlib.contextmanager
def case() -> Iterator[str]:
    """A folder for one case; what is done in there is watched, and has five seconds of CPU time."""

    def late(*_: object) -> None:
        SEEN.append(f"more than {SECONDS} s of computing, or {WAIT} s")
        raise RuntimeError(SEEN[-1])

    with tempfile.TemporaryDirectory() as folder:
        before = {number: signal.signal(number, late) for number in (signal.SIGALRM, signal.SIGPROF)}
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.setitimer(signal.ITIMER_REAL, WAIT)
        WATCHED.append(folder)
        try:
            yield folder
        finally:
            WATCHED.pop()
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.setitimer(signal.ITIMER_REAL, 0)
            for number, handler in before.items():
                signal.signal(number, handler)
            seen, SEEN[:] = list(SEEN), []
        assert not seen, seen


def changed(content: bytes) -> st.SearchStrategy[bytes]:
    """A file with some bytes replaced, cut out or put in."""

    def edit(edits: list[tuple[int, int, bytes]]) -> bytes:
        found = content
        for at, length, new in edits:
            at %= len(found) + 1
            found = found[:at] + new + found[at + length :]
        return found

    where = st.tuples(st.integers(0, len(content)), st.integers(0, 8), st.binary(max_size=8))
    return st.lists(where, min_size=1, max_size=4).map(edit)


def as_json(value: Any) -> bytes:
    return json.dumps(value).encode()


def whole_record() -> dict[str, Any]:
    return {
        **RECORD,
        "build": {"source": "1", "modules": {}},
        "files": {"metrics.json": [3, "x"]},
        "checksum": "x",
    }


FILES: dict[str, st.SearchStrategy[bytes]] = {
    "run.json": OBJECT.map(lambda found: as_json({**RECORD, **found})) | changed(as_json(whole_record())),
    "metrics.json": OBJECT.map(as_json) | changed(b'{"ball_error": 0.5, "cost": null}'),
    "members.json": VALUE.map(lambda rows: as_json({"members": rows}))
    | changed(
        b'{"version": "1", "members": [\n{"num": 0, "status": "completed", "metrics": {"a": 1.0}}\n]}\n'
    ),
    "../sweep.json": OBJECT.map(as_json) | changed(b'{"jobs": [{"num": 0, "overrides": ["seed=1"]}]}'),
}


@pytest.mark.parametrize("name", FILES)
def test_no_record_costs_the_other_runs_their_rows(name: str) -> None:
    @fuzz
    @given(FILES[name])
    def check(content: bytes) -> None:
        with case() as folder:
            write_run(Path(folder) / "0", {"seed": 1}, {"ball_error": 0.125})
            run = write_run(Path(folder) / "1", {"seed": 2}, {"ball_error": 0.25})
            (run / name).write_bytes(content)
            found = collect(folder)
            assert any(row.metrics.get("ball_error") == 0.125 for row in found.rows)
            table = tabulate(found)
            for made in (
                table.markdown(),
                table.csv(),
                latex_text(table),
                html_text(table),
                json_text(table),
            ):
                assert "0.125" in made
                assert "\x1b" not in made.encode().decode()

    check()


def archive() -> bytes:
    found = io.BytesIO()
    np.savez(found, state=np.arange(12.0).reshape(1, 4, 3), time=np.arange(4.0))
    return found.getvalue()


def test_a_history_is_read_or_refused() -> None:
    @fuzz
    @given(changed(archive()) | st.binary(max_size=100))
    def check(content: bytes) -> None:
        with case() as folder:
            (Path(folder) / "history.npz").write_bytes(content)
            with contextlib.suppress(UnreadableError):
                found = History(Path(folder) / "history.npz")
                for name in found:
                    assert found[name].dtype != object

    check()


def test_a_sweep_is_resumed_or_refused() -> None:
    @fuzz
    @given(
        OBJECT.map(as_json)
        | changed(b'{"version": "0.1.0", "overrides": ["seed=1"], "hydra": [], "jobs": []}')
    )
    def check(content: bytes) -> None:
        with case() as folder:
            (Path(folder) / "sweep.json").write_bytes(content)
            try:
                command_line(["-m", f"sweep.resume={folder}"])
            except ValueError:
                return

    check()
