"""The figures: panels, one style, and the same bytes on every run."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from figures.drawing import lines, visible
from figures.test_drawn import CROWDED, FIGURES
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

import staf_torch
from staf_torch.figures.style import (
    FigurePaper,
    images,
    page,
    printed_on,
)


def test_the_style_is_ours_whatever_the_caller_has_set_and_is_taken_back() -> None:
    with matplotlib.rc_context({"font.size": 30, "axes.grid": False}):
        with page(2) as figure:
            axes = figure.subplots()
            axes.set_xlabel("time (s)")
        assert axes.xaxis.label.get_size() == 8
        assert matplotlib.rcParams["font.size"] == 30


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_has_a_curve_for_all_that_it_was_given_and_names_it(
    name: str, request: pytest.FixtureRequest
) -> None:
    if name not in CROWDED:
        request.getfixturevalue("not_laid_out")
    with printed_on(FigurePaper.of({"width": 3.4})):
        found = FIGURES[name]()
    panels = visible(found.figure)
    drawn = [line for axes in panels for line in lines(axes)]
    assert [axes.get_ylabel() for axes in panels] == found.panels
    assert [name for name, _, _ in drawn if name is not None] == found.names
    for x, values in found.curves:
        for y in np.asarray(values).reshape(len(values), -1).T:
            here = [line for line in drawn if len(line[1]) == len(x) and np.allclose(line[1], x)]
            assert any(np.allclose(line[2], y, equal_nan=True) for line in here), y
    if name in CROWDED:
        fits_a_column(found.figure)


def fits_a_column(figure: Figure) -> None:
    """Type of 8 pt, all ink on the paper, and legends in their axes, of lines that are seen."""
    width, height = figure.get_size_inches()
    assert width == 3.4
    assert height < 9.5  # inches: a page
    ink = figure.get_tightbbox()
    assert min(ink.x0, ink.y0) > -0.02
    assert ink.x1 < width + 0.02
    assert ink.y1 < height + 0.02
    assert {text.get_size() for text in figure.findobj(Text) if text.get_text()} == {8.0}
    for axes in figure.axes:
        if axes.get_legend() is None:
            continue
        frame, box = axes.get_window_extent().padded(1), axes.get_legend().get_window_extent()
        assert frame.x0 < box.x0 < box.x1 < frame.x1
        assert frame.y0 < box.y0 < box.y1 < frame.y1
        for entry in (text.get_text() for text in axes.get_legend().get_texts()):
            assert any(entry == part.get_label() and _seen(part) for part in _parts(figure)), entry


def _parts(figure: Figure) -> list[Any]:
    return [part for axes in visible(figure) for part in (*axes.get_lines(), *axes.collections)]


def _seen(part: Any) -> bool:
    """A line that has points within its axes; a band, anyway."""
    if not hasattr(part, "get_xydata"):
        return True
    points = part.get_transform().transform(part.get_xydata())
    frame = part.axes.get_window_extent().padded(1)
    return bool(((points > frame.min) & (points < frame.max)).all(1).any())


@pytest.mark.parametrize(
    ("figures", "paper"),
    [
        (True, FigurePaper()),
        ({"width": 3.4, "font": 9}, FigurePaper(3.4, 9.0)),
        ({"width": 5, "font": "7.5 DejaVu Sans"}, FigurePaper(5.0, 7.5, "DejaVu Sans")),
        ({"width": 1.0}, "figures.width=...` must be inches, from 2 to 40; got 1.0"),
        ({"font": "Comic Sands"}, "figures.font=...` must name a font that is installed"),
        ({"font": 0}, "figures.font=...` must be a size in pt, from 3 to 40, a family, or both; got 0"),
        ({"fonts": 8}, "figures=...` must be true or false, or have draw, width and font"),
    ],
)
def test_a_width_and_a_font_are_read_as_written_or_refused(figures: object, paper: FigurePaper | str) -> None:
    if isinstance(paper, FigurePaper):
        assert FigurePaper.of(figures) == paper
        return
    with pytest.raises(ValueError, match=re.escape(paper)):
        FigurePaper.of(figures)


def plain() -> Figure:
    with printed_on(FigurePaper(3.0)), page(2.0) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [1, 2], label="a")
        axes.set_ylabel("a long name\nin three\nlines")
    return figure


def test_a_page_is_laid_out_once_with_room_for_its_names_and_has_the_same_bytes_on_every_run() -> None:
    figure = plain()
    place = figure.axes[0].get_position().bounds
    with printed_on(FigurePaper(3.0)), page(2.0) as other:
        other.subplots().plot([0, 1], [1, 2])
    assert place[0] > other.axes[0].get_position().x0 + 0.05
    with matplotlib.rc_context({"savefig.dpi": 50, "font.size": 30}):  # of the caller's own
        found = images(figure)
    assert figure.axes[0].get_position().bounds == place
    assert images(plain()) == found
    with Image.open(io.BytesIO(found["png"])) as picture:
        assert picture.size == (600, 400)
    assert found["pdf"].startswith(b"%PDF")
    assert b"CreationDate" not in found["pdf"]
    assert b"/Type3" not in found["pdf"]  # fonts that a journal takes


def test_matplotlib_is_imported_where_a_figure_is_drawn_and_by_no_module() -> None:
    for path in Path(staf_torch.__file__).parent.rglob("*.py"):
        assert not re.search("^(import|from) matplotlib", path.read_text(encoding="utf-8"), re.M), path
