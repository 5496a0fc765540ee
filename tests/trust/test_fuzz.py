"""Every reader of a folder of results, over files that nobody meant.

Ten thousand cases: `STAF_FUZZ=1700 pytest tests/trust/test_fuzz.py` (so many for each of six readers).
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sweep_runs import write_run

from staf_torch.results.files import UnreadableError
from staf_torch.results.reader import collect
from staf_torch.results.run_directory import History
from staf_torch.sweeps.command import command_line
from staf_torch.tables import html_text, json_text, latex_text, tabulate

RECORD = {
    "version": "0.1.0",
    "task": "gradient_chase",
    "status": "completed",
    "reason": None,
    "overrides": ["seed=7"],
    "settings": {"seed": 7, "kernel": "gaussian"},
    "seconds": 0.5,
}
CASES = int(os.environ.get("STAF_FUZZ", "10"))
fuzz = settings(max_examples=CASES, deadline=None, derandomize=CASES == 10)
ANY = st.lists(st.integers(0, 0x10FFFF).map(chr), max_size=20).map("".join)
TEXT = ANY | st.sampled_from(["completed", "ball_error", "=1", "\x1b[31m", "\ud800", "a|b", "${a}"])
NUMBER = st.floats() | st.integers() | st.integers(min_value=-(10**40), max_value=10**40)
VALUE = st.recursive(
    st.none() | st.booleans() | NUMBER | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=12,
)
OBJECT = st.dictionaries(
    st.sampled_from([*RECORD, "metrics", "files", "build", "checksum", "jobs"]) | TEXT, VALUE
)
WHOLE = {**RECORD, "build": {"source": "1"}, "files": {"metrics.json": [3, "x"]}, "checksum": "x"}


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


FILES: dict[str, st.SearchStrategy[bytes]] = {
    "run.json": OBJECT.map(lambda found: as_json({**RECORD, **found})) | changed(as_json(WHOLE)),
    "metrics.json": OBJECT.map(as_json) | changed(b'{"ball_error": 0.5, "cost": null}'),
    "rows.json": VALUE.map(lambda rows: as_json({"rows": rows}))
    | changed(b'{"version": "1", "rows": [\n{"num": 0, "status": "completed", "metrics": {}}\n]}\n'),
    "../sweep.json": OBJECT.map(as_json) | changed(b'{"jobs": [{"num": 0, "overrides": ["seed=1"]}]}'),
}


@pytest.mark.parametrize("name", FILES)
def test_no_record_costs_the_other_runs_their_rows(name: str) -> None:
    @fuzz
    @given(FILES[name])
    def check(content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            write_run(Path(folder) / "0", {"seed": 1}, {"ball_error": 0.125})
            run = write_run(Path(folder) / "1", {"seed": 2}, {"ball_error": 0.25})
            (run / name).write_bytes(content)
            table = tabulate(collect(folder))
        formats = (table.markdown(), table.csv(), latex_text(table), html_text(table), json_text(table))
        assert all("0.125" in made and "\x1b" not in made.encode().decode() for made in formats)

    check()


def test_a_history_is_read_or_refused_and_never_unpickled() -> None:
    whole = io.BytesIO()
    np.savez(whole, state=np.arange(12.0).reshape(1, 4, 3), time=np.arange(4.0))

    @fuzz
    @given(changed(whole.getvalue()) | st.binary(max_size=100))
    def check(content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "history.npz").write_bytes(content)
            with contextlib.suppress(UnreadableError):
                found = History(Path(folder) / "history.npz")
                assert all(found[name].dtype != object for name in found)

    check()


def test_a_sweep_is_resumed_or_refused() -> None:
    record = b'{"version": "0.1.0", "overrides": ["seed=1"], "hydra": [], "jobs": []}'

    @fuzz
    @given(OBJECT.map(as_json) | changed(record))
    def check(content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder, contextlib.suppress(ValueError):
            (Path(folder) / "sweep.json").write_bytes(content)
            command_line(["-m", f"sweep.resume={folder}"])

    check()
