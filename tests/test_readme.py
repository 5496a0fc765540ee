"""The manuals: Python blocks run, and commands of guides; links lead somewhere, what they name exists.

Blocks that are only shown are marked ```py or ```text. A number that was measured has a unit of time, memory
or share, is a power of ten, or is an error, cost or ratio with decimals; settings stand in backquotes. Its
section names the command that gives it, or the page prints it when it runs. Where a part of the benchmarks is
named beside it (`python -m tests.benchmarks PART`), it is a row of that part, to the digits shown.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import guides
import pytest
from benchmarks.__main__ import KEPT, PARTS, TABLE, markdown
from command_line import ROOT
from composing import settings
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from staf_torch import __version__
from staf_torch.cli import export, table
from staf_torch.cli.staf import main as main  # its import registers the launcher of `staf -m`
from staf_torch.lanes.compilation import compiler

README = ROOT / "README.md"
MANUALS = sorted(
    path
    for folder in ("conf", "runs", "staf_torch", "tests")
    for path in (ROOT / folder).rglob("*.md")
    if folder != "runs" or path.parent.name == "runs"  # below it lie what experiments left
)
PAGES = [README, ROOT / "CHANGELOG.md", *MANUALS]
TEST = re.compile(r"^def (test_\w+)", re.MULTILINE)
EXTRAS = {"optuna": "optuna_sweeper", "joblib": "joblib_launcher", "ray": "ray_launcher"}
EXTRAS["submitit_local"] = EXTRAS["submitit_slurm"] = "submitit_launcher"


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def test_citation_is_of_this_version_and_names_the_paper() -> None:
    citation = OmegaConf.create(read(ROOT / "CITATION.cff"))
    assert citation.version == __version__
    assert "State Following (StaF)" in citation["preferred-citation"].title
    assert f"version = {{{__version__}}}" in read(README)


# --- Python -------------------------------------------------------------------------------------------------


def asked(path: Path) -> object:
    """A page, whose chases are compiled where it has long ones."""
    long = path in (README, ROOT / "staf_torch" / "sweeps" / "README.md") or path.parent == guides.GUIDES
    marks = [pytest.mark.compiled] if long else []
    return pytest.param(path, marks=marks, id=name(path))


@pytest.mark.parametrize(
    "path", [asked(p) for p in [README, *MANUALS] if any(guides.blocks(read(p), ("python",)))]
)
def test_blocks_of_a_page_run_one_after_another(
    path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if path.parent.name == "deploy" and not compiler.compiler():
        pytest.skip("its C is compiled")
    if path.stem == "plant_to_c" and not shutil.which("gcc"):
        pytest.skip("its C is compiled")
    guides.run_page(read(path), name(path), guides.KINDS if path in guides.guides() else ("python",))
    assert unfounded(read(path), capsys.readouterr().out) == []
    if path not in guides.guides():
        return
    assert (tmp_path / f"{path.stem}.png").exists(), "a guide ends with a picture that its reader gets"
    assert f"](pictures/{path.stem}.webp)" in read(path)
    assert "runs in plain torch" not in caplog.text


# --- the front page -----------------------------------------------------------------------------------------


def test_examples_stand_side_by_side_within_the_column() -> None:
    """GitHub's is 830 pixels where the window is 1280: 8.2 a character of code, 118 around two blocks."""
    (cells,) = re.findall(r"^<table>.*?^.*</table>$", read(README), re.DOTALL | re.MULTILINE)
    widest = [max(map(len, block.splitlines())) for _, _, block in guides.blocks(cells, ("python",))]
    assert len(widest) == 2
    assert 8.2 * sum(widest) + 118 <= 830


def test_every_manual_is_reached_from_the_front_page() -> None:
    reached, waiting = set(), [README]
    while waiting:
        page = waiting.pop()
        reached.add(page)
        linked = (target for target, _ in links(page) if target.suffix == ".md" and target.exists())
        waiting += [target for target in linked if target not in reached]
    assert {name(path) for path in PAGES} - {name(path) for path in reached} == set()


# --- links --------------------------------------------------------------------------------------------------


def without_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def links(path: Path) -> Iterator[tuple[Path, str]]:
    """File and anchor of every link that is no address."""
    for target in re.findall(r"\]\(([^()\s]+)\)", without_blocks(read(path))):
        if "://" not in target and not target.startswith("mailto:"):
            file, _, anchor = target.partition("#")
            yield ((path.parent / file).resolve() if file else path), anchor


