"""Folders made to do harm: most of what `attacks.py` tries in processes of their own, here in this one."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from pathlib import Path

import attacks
import pytest
from arena import ATTACKS, SECRET, Arena
from command_line import one
from sweep_runs import write_run

from staf_torch.cli import export
from staf_torch.cli.deployable import deployable
from staf_torch.cli.table import main
from staf_torch.results.reader import collect
from staf_torch.tables import html_text, json_text, latex_text, tabulate

SHORT = ["duration=0.1", "settle_time=0", "figures=false", "seed=3"]
MAINS: dict[str, Callable[[list[str]], int | None]] = {"staf-table": main, "staf-export": export.main}
COMPILED = "a_name_that_ends_an_include_in_c", "a_name_that_speaks"
TRIED = """
target_through_a_module_of_ours a_partial_of_os_system a_target_within_a_list_argument a_python_tag_in_yaml
a_target_among_positional_arguments a_target_of_ones_own_beside_the_run a_task_that_is_a_path
metric_tracker_and_predictor text_where_a_number_belongs the_environment_in_a_setting pickles_in_the_history
a_history_whose_header_is_a_program an_environment_whose_id_names_a_module a_secret_as_a_model_of_mujoco
slopes_that_are_a_call a_plant_within_a_barrier keys_merged_into_a_target interpolations_that_double
controls_beyond_escape controls_in_the_name_of_a_job formulas_of_every_kind tex_in_caret_notation
links_and_scripts_in_markdown a_loop_of_links files_that_are_no_files rows_of_every_type
numbers_of_every_type_for_jobs a_table_written_over_its_source
"""  # by `staf-table` and `staf-export`, without those that take memory or time, or cannot be removed


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and a sweep of three, that mean no harm."""
    folder = tmp_path_factory.mktemp("honest")
    sweep = ["-m", "centers.radius=0.1,0.2,0.3", f"hydra.sweep.dir={folder}/many"]
    for line in ([f"hydra.run.dir={folder}/one"], sweep):
        code, _, err = one(str(folder), [*line, *SHORT])
        assert code == 0, err
    return folder


@pytest.fixture
def arena(honest: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Arena:
    found = Arena(tmp_path / "arena")
    found.lay_out(honest)
    monkeypatch.chdir(found.cwd)
    monkeypatch.syspath_prepend(str(found.cwd))
    monkeypatch.setenv("STAF_SECRET", SECRET)
    return found


@pytest.mark.parametrize(
    "name", [*TRIED.split(), *(pytest.param(name, marks=pytest.mark.needs_compiler) for name in COMPILED)]
)
def test_no_hostile_folder_reaches_anything(
    name: str, arena: Arena, capfd: pytest.CaptureFixture[str]
) -> None:
    (command, *words), check = ATTACKS[name](arena)
    before = attacks.snapshot(arena.root, (arena.hostile, arena.cwd))
    try:
        code, said = MAINS[command](words) or 0, ""
    except SystemExit as ended:
        code, said = 1, str(ended)
    result = attacks.Outcome(code, "".join((*capfd.readouterr(), said)), 0.0, 0, waited=False)
    assert attacks.verdict(arena, before, result, result, check, large=False) == []


def test_trust_builds_what_the_settings_name(arena: Arena) -> None:
    ATTACKS["target_through_a_module_of_ours"](arena)
    with pytest.raises(ValueError, match=r"\w"):
        deployable(arena.one)
    assert not (arena.victim / "PWNED").exists()
    with pytest.raises(ValueError, match=r"\w"):
        deployable(arena.one, trust=True)  # runs, and finds no kernel
    assert (arena.victim / "PWNED").exists()


CELLS = {  # texts of settings that must arrive as texts in every format
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
    "terminal": "\x1b]0;owned\x07\x1b[31m",
}


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
    tags = set(re.findall(r"<(\w+)", html_text(table)))
    assert tags <= {"table", "thead", "tbody", "tr", "th", "td", "b", "p"}
    assert r"\input" not in latex_text(table)
    text = table.markdown()
    assert not set(text) & {"\x1b", "\x07", "\u202e"}
    # Behind an odd number of backslashes nothing is a tag, a link or an image, in a code span or not.
    assert re.findall(r"(?<!\\)(?:\\\\)*(?:<|\]\(|\]:|\]\[)", text) == [], text
    assert len({line.replace(r"\|", "").count("|") for line in text.splitlines() if line[:1] == "|"}) == 1


def test_a_number_in_a_list_that_is_none_costs_no_table(tmp_path: Path) -> None:
    for number, value in enumerate(([1.0], [1e999], [1.0, [-1e999]], "[1e999]")):
        write_run(tmp_path / str(number), {"initial_state": value}, {"ball_error": 0.125})
    assert json_text(tabulate(collect(tmp_path))).count("0.125") == 4
