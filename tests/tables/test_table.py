"""From runs to tables in every format."""

from __future__ import annotations

import csv
import io
import json
import math
import statistics
from pathlib import Path

import pytest
from scipy.stats import t as student
from sweep_runs import BAD_COUNT, error, write_run, write_sweep

from staf_torch.cli.table import main
from staf_torch.results.reader import Collection, collect
from staf_torch.tables import Layout, Style, Table, json_text, latex_text, parquet_bytes, tabulate
from staf_torch.tables.aggregate import AGGREGATES, _expansion, student_quantile
from staf_torch.tables.model import _uniform, escape

PIVOT = Layout(
    rows=("kernel", "centers.radius"),
    columns=("centers.count",),
    metrics=("ball_error",),
    style=Style(bold=True),
)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sweep(tmp_path_factory.mktemp("sweep") / "runs")


@pytest.fixture(scope="module")
def found(sweep: Path) -> Collection:
    return collect(sweep)


def parsed(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


# What is in a table


def test_without_wishes_a_row_is_a_run(found: Collection) -> None:
    table = tabulate(found)
    assert len(table.rows) == 36
    assert table.names[:4] == ("kernel", "centers.radius", "centers.count", "seed")
    assert "reason" in table.names
    failed = [row for row in table.rows if row.cells["status"] == "failed"]
    assert len(failed) == 12
    assert all(row.cells["ball_error"] is None for row in failed)
    assert {row.reasons["ball_error"] for row in failed} == {BAD_COUNT}


def test_aggregates_are_over_what_is_in_neither_rows_nor_columns(found: Collection) -> None:
    layout = Layout(**{**PIVOT.__dict__, "aggregates": tuple(AGGREGATES)})
    table = tabulate(found, layout)
    assert len(table.rows) == 4
    row = table.rows[1].cells
    assert (row["kernel"], row["centers.radius"]) == ("exponential", 0.1)
    numbers = [error(0.1, 6, seed) for seed in range(3)]
    expected = {
        "mean": statistics.mean(numbers),
        "std": statistics.stdev(numbers),
        "ci95": student.ppf(0.975, 2) * statistics.stdev(numbers) / math.sqrt(3),
        "min": min(numbers),
        "max": max(numbers),
        "median": statistics.median(numbers),
    }
    for name, value in expected.items():
        assert row[f"ball_error.{name}[centers.count=6]"] == pytest.approx(value, rel=1e-12), name
    assert (row["ball_error.n[centers.count=6]"], row["ball_error.failed[centers.count=6]"]) == (3, 0)
    assert (row["ball_error.n[centers.count=7]"], row["ball_error.failed[centers.count=7]"]) == (0, 3)
    assert row["ball_error.mean[centers.count=7]"] is None
    assert row["reasons"] == BAD_COUNT


def test_a_group_in_which_some_runs_failed_says_of_how_many(tmp_path: Path) -> None:
    write_run(tmp_path / "0", {"seed": 0}, {"ball_error": 1.0})
    write_run(tmp_path / "1", {"seed": 1}, {"ball_error": None})
    write_run(tmp_path / "2", {"seed": 2}, None, status="failed", reason="why")
    (row,) = tabulate(collect(tmp_path), Layout(aggregates=("mean", "std"))).rows
    assert (row.cells["ball_error.mean"], row.cells["ball_error.n"], row.cells["ball_error.failed"]) == (
        1.0,
        1,
        2,
    )
    assert row.cells["ball_error.std"] is None
    assert row.cells["reasons"] == "not finite, or nothing to report; why"


@pytest.mark.parametrize("option", ["rows", "columns", "metrics", "aggregates", "sort"])
def test_an_unknown_name_is_refused_with_those_that_exist(option: str, found: Collection) -> None:
    with pytest.raises(ValueError, match=r"must be one of .*; got 'ball_eror'") as raised:
        tabulate(found, Layout(**{option: ("ball_eror",)}))
    known = {"metrics": "ball_error", "aggregates": "ci95", "sort": "ball_error"}.get(option, "centers.count")
    assert known in str(raised.value)


def test_rows_are_sorted_by_the_first_name_first_and_what_is_missing_is_last(found: Collection) -> None:
    for direction in ("", ":desc"):
        rows = tabulate(found, Layout(sort=(f"ball_error{direction}", "seed"))).rows
        errors = [row.cells["ball_error"] for row in rows]
        assert errors[24:] == [None] * 12
        present = [number for number in errors if number is not None]
        assert present == sorted(present, reverse=bool(direction))
        assert [row.cells["seed"] for row in rows[24:]] == sorted(row.cells["seed"] for row in rows[24:])


def test_numbers_of_the_columns_are_in_order_and_not_as_texts(tmp_path: Path) -> None:
    for num, count in enumerate((15, 3, 10)):
        write_run(tmp_path / str(num), {"centers.count": count}, {"ball_error": 1.0})
    table = tabulate(collect(tmp_path), Layout(columns=("centers.count",), metrics=("ball_error",)))
    places = list(dict.fromkeys(column.at for column in table.columns if column.at))
    assert places == ["centers.count=3", "centers.count=10", "centers.count=15"]


@pytest.mark.parametrize("freedom", [*range(1, 12), 30, 99, 100, 199, 200, 201, 1000, 10**6])
def test_quantile_of_students_t_is_exact(freedom: int) -> None:
    assert student_quantile(freedom) == pytest.approx(student.ppf(0.975, freedom), rel=1e-10)


def test_aggregates_of_huge_numbers_do_not_overflow() -> None:
    numbers = [1.7e308, 1.6e308, 1.5e308]
    assert AGGREGATES["mean"](numbers) == pytest.approx(1.6e308)
    assert AGGREGATES["std"](numbers) == pytest.approx(1e307)


# Formats


def test_csv_gives_back_every_bit(sweep: Path, found: Collection) -> None:
    rows = parsed(tabulate(found, Layout(every_metric=True)).csv())
    assert len(rows) == 36
    for row, run in zip(rows, found.rows, strict=True):
        for name, number in run.metrics.items():
            assert row[name] == "" if number is None else float(row[name]).hex() == number.hex()
        assert Path(row["directory"]) == run.directory


def test_json_is_valid_and_says_why_a_number_is_missing(found: Collection) -> None:
    content = json.loads(json_text(tabulate(found, Layout(every_metric=True))), parse_constant=pytest.fail)
    for row, run in zip(content["rows"], found.rows, strict=True):
        assert row["ball_error"] == run.metrics.get("ball_error")
        if row["ball_error"] is None:
            assert row["reasons"]["ball_error"] == BAD_COUNT
        else:
            assert row["reasons"] == {"settling_time": "not finite, or nothing to report"}


def test_json_stays_valid_where_an_aggregate_overflows(tmp_path: Path) -> None:
    for num, number in enumerate((1.7e308, -1.7e308)):
        write_run(tmp_path / str(num), {"seed": num}, {"ball_error": number})
    table = tabulate(collect(tmp_path), Layout(aggregates=("mean", "std")))
    (row,) = json.loads(json_text(table), parse_constant=pytest.fail)["rows"]
    assert (row["ball_error.mean"], row["ball_error.std"]) == (0.0, None)
    assert row["reasons"] == {"ball_error.std": "inf is not a JSON number"}


def test_markdown_joins_mean_and_spread_and_marks_the_best(found: Collection) -> None:
    text = tabulate(found, PIVOT).markdown()
    lines = text.splitlines()
    assert lines[0] == "ball_error, mean ± std"
    heads = [cell.strip() for cell in lines[2].strip("|").split("|")]
    counts = ["centers.count=3", "centers.count=6", "centers.count=7"]
    assert heads == ["kernel", "centers.radius", *counts, "n", "failed"]
    cells = [cell.strip() for cell in lines[4].strip("|").split("|")]
    assert cells == [
        "exponential",
        "0.05",
        "**0.0128 ± 0.0003**",
        "**0.00064 ± 1.5e-05**",
        "-",
        "0-3",
        "0-3",
    ]
    assert "**" not in lines[5]
    assert f"12 of 36 failed: {BAD_COUNT}" in text
    assert len({len(line) for line in lines[2:8]}) == 1  # aligned


@pytest.mark.parametrize(("number", "heads"), [(0.1, ["n"]), (None, ["n", "failed"])])
def test_how_many_failed_is_shown_where_one_did_and_how_many_count_always(
    tmp_path: Path, number: float | None, heads: list[str]
) -> None:
    for num in range(2):
        write_run(tmp_path / str(num), {"seed": num, "dt": 0.1}, {"ball_error": number})
    text = tabulate(collect(tmp_path), Layout(metrics=("ball_error",), aggregates=("mean",))).markdown()
    shown = [cell.strip() for cell in next(line for line in text.splitlines() if "|" in line).split("|")]
    assert [head for head in shown if head in ("n", "failed")] == heads


def test_best_marks_all_that_look_alike(tmp_path: Path) -> None:
    for num, number in enumerate((0.1001, 0.1002, 0.2)):
        write_run(tmp_path / str(num), {"dt": num + 1}, {"ball_error": number})
    text = tabulate(collect(tmp_path), Layout(style=Style(bold=True))).markdown()
    assert text.count("**0.1**") == 2


def test_latex_prints_every_special_character_as_it_is() -> None:
    special = "\\ { } $ & # ^ _ % ~ < > | \" ' ` -- [ ] *"
    expected = (
        r"\textbackslash{} \{ \} \$ \& \# \textasciicircum{} \_ \% \textasciitilde{} \textless{} "
        r"\textgreater{} \textbar{} \symbol{34} \textquotesingle{} \textasciigrave{} -{}-{} {[} {]} {*}"
    )
    assert escape(special) == expected
    assert escape("two\nlines") == "two lines"


def test_latex_has_booktabs_two_lines_of_headings_and_powers_of_ten(found: Collection) -> None:
    text = latex_text(tabulate(found, PIVOT))
    lines = text.splitlines()
    assert lines[0] == r"\begin{tabular}{lrrrrll}"
    assert lines[2] == r" &  & \multicolumn{3}{c}{ball\_error, mean \ensuremath{\pm} std} &  &  \\"
    assert lines[3] == r"\cmidrule(lr){3-5}"
    assert [line for line in lines if "rule" in line and "cmid" not in line] == [
        r"\toprule",
        r"\midrule",
        r"\bottomrule",
    ]
    body = lines[lines.index(r"\midrule") + 1 : lines.index(r"\bottomrule")]
    assert len(body) == 4
    assert all(line.endswith(r" \\") and line.count(" & ") == 6 for line in body)
    assert r"\boldmath\textbf{$0.00064 \pm 1.5 \times 10^{-5}$}" in body[0]
    assert lines[-2].startswith("% 12 of 36 failed")
    assert lines[-1] == "% `kernel` was swept and changed no metric in any row."


def test_a_setting_with_anything_in_it_stays_in_its_cell(tmp_path: Path) -> None:
    nasty = 'a|b & c \\ "d"\n<e>'
    write_run(tmp_path / "0", {"kernel": nasty}, {"ball_error": 1.0})
    write_run(tmp_path / "1", {"kernel": [1, [2.5]]}, {"ball_error": 2.0})
    table = tabulate(collect(tmp_path))
    assert parsed(table.csv())[0]["kernel"] == nasty
    assert json.loads(parsed(table.csv())[1]["kernel"]) == [1, [2.5]]
    assert json.loads(json_text(table))["rows"][0]["kernel"] == nasty
    assert 'a\\|b & c \\\\ "d" \\<e>' in table.markdown()
    assert latex_text(table).count("\\\\\n") == 3


def test_parquet_gives_back_every_bit(found: Collection) -> None:
    pandas = pytest.importorskip("pandas", reason="Parquet needs the extra `tables`")
    pytest.importorskip("pyarrow", reason="Parquet needs the extra `tables`")
    frame = pandas.read_parquet(io.BytesIO(parquet_bytes(tabulate(found, Layout(every_metric=True)))))
    assert frame["ball_error"].dtype == frame["settling_time"].dtype == "float64"
    for number, run in zip(frame["ball_error"], found.rows, strict=True):
        expected = run.metrics.get("ball_error")
        assert math.isnan(number) if expected is None else number == expected


def test_parquet_without_its_extra_names_it(found: Collection, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(ValueError, match=r"pip install 'staf_torch\[tables\]'"):
        parquet_bytes(Table((), ()))


# Tables of computed rows


def test_a_table_shows_three_digits_and_the_csv_all_of_them() -> None:
    rows = [{"law": "a|b", "excess": 1 / 3, "count": 2}, {"law": "exact", "excess": None, "count": 1100.0}]
    assert Table.of(rows, {"law": "law", "excess": "J/J*", "count": "n"}).markdown() == (
        "| law   |  J/J* |    n |\n"
        "| ----- | ----: | ---: |\n"
        "| a\\|b  | 0.333 |    2 |\n"
        "| exact |     - | 1100 |\n"
    )
    assert Table.of(rows).csv() == f"law,excess,count\na|b,{1 / 3!r},2\nexact,,1100.0\n"


def test_rows_of_different_keys_share_a_table() -> None:
    assert Table.of([{"a": 1}, {"b": math.inf}]).markdown().splitlines()[2:] == [
        "|   1 |   - |",
        "|   - | inf |",
    ]


# The command


def test_command_prints_the_table_and_what_it_skipped(
    sweep: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (sweep.parent / "broken").mkdir(exist_ok=True)
    (sweep.parent / "broken" / "run.json").write_text("{")
    assert main([str(sweep.parent), "--rows", "kernel", "--metric", "ball_error", "--format", "csv"]) == 0
    out, err = capsys.readouterr()
    assert [row["kernel"] for row in parsed(out)] == ["exponential", "gaussian"]
    assert err.startswith(f"skipped {sweep.parent / 'broken'}: run.json is not JSON")


def test_command_writes_a_file(sweep: Path, tmp_path: Path) -> None:
    output = tmp_path / "table.tex"
    assert main([str(sweep), "--format", "tex", "--best", "bold", "--output", str(output)]) == 0
    assert output.read_text().startswith(r"\begin{tabular}")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--metric", "nope"], "`staf-table --metric` must be one of ball_error, "),
        (["--sort", "nope"], "`staf-table --sort` must be one of kernel, "),
        (["--digits", "0"], "`staf-table --digits` must be at least 1; got 0."),
        (["--format", "parquet"], "needs --output FILE."),
        (["--output", "/nowhere/at/all"], "No such file or directory"),
    ],
)
def test_command_ends_with_one_sentence(
    options: list[str], said: str, sweep: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(sweep), *options]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err.splitlines()[-1]


@pytest.mark.parametrize("freedom", [200, 300, 400])
def test_every_term_of_the_expansion_of_students_quantile_counts(freedom: int) -> None:
    assert _expansion(freedom) == pytest.approx(float(student.ppf(0.975, freedom)), abs=1 / freedom**5)


def test_the_expansion_has_the_coefficients_of_abramowitz_and_stegun() -> None:
    x = statistics.NormalDist().inv_cdf(0.975)
    g1 = (x**3 + x) / 4
    g2 = (5 * x**5 + 16 * x**3 + 3 * x) / 96
    g3 = (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384
    g4 = (79 * x**9 + 776 * x**7 + 1482 * x**5 - 1920 * x**3 - 945 * x) / 92160
    for freedom in (1, 2, 7):  # 26.7.5
        found = x + g1 / freedom + g2 / freedom**2 + g3 / freedom**3 + g4 / freedom**4
        assert _expansion(freedom) == pytest.approx(found, rel=1e-12)


def test_a_column_of_numbers_has_nan_where_there_is_none() -> None:
    found = _uniform([1, None, 2.5], True)
    assert found[0::2] == [1, 2.5]
    assert math.isnan(found[1])
    assert _uniform([True, None], False) == [True, None]
    assert _uniform(["a", None, [1, 2]], False) == ["a", None, "[1, 2]"]
