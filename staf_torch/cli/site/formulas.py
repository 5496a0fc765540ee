"""Formulas that are written as plain text, `w_1 k(y, c_1(x)) <= e^{-|x|^2}`, typeset as MathML.

Browsers show MathML themselves: no script and no server is needed. A formula is found in prose as a run of
letters, numbers and signs with a relation, an index or a power in it; words end it. Every sign stays.
"""
# ruff: noqa: RUF001 (signs of mathematics)

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from typing import Any

_FUNCTIONS = {
    *("exp", "log", "ln", "sin", "cos", "tan", "tanh", "max", "min", "det", "diag", "rank", "argmin")
}
_WORDS = {*_FUNCTIONS, "sum", "integral"}
_SIGNS = {sign: sign for sign in "<>+=/|,;×≤≥"}
_SIGNS |= {
    "<=": "≤",
    ">=": "≥",
    "!=": "≠",
    "->": "→",
    "<-": "←",
    "...": "…",
    "-": "−",
    "*": "·",
    ".": "·",
    "'": "′",
}
_SIGNS |= {"sum": "∑", "integral": "∫"}
_LETTERS = "alpha beta gamma delta epsilon eta theta kappa lambda mu nu pi rho sigma tau phi psi omega"
_GREEK = dict(zip(_LETTERS.split(), "αβγδεηθκλμνπρστφψω", strict=True))
_RELATIONS = {"<-", "<=", ">=", "!=", "=", "<", ">", "≤", "≥"}
_TOKEN = re.compile(
    r"(?P<number>(?<![\w.])\d+(?:\.\d+)?(?:e-?\d+)?(?![\w])|(?<=[_^])\d+)"
    r"|(?P<indexed>(?<![\w.])[A-Za-z]\d+(?!\w))"  # x1
    r"|(?P<name>[A-Za-zα-ω]+)"
    r"|(?P<sign>(?<=\()\.(?=,)|<=|>=|!=|->|<-|\.\.\.|[-+=/|*',;<>×≤≥^_])"
    r"|(?P<open>[(\[{])|(?P<close>[)\]}])|(?P<space>\s+)|(?P<other>.)",
    re.DOTALL,
)
_CLOSING = {"(": ")", "[": "]", "{": "}"}
_TEXT = re.compile(r"(<(pre|code|a|h[1-6]|math|script|style|summary|svg|label)\b.*?</\2>|<[^>]*>)", re.DOTALL)
_BLOCK = re.compile(r'<div class="[^"<>]*highlight"><pre><span></span><code>([^<]+)</code></pre></div>')
Token = tuple[str, str]


def on_page_content(html: str, **kwargs: Any) -> str:
    """Typeset the formulas of a page: the hook that the site's generator calls."""
    return typeset(html)


def typeset(page: str) -> str:
    """Return the HTML of a page whose formulas in text, and blocks that are one formula, are MathML."""
    parts = _TEXT.split(_BLOCK.sub(_block, page))  # text, tag, name of the tag, text, ...
    return "".join(_prose(part) if i % 3 == 0 else part if i % 3 == 1 else "" for i, part in enumerate(parts))


def _block(found: re.Match[str]) -> str:
    """Return a block without a language as formulas, a line each, if all of its lines are."""
    lines = [line.strip() for line in html.unescape(found[1]).strip().split("\n")]
    runs = [list(_words(_tokens(line.rstrip(".,")))) for line in lines]
    if not all(run and _is_formula(run) for run in runs) or any(
        kind == "other" for run in runs for kind, _ in run
    ):
        return found[0]
    shown = (f'<math display="block">{_rows(run)}</math>' for run in runs)
    return f'<div class="formula">{"".join(shown)}</div>'


def _tokens(text: str) -> list[Token]:
    return [(found.lastgroup or "", found[0]) for found in _TOKEN.finditer(text)]


def _prose(text: str) -> str:
    """Return text, escaped as in HTML, with its formulas as MathML."""
    shown: list[str] = []
    run: list[Token] = []
    for token in [*_words(_tokens(html.unescape(text))), ("other", "")]:
        if token[0] == "other":
            shown += [_run(run), html.escape(token[1], quote=False)]
            run = []
        else:
            run.append(token)
    return "".join(shown)


def _words(tokens: list[Token]) -> Iterator[Token]:
    """Mark as `other` what cannot be part of a formula: words, and single letters that are words."""
    inside: list[bool] = []  # of each open bracket: whether words in it belong to a formula
    for i, (kind, text) in enumerate(tokens):
        after = tokens[i + 1][1] if i + 1 < len(tokens) else ""
        before = tokens[i - 1][1] if i else ""
        if kind == "open":
            inside.append(before in ("_", "^", *_FUNCTIONS) or bool(inside and inside[-1]))
        elif kind == "close" and inside:
            inside.pop()
        next_sign = tokens[i + 2][1] if i + 2 < len(tokens) else ""
        article = text in "aAI" and after == " " and before in ("", " ")
        letter = len(text) == 1 and (not article or next_sign in {"+", *_RELATIONS})
        known = text in _WORDS or text in _GREEK or (len(text) <= 3 and before in ("_", "^"))
        if kind != "name" or letter or known or (inside and inside[-1]):
            yield kind, text
        else:
            yield "other", text


