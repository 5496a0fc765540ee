"""Folders made to do harm: `staf-table` spares the other runs, `staf-export` runs nothing of theirs."""

from __future__ import annotations

import csv
import io
import json
import pickle
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch
from composing import settings
from hostile_runs import CELLS, EXPORTS, TABLES
from omegaconf import OmegaConf
from sweep_runs import write_run

from staf_torch.cli.deployable import deployable
from staf_torch.cli.export import export
from staf_torch.cli.table import main
from staf_torch.deploy import data_sheet
from staf_torch.experiments.registry import experiment
from staf_torch.results.reader import collect
from staf_torch.sweeps.hydra_compat.inside import HAS_WHITELIST
from staf_torch.tables import html_text, json_text, latex_text, tabulate

# `staf-table`


@pytest.mark.parametrize("name", TABLES)
def test_no_hostile_run_costs_the_others_their_rows(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "secret.json").write_text('{"secret": 42.0}')
    folder = tmp_path / "runs"
    write_run(folder / "0", {"seed": 1}, {"ball_error": 0.125})
    (folder / "1").mkdir()
    TABLES[name](folder / "1")
    (folder / "1" / "²").mkdir(exist_ok=True)
    write_run(folder / "2", {"seed": 2}, {"ball_error": 0.25})
    for line in ([], ["--format", "csv"]):
        assert main([str(folder), *line]) == 0
        out, err = capsys.readouterr()
        assert "0.125" in out
        assert "0.25" in out
        assert "42.0" not in out
        assert not set(out + err) & {"\x1b", "\x07", "\x00"}


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


@pytest.mark.parametrize("setting", [[1e999], [1.0, [-1e999]], "[1e999]"])
def test_a_number_in_a_list_that_is_none_costs_no_table(setting: object, tmp_path: Path) -> None:
    for number, value in enumerate(([1.0], setting)):
        write_run(tmp_path / str(number), {"initial_state": value}, {"ball_error": 0.125})
    assert json_text(tabulate(collect(tmp_path))).count("0.125") == 2


# `staf-export`


class Evil:
    """Leaves a file when it is unpickled."""

    def __init__(self, victim: Path) -> None:
        self.victim = victim

    def __reduce__(self) -> Any:
        return Path.touch, (self.victim,)


@pytest.fixture(scope="module")
def chase(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "chase"
    cfg = settings("centers.count=6", "duration=0.1", "trajectories=2", "figures=false")
    (run / ".hydra").mkdir(parents=True)
    OmegaConf.save(cfg, run / ".hydra" / "config.yaml")
    experiment(cfg.task)(cfg, run)
    return run


@pytest.fixture
def run(chase: Path, tmp_path: Path) -> Path:
    torch.save(Evil(tmp_path / "owned"), tmp_path / "evil.pt", pickle_module=pickle)
    return Path(shutil.copytree(chase, tmp_path / "run"))


@pytest.mark.parametrize("name", EXPORTS)
def test_a_hostile_run_is_refused_in_a_sentence(name: str, run: Path, tmp_path: Path) -> None:
    EXPORTS[name](run)
    with pytest.raises(ValueError, match=r"\w") as refused:
        deployable(run)
    assert not (tmp_path / "owned").exists()
    assert "Error" not in str(refused.value).partition("(")[0]


def test_the_file_that_would_be_unpickled_does_harm(run: Path, tmp_path: Path) -> None:
    torch.load(tmp_path / "evil.pt", weights_only=False)
    assert (tmp_path / "owned").exists()


@pytest.mark.parametrize("name", ["a target", "a target in the decoded text of another key"])
def test_trust_builds_what_the_settings_name(name: str, run: Path, tmp_path: Path) -> None:
    if HAS_WHITELIST and "decoded" in name:
        pytest.skip("Hydra 1.4.0rc3 cannot copy a node that an interpolation makes")
    EXPORTS[name](run)
    with pytest.raises(ValueError, match=r"\w"):
        deployable(run, trust=True)  # runs, and finds no kernel
    assert (tmp_path / "owned").exists()


@pytest.mark.needs_compiler
def test_the_name_of_a_folder_is_neither_c_nor_told_to_the_terminal(run: Path, tmp_path: Path) -> None:
    evil = "__attribute__((constructor)) static void evil(void)"
    (tmp_path / "x").write_text(
        f'int system(const char *); {evil} {{ system("touch {tmp_path}/owned"); }}\nvoid staf() {{}}\n'
    )
    moved = tmp_path / 'x"\n#pragma \x1b[2J'
    run.rename(moved)
    page = data_sheet.markdown(export(moved, "c", calls=10))
    assert not (tmp_path / "owned").exists()
    assert "\x1b" not in page
    assert "pragma" in page
