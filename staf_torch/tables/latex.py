"""Tables in LaTeX: symbols with their meaning as headings, one power of ten for a mean and its spread."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence

from ..numerics import TABLE_COMMAND, fail
from ..results.files import visible
from .model import Number, PrintedColumn, Table, significant

_SPECIAL = {character: f"\\{character}" for character in "{}$&#_%"} | {
    "\\": r"\textbackslash{}",
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
SYMBOLS: Mapping[str, tuple[str, str]] = {
    "centers.radius": ("$r$", "radius of the ball of centers"),
    "centers.count": ("$M$", "number of centers"),
    "dt": (r"$\Delta t$/s", "time step"),
    "optimizer.inner_steps": ("$k$", "steps of the update law at a time"),
    "trajectories": ("$B$", "trajectories"),
    "ultimate_error": ("$e$", r"largest $|V - \hat V|$ at the state"),
    "ball_error": ("$e_r$", r"largest $|V - \hat V|$ in the ball"),
    "ball_floor_error": (r"$e_r^\ast$", "the same with ideal weights"),
    "gradient_error": (r"$e_\nabla$", r"largest $|\nabla V - \nabla \hat V|$ at the state"),
    "condition_number": (r"$\kappa$", "condition number of the Gram matrix"),
    "settling_time": ("$t_s$/s", "time from which the excess is at most its ultimate value"),
    "cost": ("$J$", "cost"),
    "optimal_cost": (r"$J^\ast$", "optimal cost"),
    "cost_ratio": (r"$J/J^\ast$", "cost over the optimal one"),
    "regulated_fraction": ("regulated", "share of the trajectories that end at the goal"),
    "diverged_fraction": ("diverged", "share of the trajectories that diverge"),
}
"""Settings and metrics: how a heading writes them, and what that is."""
_STATISTICS = {"std": "standard deviation", "ci95": r"half the 95\,\% interval of the mean"}
_COLUMN, _LETTER = 245.0, 4.3  # pt: a column of a page, a letter or digit of 8 pt
_DECIMAL = range(-2, 4)  # powers of ten that are written out


@dataclasses.dataclass(frozen=True)
class Print:
    """The frame of a printed table: caption, label, splitting, notes.

    Example:
        >>> Print(caption="Errors.", label="tab:errors").label
        'tab:errors'

        Shown by `staf-table runs --format tex --caption "Errors." --label tab:errors`.

    Args:
        caption: of a `table` environment, in LaTeX; the meaning of the symbols follows it. None: a `tabular`
            alone, with the meaning as comments.
        label: for `\\ref`; it needs a caption.
        rename: name of a setting or a metric, or a text in a cell, to what is written instead, in LaTeX.
        split: a setting: a table for each of its values.
        wide: whether the environment is `table*`, as wide as both columns of a page.
    """

    caption: str | None = None
    label: str | None = None
    rename: Mapping[str, str] = dataclasses.field(default_factory=dict)
    split: str | None = None
    wide: bool = False


def latex_text(table: Table, about: Print | None = None) -> str:
    r"""Return the table; the document needs `\usepackage{booktabs}`, and `textcomp` before LaTeX of 2020.

    Why runs have no result stands below the table as comments.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> latex_text(done.table(metrics=("ball_error",))).count("tabular")
        2

        Shown by `staf-table runs --format tex`.

    Raises:
        ValueError: if there is a label without a caption, or the table has no column to split by.
    """
    about = Print() if about is None else about
    if about.label is not None and about.caption is None:
        raise fail(TABLE_COMMAND, "label", "needs --caption", about.label)
    return "\n".join(_one(part, about, value) for value, part in parts(table, about.split))


def parts(table: Table, split: str | None) -> Iterator[tuple[str, Table]]:
    """Yield the table in parts, one a value of the setting ``split``, with `setting=value`.

    Raises:
        ValueError: if the table has no such column.
    """
    if split is None:
        yield "", table
        return
    if split not in table.names:
        raise fail(TABLE_COMMAND, "split", f"must be one of {', '.join(table.names)}", split)
    columns = tuple(column for column in table.columns if column.name != split)
    for text in dict.fromkeys(str(row.cells.get(split)) for row in table.rows):
        rows = tuple(row for row in table.rows if str(row.cells.get(split)) == text)
        yield f"{split}={text}", dataclasses.replace(table, columns=columns, rows=rows)


def _one(table: Table, about: Print, part: str) -> str:
    columns, comments, runs, digits = [], list[str](), "", table.style.digits
    for column in table.printed():
        first = column.cells[0] if column.cells else None
        if column.name == "n" and isinstance(first, Number) and set(column.cells) == {first}:
            runs = f" of {first.value:g} runs"
        else:
            columns.append(column)
    align = "".join("r" if column.numeric else "l" for column in columns)
    rows = [
        " & ".join(_cell(c, row, digits, about.rename) for c in columns) for row in range(len(table.rows))
    ]
    lines = [
        r"\begin{tabular}{@{}" + align + "@{}}",
        r"\toprule",
        *_headings(columns, about.rename),
        r"\midrule",
    ]
    lines += [f"{row} \\\\" for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines = [r"{\footnotesize\setlength{\tabcolsep}{4pt}%", *lines[:-1], lines[-1] + "}"]
    width = sum(_width(column, digits, about.rename) for column in columns) + 8.0 * (len(columns) - 1)
    if width > _COLUMN and not about.wide:
        comments.append(
            f"Some {width:.0f} pt wide, and a column is 230 to 250: choose columns by --metric and --rows, "
            "shorten texts by --rename, or take both columns by --wide."
        )
    meaning = " ".join(
        [*_meaning(columns, about.rename, runs), *([_heading(part, about.rename) + "."] if part else [])]
    )
    comments += [" ".join(visible(note).split()) for note in table.notes]
    if about.caption is None:
        comments = [meaning, *comments] if meaning else comments
    else:
        value = re.sub(r"[^A-Za-z0-9.:-]", "-", part.partition("=")[2])  # a run's text is nobody's LaTeX
        label = [] if about.label is None else [rf"\label{{{about.label}{f'-{value}' if part else ''}}}"]
        caption = f"{about.caption} {meaning}".strip()
        name = "table*" if about.wide else "table"
        begin = [rf"\begin{{{name}}}", r"\centering", rf"\caption{{{caption}}}", *label]
        lines = [*begin, r"\vspace{4pt}", *lines, rf"\end{{{name}}}"]
    return "\n".join([*lines, *(f"% {line}" for line in comments)]) + "\n"


def _width(column: PrintedColumn, digits: int, rename: Mapping[str, str]) -> float:
    """Return about how wide a column is, in pt, in type of 8 pt: a symbol is as wide as a letter."""
    texts = [_name(column, rename), *(_cell(column, row, digits, rename) for row in range(len(column.cells)))]
    hidden = re.compile(r"\\(boldmath|textbf)|[${}^_\\,]|(?<=\\)[a-z]+")
    return _LETTER * max(len(hidden.sub("", text)) for text in texts)


def _cell(column: PrintedColumn, row: int, digits: int, rename: Mapping[str, str]) -> str:
    cell = column.cells[row]
    if not isinstance(cell, Number):
        return "--" if cell is None else rename.get(cell, escape(cell))
    text = number_text(cell, digits) if column.metric else f"${significant(cell.value, 6)}$"
    return rf"\boldmath\textbf{{{text}}}" if row in column.best else text


def number_text(number: Number, digits: int) -> str:
    r"""Return `$(2.57 \pm 0.08) \times 10^{-3}$`: one power of ten, as many decimals in both.

    The mean has so many significant digits, also where the last are zeros; whole numbers are as they are.
    """
    value, spread = number.value, number.spread
    largest = max(abs(value), abs(spread or 0.0))
    if not (math.isfinite(value) and math.isfinite(spread or 0.0)):
        return f"${_infinite(value)}$" if spread is None else f"${_infinite(value)} \\pm {_infinite(spread)}$"
    if spread is None and value == round(value) and abs(value) < 1e6:
        return f"${round(value)}$"
    power = int(f"{largest:.{digits - 1}e}".partition("e")[2])  # of the rounded number
    shift = 0 if power in _DECIMAL else power
    decimals = max(0, digits - 1 - power + shift)
    text = f"{value / 10.0**shift:.{decimals}f}"
    if spread is not None:
        text += rf" \pm {spread / 10.0**shift:.{decimals}f}"
    if not shift:
        return f"${text}$"
    return f"$({text}) \\times 10^{{{shift}}}$" if spread is not None else f"${text} \\times 10^{{{shift}}}$"


def _infinite(value: float) -> str:
    if math.isnan(value):
        return r"\mathrm{nan}"
    return f"{value:.3g}" if math.isfinite(value) else ("-" if value < 0 else "") + r"\infty"


def _headings(columns: Sequence[PrintedColumn], rename: Mapping[str, str]) -> list[str]:
    """Return a line, or two with a rule under what several columns share."""
    lower = " & ".join(_name(c, rename) if not c.over else _heading(c.at, rename) for c in columns) + r" \\"
    if not any(column.over for column in columns):
        return [lower]
    upper, rules, at = [], [], 1
    for over, group in itertools.groupby(columns, key=lambda column: column.name if column.over else ""):
        members = list(group)
        if over:
            upper.append(rf"\multicolumn{{{len(members)}}}{{c}}{{{_name(members[0], rename)}}}")
            rules.append(rf"\cmidrule(lr){{{at}-{at + len(members) - 1}}}")
        else:
            upper += [""] * len(members)
        at += len(members)
    return [" & ".join(upper) + r" \\", "".join(rules), lower]


def _name(column: PrintedColumn, rename: Mapping[str, str]) -> str:
    """Return the heading of a column: the symbol, and which statistic it is where it is no mean."""
    written, what = _symbol(column.name or column.heading, rename), column.what
    return written if what in ("", "mean") or "±" in what else f"{written}, {escape(what)}"


def _symbol(name: str, rename: Mapping[str, str]) -> str:
    return rename.get(name) or (SYMBOLS[name][0] if name in SYMBOLS else escape(name))


def _heading(at: str, rename: Mapping[str, str]) -> str:
    """Return `centers.count=3, dt=0.1` with symbols."""
    written = []
    for part in at.split(", "):
        name, equals, value = part.partition("=")
        shown = rename.get(value, escape(value))
        written.append(f"{_symbol(name, rename)}{' = ' if equals else ''}{shown}")
    return ", ".join(written)


def _meaning(columns: Sequence[PrintedColumn], rename: Mapping[str, str], runs: str) -> Iterator[str]:
    """Yield sentences: what the symbols are, and what stands behind the plus-minus sign."""
    names = dict.fromkeys(
        name for c in columns for name in (c.name, *(part.partition("=")[0] for part in c.at.split(", ")))
    )
    said = [
        f"{SYMBOLS[name][0]}: {SYMBOLS[name][1]}" for name in names if name in SYMBOLS and name not in rename
    ]
    if said:
        yield "; ".join(said) + "."
    for what in dict.fromkeys(column.what for column in columns if "±" in column.what):
        yield f"Mean $\\pm$ {_STATISTICS[what.rpartition(' ')[2]]}{runs}."


def escape(text: str) -> str:
    """Return what makes LaTeX print a text as it is, on one line."""
    return "".join(_SPECIAL.get(character, character) for character in " ".join(visible(text).split()))
