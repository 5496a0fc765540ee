"""What a cell of a table shows: digits, spreads, the best, and texts in every format."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from staf_torch.tables import Style, Table, html_text, json_text, latex_text
from staf_torch.tables.columns import Column, Number, PrintedColumn, Row, printed, show, significant
from staf_torch.tables.model import _escaped, _power, _uniform, data_frame, parquet_bytes


@pytest.mark.parametrize(
    ("number", "digits", "said"),
    [
        (None, 3, "-"),
        (3, 1, "3"),
        (10**7, 3, "10000000"),
        (-999999.0, 3, "-999999"),
        (1e6, 3, "1e+06"),
        (-1e6, 3, "-1e+06"),
        (999999.5, 3, "1e+06"),
        (0.0, 3, "0"),
        (1.5, 1, "2"),
        (math.pi, 5, "3.1416"),
        (math.inf, 3, "inf"),
        (math.nan, 3, "nan"),
    ],
)
def test_numbers_have_so_many_digits_and_small_whole_ones_all(number: Any, digits: int, said: str) -> None:
    assert significant(number, digits) == said


def test_a_spread_has_two_digits_beside_a_number_of_any() -> None:
    assert show(Number(1.23456, 0.0123456), 4) == "1.235 ± 0.012"
    assert show(Number(1.23456), 4) == "1.235"
    assert significant(1.23456) == "1.23"


VALUES = (0.1001, 0.1002, 0.2, None, "gone")


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


def test_cells_are_numbers_texts_or_json() -> None:
    columns = [Column("a", heading="A"), Column("b", shown=False)]
    rows = [Row({"a": value, "b": 1}) for value in (True, [1, None], 2, 0.5, "x", None)]
    (found,) = printed(columns, rows, Style())
    assert found.cells == ("true", "[1, null]", Number(2), Number(0.5), "x", None)
    assert (found.heading, found.over) == ("A", "")


@pytest.mark.parametrize(
    ("statuses", "headings"), [(("completed",) * 2, ["a"]), (("completed", "failed"), ["a", "status"])]
)
def test_that_all_runs_ended_well_is_not_said(statuses: Sequence[str], headings: list[str]) -> None:
    rows = [Row({"a": "completed", "status": status}) for status in statuses]
    assert [c.heading for c in printed([Column("a"), Column("status")], rows, Style())] == headings


def test_counts_that_differ_are_a_range_and_those_that_failed_are_shown_where_some_did() -> None:
    columns = [
        *(Column(f"m.{what}[{at}]", "m", what, at) for at in ("x", "y") for what in ("mean", "n", "failed")),
    ]

    def counts(*pairs: tuple[int, int]) -> list[tuple[str, tuple[object, ...]]]:
        rows = [
            Row(
                {
                    **{f"m.mean[{at}]": 1.0 for at in "xy"},
                    **{f"m.n[{at}]": n for at, n in zip("xy", pair, strict=True)},
                    **{f"m.failed[{at}]": 2 - n for at, n in zip("xy", pair, strict=True)},
                }
            )
            for pair in pairs
        ]
        return [(c.heading, c.cells) for c in printed(columns, rows, Style())[2:]]

    assert counts((2, 2), (2, 2)) == [("n", (Number(2), Number(2)))]
    assert counts((1, 2), (2, 2)) == [("n", ("1-2", Number(2))), ("failed", ("0-1", Number(0)))]


# Texts


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a|b", "a\\|b"),
        ("a\\b <i>", "a\\\\b \\<i>"),
        ("`a|b*`", "`a\\|b*`"),
        ("`a", "\\`a"),
        ("``a``", "\\`\\`a\\`\\`"),
        ("2 * 3", "2 * 3"),
        ("2 * 3 * 4", "2 \\* 3 \\* 4"),
        ("[a](b)", "\\[a\\](b)"),
        ("[a] b", "[a] b"),
        ("[a]: b", "\\[a\\]: b"),
        ("# a", "\\# a"),
        ("####### a", "####### a"),
        ("- a", "\\- a"),
        ("-a", "-a"),
        ("--- a", "\\--- a"),
        ("> a", "\\> a"),
        ("a\n\n b", "a b"),
        ("a `b` *c* `d*`", "a `b` \\*c\\* `d*`"),
    ],
)
def test_markdown_shows_a_text_as_it_is(text: str, said: str) -> None:
    assert _escaped(text) == said


@pytest.mark.parametrize(
    ("text", "said"),
    [("1.2e-05", r"1.2 \times 10^{-5}"), ("1e+06", r"1 \times 10^{6}"), ("0.5", "0.5"), ("inf", "inf")],
)
def test_latex_has_powers_of_ten(text: str, said: str) -> None:
    assert _power(text) == said


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("=1", "'=1"),
        (" @a", "' @a"),
        ("a=1", "a=1"),
        ("-1", "'-1"),
        (-1, "-1"),
        (True, "true"),
        (None, ""),
        ([1, "a"], '"[1, ""a""]"'),
    ],
)
def test_a_spreadsheet_computes_nothing(cell: Any, said: str) -> None:
    assert Table.of([{"a": cell, "b": 1}]).csv() == f"a,b\n{said},1\n"


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


def test_a_page_has_the_best_bold_and_every_text_as_it_is() -> None:
    assert html_text(TABLE) == (
        "<table><thead><tr><th>a</th><th>M &amp; m</th></tr></thead><tbody>"
        "<tr><td>&lt;x&gt; &amp; y</td><td><b>0.25</b></td></tr>"
        "<tr><td>-</td><td>0.5</td></tr>"
        "<tr><td>c</td><td>-</td></tr></tbody></table><p>a &lt;note&gt; of 100 %</p>"
    )


def test_latex_has_the_best_bold_dashes_and_notes_as_comments() -> None:
    assert latex_text(TABLE).splitlines()[2:] == [
        r"a & M \& m \\",
        r"\midrule",
        r"\textless{}x\textgreater{} \& y & \boldmath\textbf{$0.25$} \\",
        r"-- & $0.5$ \\",
        r"c & -- \\",
        r"\bottomrule",
        r"\end{tabular}",
        "% a <note> of 100 %",
    ]
    assert latex_text(TABLE).startswith("\\begin{tabular}{lr}\n\\toprule\n")


def test_markdown_has_the_best_bold_and_columns_as_wide_as_they_must_be() -> None:
    assert TABLE.markdown().splitlines() == [
        "| a        |    M & m |",
        "| -------- | -------: |",
        "| \\<x> & y | **0.25** |",
        "| -        |      0.5 |",
        "| c        |        - |",
        "",
        "a \\<note> of 100 %",
    ]


def test_json_has_null_and_a_reason_for_what_it_cannot_hold() -> None:
    text = json_text(TABLE)
    assert text.startswith('{\n  "columns": [\n    "a",\n    "m",\n    "hidden"\n  ],')
    assert text.endswith("]\n}\n")
    rows = json.loads(text)["rows"]
    assert [row["reasons"] for row in rows] == [
        {},
        {"hidden": "nan is not a JSON number"},
        {"m": "why", "hidden": "-inf is not a JSON number"},
    ]
    assert [row["hidden"] for row in rows] == [1, None, None]
    assert "é" in json_text(Table.of([{"a": "é"}]))


def test_a_table_of_rows_has_all_of_their_keys_or_those_with_headings() -> None:
    rows = [{"a": 1}, {"b": 2, "a": 3}]
    assert list(Table.of(rows).names) == ["a", "b"]
    named = Table.of(rows, {"b": "B", "a": ""})
    assert list(named.names) == ["b", "a"]
    assert [column.heading for column in named.printed()] == ["B", "a"]
    assert [column.cells for column in named.printed()] == [(None, Number(2)), (Number(1), Number(3))]


@pytest.mark.parametrize(
    ("cells", "number", "want"),
    [
        ([None, None], False, [None, None]),
        ([1, 2.5], False, [1, 2.5]),
        ([True, False, None], False, [True, False, None]),
        ([True, 1], False, ["true", "1"]),
        (["a", 1, None], True, ["a", "1", None]),
    ],
)
def test_a_column_of_a_frame_has_one_type(cells: list[Any], number: bool, want: list[Any]) -> None:
    assert _uniform(cells, number) == want


def test_a_metric_that_no_run_has_is_a_column_of_nan() -> None:
    pandas = pytest.importorskip("pandas", reason="frames need the extra `tables`")
    frame = data_frame(Table((Column("m", "m"), Column("a")), (Row({"m": None, "a": None}),)))
    assert frame["m"].dtype == "float64"
    assert frame["a"].dtype == object
    assert isinstance(frame, pandas.DataFrame)


def test_what_a_table_cannot_do_without_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("pandas", "pyarrow"):
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ValueError, match=r"^a DataFrame needs pandas: install the extra `tables`"):
        data_frame(TABLE)
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace())  # which is not asked for anything
    with pytest.raises(ValueError, match=r"^Parquet needs pyarrow: install the extra `tables`"):
        parquet_bytes(TABLE)


def test_cells_of_a_frame_are_numbers_where_the_column_is_of_a_metric(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    frame = data_frame(Table((Column("m", "m"), Column("a")), (Row({"m": None, "a": None}),)))
    assert frame["a"] == [None]
    assert math.isnan(frame["m"][0])


def test_a_column_without_texts_is_of_numbers() -> None:
    assert PrintedColumn("a", "", (Number(1), None)).numeric
    assert not PrintedColumn("a", "", (Number(1), "x")).numeric