def _run(run: list[Token]) -> str:
    """Return a run of possible formula: what is at its ends and no formula as text, the middle as MathML."""
    start, end = 0, len(run)
    while start < end and (
        run[start][0] in ("space", "close") or run[start][1] in {*_SIGNS} - {"|", "-", "sum"}
    ):
        start += 1
    while end > start and (
        run[end - 1][0] in ("space", "open") or run[end - 1][1] in {*_SIGNS, "^", "_"} - {"|", "'", "..."}
    ):
        end -= 1
    middle = run[start:end]
    if not _is_formula(middle):
        return html.escape("".join(text for _, text in run), quote=False)
    plain = [html.escape("".join(text for _, text in part), quote=False) for part in (run[:start], run[end:])]
    return f"{plain[0]}<math>{_rows(middle)}</math>{plain[1]}"


def _is_formula(run: list[Token]) -> bool:
    open_ones: list[str] = []
    for kind, text in run:
        if kind == "open":
            open_ones.append(_CLOSING[text])
        elif kind == "close" and (not open_ones or open_ones.pop() != text):
            return False
    names = [text for kind, text in run if kind in ("name", "indexed")]
    signs = [text for kind, text in run if kind == "sign"]
    strong = any(text in _RELATIONS or text in "^_" for text in signs)
    return bool(names) and strong and not open_ones and signs.count("|") % 2 == 0


def _rows(run: list[Token]) -> str:
    """Return tokens as MathML: powers and indices above and below what is before them."""
    shown: list[str] = []
    at = 0
    while at < len(run):
        kind, text = run[at]
        if text in "^_" and kind == "sign" and shown:
            script, at = _script(run, at + 1)
            base = shown.pop()
            if script is None:  # V^(y): an estimate
                shown.append(f"<mover>{base}<mo stretchy='false'>^</mo></mover>")
            else:
                tag = "msup" if text == "^" else "msub"
                shown.append(f"<{tag}>{base}{script}</{tag}>")
            continue
        if text == "*" and shown and run[at - 1][0] == "name" and _ends(run, at + 1):
            shown.append(f"<msup>{shown.pop()}<mo>∗</mo></msup>")
        elif kind == "open":
            end = _closing(run, at)
            left, right = (f"<mo stretchy='false'>{sign}</mo>" for sign in (text, _CLOSING[text]))
            shown.append(f"<mrow>{left}{_rows(run[at + 1 : end])}{right}</mrow>")
            at = end
        elif kind == "space":
            after_word = at and run[at - 1][0] in ("name", "indexed", "number", "close") and at + 1 < len(run)
            if after_word and run[at + 1][0] in ("name", "indexed", "number", "open"):
                shown.append("<mspace width='.2em'/>")
        else:
            shown.append(_atom(kind, text))
        at += 1
    return "".join(shown)


def _ends(run: list[Token], at: int) -> bool:
    """Return whether no factor follows: V* is an optimum, V * x a product."""
    return at == len(run) or run[at][0] not in ("name", "number", "indexed")


def _script(run: list[Token], at: int) -> tuple[str | None, int]:
    """Return what stands above or below as one MathML element, and where the formula goes on."""
    if at >= len(run) or run[at][0] in ("space", "close"):
        return None, at
    if run[at][0] == "open":
        end = _closing(run, at)
        inside = run[at + 1 : end]
        if (
            run[at][1] == "("
            and any(kind == "name" and len(text) == 1 for kind, text in inside)
            and run[at - 2][1] != "e"
        ):
            return None, at  # V^(y): an argument
        return f"<mrow>{_rows(inside)}</mrow>", end + 1
    if run[at][1] == "-" and at + 1 < len(run):
        return f"<mrow><mo>−</mo>{_atom(*run[at + 1])}</mrow>", at + 2
    if run[at][1] in ("*", "-", "+"):
        return f"<mo>{_SIGNS[run[at][1]]}</mo>", at + 1
    if run[at][0] == "sign":
        return None, at
    return _atom(*run[at]), at + 1


def _closing(run: list[Token], at: int) -> int:
    depth = 0
    for i in range(at, len(run)):
        depth += (run[i][0] == "open") - (run[i][0] == "close")
        if depth == 0:
            return i
    raise AssertionError("brackets are balanced")


def _atom(kind: str, text: str) -> str:
    if kind == "number":
        return f"<mn>{text}</mn>"
    if kind == "indexed":
        return f"<msub><mi>{text[0]}</mi><mn>{text[1:]}</mn></msub>"
    if kind == "name" and text not in ("sum", "integral"):
        upright = " mathvariant='normal'" if text in _FUNCTIONS else ""
        return f"<mi{upright}>{_GREEK.get(text, text)}</mi>"
    stretch = " stretchy='false' lspace='0' rspace='0'" if text == "|" else ""
    return f"<mo{stretch}>{html.escape(_SIGNS.get(text, text))}</mo>"
