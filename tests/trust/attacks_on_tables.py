"""Files that `staf-table` and the page of a sweep are to show."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import socket
from pathlib import Path
from typing import Any

from arena import Arena, Attack, attack, says


@attack
def controls_beyond_escape(arena: Arena) -> Attack:
    arena.kernels("\x9b2Jx\u202egnp\u2066\x07\x7f")
    arena.failed(0, "\x9d52;c;ZWNobyBoaQ==\x9c \x1bP+q\x1b\\ \x0b\x0c\x08")
    arena.metric(1, "\u202e\x1b]0;x\x07ball")
    return arena.table()


@attack
def controls_in_the_name_of_a_job(arena: Arena) -> Attack:
    (arena.many / "0").rename(arena.many / "\x1b[2J\r\n\u202e0")
    (arena.many / "1" / "run.json").write_text("{")
    (arena.many / "1").rename(arena.many / "\x1b]0;x\x07")
    return ["staf-table", str(arena.hostile)], None


@attack
def formulas_of_every_kind(arena: Arena) -> Attack:
    arena.kernels("@SUM(1+9)", "+1+cmd|' /C calc'!A0", "-2+3+cmd|'!A0")
    for job, value in enumerate(("\t=cmd|'!A0", "\r=1+1", "\uff1d1+1")):
        arena.metric(job, value)
    arena.failed(2, " =1+1")

    def check(arena: Arena, result: Any) -> str | None:
        import csv

        rows = list(csv.reader(io.StringIO(result.text, newline="")))
        bad = [c for row in rows for c in row if re.match(r"\s*[=@\t\r\uff1d]|[+-].*[a-z|(]", c, re.S)]
        return f"cells that a spreadsheet computes: {bad}" if bad else None

    return arena.table("--format", "csv")[0], check


@attack
def tex_in_caret_notation(arena: Arena) -> Attack:
    arena.kernels(r"^^5cinput{/etc/passwd}", r"\write18{touch x}", "%\n\\input{/etc/passwd}")
    arena.failed(0, "x\n\\input{/etc/passwd}")

    def check(arena: Arena, result: Any) -> str | None:
        lines = [line.split("%")[0].replace(r"\textbackslash", "") for line in result.text.splitlines()]
        bad = [line for line in lines if "^^" in line or r"\input" in line or r"\write" in line]
        return f"TeX would run {bad}" if bad else None

    return arena.table("--format", "tex", "--rows", "kernel")[0], check


@attack
def links_and_scripts_in_markdown(arena: Arena) -> Attack:
    arena.kernels("[x](javascript:alert(1))", "![x](http://h.example/p.png)", "<img src=x onerror=alert(1)>")
    arena.metric(0, "a|b\n\n<script>alert(1)</script>\n")
    arena.failed(1, "http://h.example/?q [y]: http://h.example/")

    def check(arena: Arena, result: Any) -> str | None:
        bad = re.findall(r"(?<!\\)<(?:img|script)|(?<!\\)\]\(|(?<!\\)!\[", result.text)
        return f"Markdown lets through {bad}" if bad else None

    return arena.table("--rows", "kernel", "--metric", "ball_error")[0], check


@attack
def a_page_of_the_sweep(arena: Arena) -> Attack:
    evil = "</script></style><script>alert(1)</script><img src=x onerror=alert(1)>\"'><svg/onload=alert(1)>"
    arena.kernels(evil)
    arena.failed(0, evil)
    arena.metric(1, evil)
    (arena.many / "multirun.yaml").write_text(f"x: '{evil}'\n")

    def check(arena: Arena, result: Any) -> str | None:
        page = (arena.many / "report.html").read_text()
        bad = re.findall(r"<script>alert|<img src=x|<svg/onload", page)
        return f"report.html has {bad}" if bad else None

    return arena.resume("--trust")[0], check


@attack
def a_loop_of_links(arena: Arena) -> Attack:
    for job in range(3):
        (arena.many / str(job) / "again").symlink_to(arena.hostile)
        (arena.many / str(job) / "root").symlink_to("/")
    return ["staf-table", str(arena.hostile)], None


@attack
def files_that_are_no_files(arena: Arena) -> Attack:
    os.mkfifo(arena.many / ".lock")
    (arena.many / "0" / "metrics.json").unlink()
    with contextlib.chdir(arena.many / "0"), socket.socket(socket.AF_UNIX) as server:
        server.bind("metrics.json")  # a socket's path may have 107 bytes
    (arena.many / "1" / "run.json").unlink()
    (arena.many / "1" / "run.json").symlink_to("/dev/stdin")
    (arena.many / "2" / "metrics.json").unlink()
    os.mkfifo(arena.many / "2" / "metrics.json")
    (arena.many / "sweep.json").unlink()
    (arena.many / "sweep.json").mkdir()
    return arena.table()


@attack
def a_record_of_three_hundred_megabytes(arena: Arena) -> Attack:
    for name in ("0/run.json", "1/metrics.json", "sweep.json"):
        with (arena.many / name).open("r+b") as file:
            file.truncate(300 * 2**20)
    return arena.table()


@attack
def three_hundred_thousand_metrics(arena: Arena) -> Attack:
    for job in range(3):
        many = {f"metric_{job}_{k}": k for k in range(100_000)}
        arena.json(f"{job}/metrics.json", lambda found, many=many: found.update(many))
    return arena.table()


@attack
def twenty_thousand_folders(arena: Arena) -> Attack:
    for job in range(3, 20_003):
        (arena.many / str(job)).mkdir()
    return arena.table()


@attack
def folders_a_thousand_deep(arena: Arena) -> Attack:
    with contextlib.chdir(arena.many / "0"):
        for _ in range(1500):
            os.mkdir("d")
            os.chdir("d")
        Path("run.json").write_text("{}")
    return ["staf-table", str(arena.hostile)], None


@attack
def rows_of_every_type(arena: Arena) -> Attack:
    rows: list[Any] = [1, None, [], {}, {"overrides": {"a": 1}}, {"status": ["completed"]}]
    rows += [{"overrides": [1, None], "metrics": [1]}]
    wrong = {"number": "x", "overrides": ["seed=1"], "reason": {}, "metrics": {"ball_error": {"a": []}}}
    large = {"ball_error": 10**400, "b": "1e5", "c": True}
    rows += [{"status": "completed"} | wrong, {"number": 10**400, "overrides": "seed=1", "metrics": large}]
    lines = "".join(json.dumps(row) + ",\n" for row in rows)
    (arena.many / "0" / "rows.json").write_text(json.dumps(rows))
    (arena.many / "1" / "rows.json").write_text('{"version": "1", "rows": [\n' + lines + "]}\n")
    return arena.table()[0], says("0.3")


@attack
def numbers_of_every_type_for_jobs(arena: Arena) -> Attack:
    jobs = [
        {"num": n, "overrides": ["centers.radius=0.1"]}
        for n in ("../../victim", -1, 1e300, [], {}, None, "0\n1", True)
    ]
    arena.json("sweep.json", lambda found: found.update(jobs=jobs))
    return arena.table()


@attack
def an_override_of_a_million_commas(arena: Arena) -> Attack:
    """A table has a column a setting, and looks for what was swept among all of them."""
    many = [f"key{k}={','.join(['1'] * 50)}" for k in range(30_000)]
    arena.records(lambda found: found["overrides"].extend(many))
    for job in range(3):
        swept = dict.fromkeys((line[:9] for line in many), job)
        arena.json(f"{job}/run.json", lambda found, swept=swept: found["settings"].update(swept))
    return arena.table("--format", "csv")


@attack
def a_table_written_over_its_source(arena: Arena) -> Attack:
    """A link in the place of the file that is asked for, and a folder that leads elsewhere."""
    (arena.cwd / "table.csv").symlink_to(arena.many / "table.csv")
    for name in ("table.csv", "table.md", "report.html"):
        (arena.many / name).unlink(missing_ok=True)
        (arena.many / name).symlink_to(arena.victim / "note.txt")
    return arena.table("--format", "csv", "--output", str(arena.many / "table.csv"))
