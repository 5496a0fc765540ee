"""LaTeX with booktabs; nothing in it is taken for a command."""

from __future__ import annotations

import itertools
from collections.abc import Callable

from ..table import Table
from .printed import Number, PrintedColumn, Style, printed, significant

_SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "_": r"\_",
    "%": r"\%",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "'": r"\textquotesingle{}",
    "`": r"\textasciigrave{}",
    "-": "-{}",  # not the ligature of two of them
    "[": "{[}",  # not the argument of the line end before it
    "]": "{]}",
    "*": "{*}",
    "±": r"\ensuremath{\pm}",
}


def latex_text(table: Table, style: Style = Style()) -> str:  # noqa: B008 (it cannot change)
    r"""A `tabular`; the document needs `\usepackage{booktabs}`, and `textcomp` before LaTeX of 2020.

    Why runs have no result stands below it as comments.
    """

    def show(number: Number) -> str:
        return _number(number, style.digits)

    columns = printed(table, show, style)
    align = "".join("r" if column.numeric else "l" for column in columns)
    lines = [r"\begin{tabular}{" + align + "}", r"\toprule", *_headings(columns), r"\midrule"]
    rows = range(len(table.rows))
    lines += [" & ".join(_cell(column, row, show) for column in columns) + r" \\" for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += ["% " + " ".join(note.split()) for note in table.notes]
    return "\n".join(lines) + "\n"


def _headings(columns: list[PrintedColumn]) -> list[str]:
    """One line, or two with a rule under what several columns share."""
    lower = " & ".join(escape(column.heading) for column in columns) + r" \\"
    if not any(column.over for column in columns):
        return [lower]
    upper, rules, at = [], [], 1
    for over, group in itertools.groupby(columns, key=lambda column: column.over):
        width = len(list(group))
        if over:
            upper.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(over)}}}")
            rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
        else:
            upper += [""] * width
        at += width
    return [" & ".join(upper) + r" \\", "".join(rules), lower]


def _cell(column: PrintedColumn, row: int, show: Callable[[Number], str]) -> str:
    cell = column.cells[row]
    if cell is None:
        return "--"
    if isinstance(cell, str):
        return escape(cell)
    text = show(cell)
    return rf"\boldmath\textbf{{{text}}}" if row in column.best else text


def _number(number: Number, digits: int) -> str:
    text = _power(significant(number.value, digits))
    if number.spread is not None:
        text += r" \pm " + _power(significant(number.spread, 2))
    return f"${text}$"


def _power(text: str) -> str:
    """1.2e-05 as 1.2 x 10^-5."""
    mantissa, e, exponent = text.partition("e")
    return rf"{mantissa} \times 10^{{{int(exponent)}}}" if e else mantissa


def escape(text: str) -> str:
    """A text that LaTeX prints as it is, on one line."""
    return "".join(_SPECIAL.get(character, character) for character in " ".join(text.split()))
