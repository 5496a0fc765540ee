"""`staf-table` over folders that somebody made to do harm: one bad run never costs the others."""

from __future__ import annotations

import base64
import csv
import io
import json
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from command_line import environment
from hostile_runs import CELLS, TABLES
from sweep_runs import write_run

from staf_torch import read_runs
from staf_torch.cli.table import main
from staf_torch.results.reader import collect
from staf_torch.tables import html_text, json_text, latex_text, tabulate

MEMORY = 500 * 2**20
LIMITED = """
import io, json, contextlib, resource, sys
from staf_torch.cli.table import main
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
hard = resource.getrlimit(resource.RLIMIT_CPU)[1]  # which nobody may raise
resource.setrlimit(resource.RLIMIT_CPU, (100 if hard < 0 else min(100, hard), hard))
found = {}
for folder in sys.argv[2:]:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([folder, "--format", "csv"]) or main([folder])
    found[folder] = code, out.getvalue(), err.getvalue()
print(json.dumps(found))
"""


def test_no_hostile_run_costs_the_others_their_rows(tmp_path: Path) -> None:
    folders = {name: tmp_path / str(number) for number, name in enumerate(TABLES)}
    (tmp_path / "secret.json").write_text('{"secret": 42.0}')
    for name, folder in folders.items():
        write_run(folder / "0", {"seed": 1}, {"ball_error": 0.125})
        (folder / "²").mkdir()
        (folder / "1").mkdir()
        TABLES[name](folder / "1")
        (folder / "1" / "²").mkdir(exist_ok=True)
        write_run(folder / "2", {"seed": 2}, {"ball_error": 0.25})
    line = [sys.executable, "-c", LIMITED, str(MEMORY), *map(str, folders.values())]
    ended = subprocess.run(line, env=environment(), capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    for name, folder in folders.items():
        code, out, err = found[str(folder)]
        assert code == 0, (name, err)
        assert "0.125" in out, name
        assert "0.25" in out, name
        assert "42.0" not in out, name
        assert not set(out + err) & {"\x1b", "\x07", "\x00"}, name
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize(
    "content", ["[1]", '{"jobs": 3}', '{"jobs": [1]}', '{"jobs": [{"overrides": 3}]}', "{"]
)
def test_a_spoiled_list_of_jobs_costs_no_row(content: str, tmp_path: Path) -> None:
    write_run(tmp_path / "0", {"seed": 1}, {"ball_error": 0.125})
    (tmp_path / "sweep.json").write_text(content)
    found = collect(tmp_path)
    assert len(found.rows) == 1
    assert len(found.skipped) == 1


class Tags(HTMLParser):
    """Collect the tags of a page, without those of a table."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.found += [tag] * (tag not in ("table", "thead", "tbody", "tr", "th", "td", "b", "p"))


@pytest.mark.parametrize("name", CELLS)
def test_texts_arrive_as_texts_in_every_format(name: str, tmp_path: Path) -> None:
    nasty = CELLS[name]
    for num, value in enumerate((nasty, "plain")):
        write_run(tmp_path / str(num), {"kernel": value}, {"ball_error": 1.0})
    write_run(tmp_path / "2", {"kernel": "x"}, None, status="failed", reason=nasty)
    table = tabulate(collect(tmp_path))
    (row, *_) = csv.DictReader(io.StringIO(table.csv()))
    assert row["kernel"].lstrip("'")[:3] == json.loads(
        json.dumps(nasty[:3] if name != "terminal" else r"\u0")
    )
    assert not row["kernel"].startswith(("=", "+", "-", "@", "\t"))
    tags = Tags()
    tags.feed(html_text(table))
    assert tags.found == []
    assert r"\input" not in latex_text(table)
    text = table.markdown()
    assert not set(text) & {"\x1b", "\x07", "\u202e"}
    assert rendered(text) == [], text
    assert len({line.replace(r"\|", "").count("|") for line in text.splitlines() if line[:1] == "|"}) == 1


def rendered(markdown: str) -> list[str]:
    """Tags, links and images that a reader of Markdown would see, by CommonMark's rules for one line each."""
    found = []
    for line in markdown.splitlines():
        at = 0
        while at < len(line):
            if line[at] == "\\":
                at += 2
                continue
            if line[at] == "`":
                run = len(line[at:]) - len(line[at:].lstrip("`"))
                close = next(
                    (
                        k
                        for k in range(at + run, len(line))
                        if line[k : k + run] == "`" * run
                        and line[k - 1] != "`"
                        and line[k + run : k + run + 1] != "`"
                    ),
                    None,
                )
                at = at + run if close is None else close + run
                continue
            if line[at] == "<" or line[at : at + 2] in ("](", "]:", "]["):
                found.append(line[at:])
            at += 1
    return found


def test_the_command_writes_a_table_through_no_link(tmp_path: Path) -> None:
    write_run(tmp_path / "0", {"seed": 1}, {"ball_error": 0.125})
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / ".table.md.partial").symlink_to(victim)
    (tmp_path / "table.md").symlink_to(victim)
    assert main([str(tmp_path), "--output", str(tmp_path / "table.md")]) == 0
    assert victim.read_text() == "mine"
    assert "0.125" in (tmp_path / "table.md").read_text()


def test_no_name_of_a_folder_reaches_the_terminal_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, name in enumerate(("0", "\x1b[2J\u202e", "\x1b]0;x\x07")):
        write_run(tmp_path / name, {"seed": number}, {"ball_error": 0.1 * number}, version=f"0.0.{number}")
    (tmp_path / "\x1b]0;x\x07" / "run.json").write_text("{")
    for line in ([], ["--rows", "seed"], ["--format", "csv"]):
        assert main([str(tmp_path), *line]) == 0
        said = "".join(capsys.readouterr())
        assert not set(said) & {"\x1b", "\x07", "\u202e"}


def test_no_space_hides_a_formula_from_the_table_and_none_is_computed(tmp_path: Path) -> None:
    for number, value in enumerate((" =1+1", "\uff1d1+1", "\t@x", "plain")):
        write_run(tmp_path / str(number), {"kernel": value}, {"ball_error": 0.1})
    rows = csv.DictReader(io.StringIO(tabulate(collect(tmp_path)).csv()))
    assert [row["kernel"][0] for row in rows] == ["'", "'", "'", "p"]


def test_a_notebook_shows_no_picture_from_behind_a_link(tmp_path: Path) -> None:
    run = write_run(tmp_path / "0", {"seed": 1}, {"ball_error": 0.1})
    (run / "figures").mkdir()
    (tmp_path / "secret").write_bytes(b"secret")
    (run / "figures" / "a.png").symlink_to(tmp_path / "secret")
    (run / "figures" / "b.png").write_bytes(b"picture")
    shown = read_runs(run)[0]._repr_html_()
    assert base64.b64encode(b"picture").decode() in shown
    assert base64.b64encode(b"secret").decode() not in shown


@pytest.mark.parametrize("setting", [[1e999], [1.0, [-1e999]], "[1e999]"])
def test_a_number_in_a_list_that_is_none_costs_no_table(setting: object, tmp_path: Path) -> None:
    for number, value in enumerate(([1.0], setting)):
        write_run(tmp_path / str(number), {"initial_state": value}, {"ball_error": 0.125})
    assert json_text(tabulate(collect(tmp_path))).count("0.125") == 2