def anchors(path: Path) -> set[str]:
    """Those that a heading gets: lower case, no punctuation, a hyphen a space."""
    headings = re.findall(r"^#+ (.*)$", without_blocks(read(path)), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_links_of_all_pages_lead_somewhere() -> None:
    for path in PAGES:
        missing = [str(target) for target, _ in links(path) if not target.exists()]
        assert missing == [], name(path)
        lost = [f"{file}#{anchor}" for file, anchor in links(path) if anchor and anchor not in anchors(file)]
        assert lost == [], name(path)


def test_files_and_tests_that_pages_name_exist() -> None:
    written = {test for file in (ROOT / "tests").rglob("test_*.py") for test in TEST.findall(read(file))}
    for path in (README, *MANUALS):
        text = re.sub(r"\]\([^()]*\)", "", read(path))  # links have a test of their own
        named = re.findall(r"\b((?:tests|conf|staf_torch)/[\w./]*\w\.(?:py|md|yaml))\b", text)
        assert [file for file in named if not (ROOT / file).exists()] == [], name(path)
        assert set(re.findall(r"`(test_\w+)`", text)) - written == set(), name(path)


# --- commands -----------------------------------------------------------------------------------------------


def commands(text: str, program: str) -> list[str]:
    """Command lines of a program: in `code` of the text, and in blocks for the terminal."""
    text = re.sub(r"\\\n\s*", "", text)  # lines that go on
    blocks = re.findall(r"^```(?:text|bash)?\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    inline = [" ".join(found.split()) for found in re.findall(r"`([^`]+)`", without_blocks(text))]
    lines = [re.sub(r"(^|\s)#.*", "", line) for block in blocks for line in block.splitlines()]
    lines = [part for line in lines for part in line.split("&&")] + inline
    own = ("--config-dir", "-cd ", "hydra.searchpath")  # settings from a folder of the reader's own
    start = re.compile(rf"{program}{'' if program[-1] in './' else ' '}(?!=)")
    return [line.strip() for line in lines if start.match(line.strip()) and not any(o in line for o in own)]


def overrides(command: str) -> list[str]:
    """Those of a `staf` command, without flags, what is left to the reader, and extras that are not here."""
    words = [word for word in shlex.split(command)[1:] if not word.startswith("-") and word != "..."]
    words = [word for word in words if "<" not in word]
    for word in list(words):
        group, _, choice = word.partition("=")
        plugin = EXTRAS.get(choice) if group in ("hydra/launcher", "hydra/sweeper") else None
        if plugin is not None and importlib.util.find_spec(f"hydra_plugins.hydra_{plugin}") is None:
            prefix = group.replace("/", ".") + "."
            words = [w for w in words if w != word and not w.startswith(prefix)]
    return words


def job(words: list[str]) -> list[str]:
    """Plain overrides: of every sweep the first value. Each choice of a group that is swept is a file."""
    plain = []
    for word, override in zip(words, OverridesParser.create().parse_overrides(words), strict=True):
        key, folder = override.get_key_element(), ROOT / "conf" / override.key_or_group
        if not override.is_sweep_override():
            plain.append(word)
        elif override.is_discrete_sweep():
            first, *others = itertools.islice(override.sweep_string_iterator(), 100)
            plain.append(f"{key}={first}")
            assert not folder.is_dir() or all((folder / f"{each}.yaml").is_file() for each in others), word
        else:
            plain.append(f"{key}={override.value().start}")
    return plain


STAF = {command: name(path) for path in [README, *MANUALS] for command in commands(read(path), "staf")}


@pytest.mark.parametrize(
    "command",
    [
        line for line in STAF if not line.startswith(("staf doctor", "staf schema", "staf docs", "staf -sc "))
    ],  # no settings
    ids=lambda command: command.replace("::", ":"),
)
def test_settings_of_a_command_compose(command: str) -> None:
    assert OmegaConf.select(settings(*job(overrides(command))), "task"), STAF[command]


@pytest.mark.parametrize(("program", "main"), [("staf-table", table.main), ("staf-export", export.main)])
def test_options_of_the_other_programs_exist(
    program: str, main: Callable[[list[str]], object], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    known = set(re.findall(r"--[\w-]+", capsys.readouterr().out))
    lines = [(path, line) for path in [README, *MANUALS] for line in commands(read(path), program)]
    assert lines
    for path, line in lines:
        used = {word for word in line.split() if word.startswith("--")}
        assert used <= known, f"{name(path)}: {line}"


# --- numbers ------------------------------------------------------------------------------------------------

FIGURE = r"(?<![\w.^/-])-?(?:\d+(?:\.\d+)?|\.\d+)(?:e[-+]?\d+)?"
UNIT = re.compile(
    rf"({FIGURE})(?:\s*%(?!\s(?:interval|band))|\s(?:us|µs|microseconds|ms|s|CPU-s|[KMG]i?B|G|times\sas)(?!\w))"
)
POWER = re.compile(r"(?<![\w.^])\d+(?:\.\d+)?e[-+]?\d+")
JUDGED = re.compile(r"\b(?:errors?|excess|costs?|rms|return|ratio|optimum)\b")
CELL = re.compile(r"(?<=\|) *\**(\d*\.\d+(?:e[-+]?\d+)?)\** *(?=\|)")
PROGRAMS = ("staf", "staf-table", "staf-export", "python tests/", "python -m tests.", "pytest")


def measured(text: str) -> list[str]:
    """Numbers of a paragraph or table that were measured."""
    text = re.sub(r"\]\([^)]*\)|`[^`]*`|\$[^$]*\$|^!\[.*$|^#.*$", "]", text, flags=re.MULTILINE)
    found = UNIT.findall(text) + POWER.findall(text) + CELL.findall(text)
    for sentence in re.split(r"(?<=[.;:?])\s|\|", text):
        if JUDGED.search(sentence):
            found += [each for each in re.findall(FIGURE, sentence) if "." in each]
    return list(dict.fromkeys(found))


def figures(text: str) -> list[float]:
    return [float(each) for each in re.findall(FIGURE, text)]


def stands_in(shown: str, values: list[float]) -> bool:
    """Whether one of the values is the number, to the digits shown and but for its sign."""
    digits, _, power = shown.lstrip("-").partition("e")
    whole, _, part = digits.partition(".")
    last = len(whole) - len(whole.rstrip("0")) if not part and float(digits) else -len(part)
    half = 0.5000001 * 10.0 ** (last + int(power or 0))
    return any(abs(abs(value) - abs(float(shown))) <= half for value in values)


def sections(text: str) -> list[str]:
    marked = re.sub(r"^```.*?^```$", lambda block: block[0].replace("\n#", "\n\0#"), text, flags=re.S | re.M)
    return [part.replace("\0", "") for part in re.split(r"^(?=#+ )", marked, flags=re.MULTILINE)]


def rows(parts: list[str]) -> list[float]:
    """Numbers of parts of the benchmarks page; times also in ms, shares in %."""
    kept = json.loads(read(KEPT))
    claims = [(claim, float(value)) for part in parts for claim, value in kept[part]["numbers"].items()]
    scale = {"us": 1e-3, "share": 100}
    return [
        value * each
        for claim, value in claims
        for each in (1, *(scale[word] for word in re.findall(r"\w+", claim) if word in scale))
    ]


def unfounded(text: str, printed: str = "") -> list[str]:
    """Measured numbers of a page that neither a command of their section nor what the page prints gives."""
    found, given = [], figures(printed)
    for section in sections(text):
        lines = [line for program in PROGRAMS for line in commands(section, program)]
        named = any(not line.startswith("python -m tests.benchmarks") for line in lines)
        for block in re.split(r"\n\s*\n", without_blocks(section)):
            lines = commands(block, "python -m tests.benchmarks")
            parts = [word for line in lines for word in line.split() if word in PARTS]
            if parts or not named:
                values = rows(parts) if parts else given
                found += [each for each in measured(block) if not stands_in(each, values)]
    return found


@pytest.mark.parametrize(
    "path",
    [p for p in [README, *MANUALS] if p != TABLE and not any(guides.blocks(read(p), ("python",)))],
    ids=name,
)
def test_a_command_gives_what_was_measured(path: Path) -> None:
    """Pages with Python are asked where they run, as they may print it."""
    assert unfounded(read(path)) == []


def test_front_page_claims_rows_of_the_benchmarks() -> None:
    """Each number of a claim stands in the rows of its command, and every other one in a row."""
    table = [
        (about["command"], f"{claim} {value}")
        for about in json.loads(read(KEPT)).values()
        for claim, value in about["numbers"].items()
    ]
    claims = re.findall(r"^\|([^|]*)\|([^|]*)\| `([^`]*)` \|$", read(README), re.MULTILINE)
    assert len(claims) >= 8
    for claim, number, command in claims:
        values = figures(" ".join(row for whole, row in table if whole.startswith(command)))
        assert [each for each in re.findall(FIGURE, claim + number) if not stands_in(each, values)] == []
    values = figures(" ".join(row for _, row in table))
    assert [each for each in measured(without_blocks(read(README))) if not stands_in(each, values)] == []


def test_table_of_the_benchmarks_is_that_of_its_parts() -> None:
    kept = json.loads(read(KEPT))
    assert read(TABLE) == markdown(kept)
    for part, about in kept.items():
        assert about["command"] == PARTS[part].command
        assert set(about["numbers"]) <= set(PARTS[part].claims), part
