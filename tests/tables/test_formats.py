"""What a table shows in Markdown, LaTeX, HTML, CSV, JSON and Parquet: every bit, few digits, plain texts."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from sweep_runs import BAD_COUNT, write_sweep
from tables.test_aggregation import PIVOT

from staf_torch.results.reader import Collection, collect
from staf_torch.tables import Layout, Style, Table, json_text, latex_text, parquet_bytes, tabulate
from staf_torch.tables.latex import Print, escape, number_text
from staf_torch.tables.model import Column, Number, Row, data_frame, printed, significant


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Collection:
    return collect(write_sweep(tmp_path_factory.mktemp("sweep") / "runs"))


TABLE = Table(
    (Column("a"), Column("m", "m", heading="M & m"), Column("hidden", shown=False)),
    (
        Row({"a": "<x> & y", "m": 0.25, "hidden": 1}),
        Row({"a": None, "m": 0.5, "hidden": math.nan}),
        Row({"a": "c", "m": None, "hidden": -math.inf}, {"m": "why"}),
    ),
    notes=("a <note> of 100 %",),
    style=Style(bold=True),
)


VALUES = (0.1001, 0.1002, 0.2, None, "gone")


def parsed(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_csv_gives_back_every_bit(found: Collection) -> None:
    rows = parsed(tabulate(found, Layout(every_metric=True)).csv())
    assert len(rows) == 36
    for row, run in zip(rows, found.rows, strict=True):
        for name, number in run.metrics.items():
            assert row[name] == "" if number is None else float(row[name]).hex() == number.hex()
        assert Path(row["directory"]) == run.directory


def test_parquet_gives_back_every_bit(found: Collection) -> None:
    pandas = pytest.importorskip("pandas", reason="Parquet needs the extra `tables`")
    pytest.importorskip("pyarrow", reason="Parquet needs the extra `tables`")
    frame = pandas.read_parquet(io.BytesIO(parquet_bytes(tabulate(found, Layout(every_metric=True)))))
    assert frame["ball_error"].dtype == frame["settling_time"].dtype == "float64"
    for number, run in zip(frame["ball_error"], found.rows, strict=True):
        expected = run.metrics.get("ball_error")
        assert math.isnan(number) if expected is None else number == expected


def test_markdown_joins_mean_and_spread_and_marks_the_best(found: Collection) -> None:
    text = tabulate(found, PIVOT).markdown()
    lines = text.splitlines()
    assert lines[0] == "ball_error, mean ± std"
    heads = [cell.strip() for cell in lines[2].strip("|").split("|")]
    counts = ["centers.count=3", "centers.count=6", "centers.count=7"]
    assert heads == ["kernel", "centers.radius", *counts, "n", "failed"]
    cells = [cell.strip() for cell in lines[4].strip("|").split("|")]
    assert cells == ["exponential", "0.05", "**0.0128 ± 0.0003**", "**0.00064 ± 1.5e-05**", "-", "0-3", "0-3"]
    assert "**" not in lines[5]
    assert f"12 of 36 failed: {BAD_COUNT}" in text
    assert len({len(line) for line in lines[2:8]}) == 1  # aligned


def test_latex_has_booktabs_two_lines_of_headings_and_powers_of_ten(found: Collection) -> None:
    text = latex_text(tabulate(found, PIVOT))
    size, *lines = text.splitlines()
    assert size.startswith(r"{\footnotesize")  # so that it fits a column
    assert lines[0] == r"\begin{tabular}{@{}lrrrrll@{}}"
    assert lines[2] == r" &  & \multicolumn{3}{c}{$e_r$} &  &  \\"
    assert lines[3] == r"\cmidrule(lr){3-5}"
    assert lines[4] == r"kernel & $r$ & $M$ = 3 & $M$ = 6 & $M$ = 7 & n & failed \\"
    assert [line for line in lines if "rule" in line and "cmid" not in line] == [
        r"\toprule",
        r"\midrule",
        r"\bottomrule",
    ]
    body = lines[lines.index(r"\midrule") + 1 : lines.index(r"\bottomrule")]
    assert len(body) == 4
    assert all(line.endswith(r" \\") and line.count(" & ") == 6 for line in body)
    assert r"\boldmath\textbf{$(6.40 \pm 0.15) \times 10^{-4}$}" in body[0]
    assert "in the ball; $M$: number of centers. Mean $\\pm$ standard deviation.\n" in text
    assert lines[-2].startswith("% 12 of 36 failed")
    assert lines[-1] == "% `kernel` was swept and changed no metric in any row."


@pytest.mark.parametrize(
    ("value", "spread", "written"),
    [
        (2.57e-3, 8.3e-5, r"(2.57 \pm 0.08) \times 10^{-3}"),
        (0.0559, 5.4e-4, r"0.0559 \pm 0.0005"),
        (9.999e-3, 1e-9, r"0.0100 \pm 0.0000"),
        (-123456.7, None, r"-1.23 \times 10^{5}"),
        (12.0, None, "12"),
        (0.0, 0.0, r"0.00 \pm 0.00"),
        (math.inf, None, r"\infty"),
    ],
)
def test_a_mean_and_its_spread_have_one_power_of_ten(
    value: float, spread: float | None, written: str
) -> None:
    assert number_text(Number(value, spread), 3) == f"${written}$"


def test_a_table_is_set_in_a_column_of_a_page_without_a_hand_edit(found: Collection, tmp_path: Path) -> None:
    layout = Layout(rows=("kernel", "centers.radius"), metrics=("ball_error", "gradient_error"))
    table = tabulate(found, layout)
    about = Print("Errors of \\emph{all} runs.", "tab:e", {"gaussian": "Gauss", "kernel": "$k$"}, "kernel")
    text = latex_text(table, about)
    assert text.count(r"\begin{table}") == text.count(r"\caption{Errors of \emph{all} runs. $r$: ") == 2
    assert "$k$ = exponential.}" in text
    assert "$k$ = Gauss.}" in text
    assert r"\label{tab:e-gaussian}" in text
    wide = latex_text(table, dataclasses.replace(about, split=None, wide=True))
    assert r"\begin{table*}" in wide
    assert "Gauss &" in wide
    for wrong in Print(label="x"), Print(split="no_such"):
        with pytest.raises(ValueError, match=r"`staf-table --(label|split)`"):
            latex_text(table, wrong)
    if shutil.which("pdflatex") is None:
        pytest.skip("without pdflatex")
    page = r"\documentclass[twocolumn]{article}\usepackage{booktabs}\begin{document}%s\end{document}"
    (tmp_path / "page.tex").write_text(page % (text + wide), encoding="utf-8")
    line = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex"]
    said = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout
    assert "Overfull" not in said.stdout


def test_latex_prints_every_special_character_as_it_is() -> None:
    special = "\\ { } $ & # ^ _ % ~ < > | \" ' ` -- [ ] *"
    expected = (
        r"\textbackslash{} \{ \} \$ \& \# \textasciicircum{} \_ \% \textasciitilde{} \textless{} "
        r"\textgreater{} \textbar{} \symbol{34} \textquotesingle{} \textasciigrave{} -{}-{} {[} {]} {*}"
    )
    assert escape(special) == expected
    assert escape("two\nlines") == "two lines"


def test_a_table_shows_three_digits_and_the_csv_all_of_them() -> None:
    rows = [{"law": "a|b", "excess": 1 / 3, "count": 2}, {"law": "exact", "excess": None, "count": 1100.0}]
    assert Table.of(rows, {"law": "law", "excess": "J/J*", "count": "n"}).markdown() == (
        "| law   |  J/J* |    n |\n"
        "| ----- | ----: | ---: |\n"
        "| a\\|b  | 0.333 |    2 |\n"
        "| exact |     - | 1100 |\n"
    )
    assert Table.of(rows).csv() == f"law,excess,count\na|b,{1 / 3!r},2\nexact,,1100.0\n"


@pytest.mark.parametrize(
    ("number", "digits", "said"),
    [
        (None, 3, "-"),
        (10**7, 3, "10000000"),
        (-999999.0, 3, "-999999"),
        (999999.5, 3, "1e+06"),
        (0.0, 3, "0"),
        (math.pi, 5, "3.1416"),
        (math.inf, 3, "inf"),
        (math.nan, 3, "nan"),
    ],
)
def test_numbers_have_so_many_digits_and_small_whole_ones_all(number: Any, digits: int, said: str) -> None:
    assert significant(number, digits) == said


@pytest.mark.parametrize(
    ("column", "style", "best"),
    [
        (Column("m", metric="m"), Style(bold=True), {0, 1}),
        (Column("m", metric="m", larger_is_better=True), Style(bold=True), {2}),
        (Column("m", metric="m"), Style(bold=True, digits=4), {0}),
        (Column("m", metric="m"), Style(), set()),
        (Column("m"), Style(bold=True), set()),
    ],
)
def test_the_best_is_marked_with_all_that_look_like_it(column: Column, style: Style, best: set[int]) -> None:
    (found,) = printed([column], [Row({"m": value}) for value in VALUES], style)
    assert found.best == best
    assert not found.numeric
    (alone,) = printed([column], [Row({"m": 0.1}), Row({"m": None})], style)
    assert alone.best == frozenset()
    assert alone.numeric
    (two,) = printed([column], [Row({"m": 0.3}), Row({"m": 0.1})], style)
    assert len(two.best) == (1 if best else 0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a|b", "a\\|b"),
        ("a\\b <i>", "a\\\\b \\<i>"),
        ("``a``", "\\`\\`a\\`\\`"),
        ("2 * 3 * 4", "2 \\* 3 \\* 4"),
        ("[a](b)", "\\[a\\](b)"),
        ("# a", "\\# a"),
        ("- a", "\\- a"),
        ("> a", "\\> a"),
        ("a\n\n b", "a b"),
        ("a `b` *c* `d*`", "a `b` \\*c\\* `d*`"),
    ],
)
def test_markdown_shows_a_text_as_it_is(text: str, said: str) -> None:
    assert Table.of([{"a": text}]).markdown().splitlines()[2].strip("| ") == said.strip("| ")


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("=1", "'=1"),
        ("a=1", "a=1"),
        ("-1", "'-1"),
        (-1, "-1"),
        (None, ""),
        ([1, "a"], '"[1, ""a""]"'),
    ],
)
def test_a_spreadsheet_computes_nothing(cell: Any, said: str) -> None:
    assert Table.of([{"a": cell, "b": 1}]).csv() == f"a,b\n{said},1\n"


def test_classes_of_a_users_own_are_named_without_their_modules_where_all_differ() -> None:
    for paths, shown in ((["mine.A", "__main__.B"], "A B"), (["mine.A", "other.A"], "mine.A other.A")):
        table = Table.of([{"kernel.path": path, "m": 0.1} for path in paths])
        assert " ".join(line.split()[1] for line in table.markdown().splitlines()[2:]) == shown
        assert all(path in table.csv() for path in paths)


def test_json_has_null_and_a_reason_for_what_it_cannot_hold() -> None:
    text = json_text(TABLE)
    rows = json.loads(text)
    assert [list(row) for row in rows] == [["a", "m", "hidden", "reasons"]] * 3
    assert [row["reasons"] for row in rows] == [
        {},
        {"hidden": "nan is not a JSON number"},
        {"m": "why", "hidden": "-inf is not a JSON number"},
    ]
    assert [row["hidden"] for row in rows] == [1, None, None]
    assert "é" in json_text(Table.of([{"a": "é"}]))
    pandas = pytest.importorskip("pandas", reason="needs the extra tables")
    frame = pandas.read_json(io.StringIO(text), precise_float=True)
    assert list(frame) == ["a", "m", "hidden", "reasons"]
    assert frame["m"].isna().tolist() == [row["m"] is None for row in rows]


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("pandas", "pyarrow"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=r"^a DataFrame needs pandas: install the extra `tables`"):
        data_frame(TABLE)
    with pytest.raises(ValueError, match=r"^Parquet needs pyarrow: .*pip install 'staf_torch\[tables\]'"):
        parquet_bytes(TABLE)
