"""The one style: page, colours, legends, panels and images, whatever is drawn."""

from __future__ import annotations

import io
import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from command_line import environment
from matplotlib.figure import Figure
from recorded import Record

from staf_torch.figures import closed_loop, style

ROOMS = ("adaptation", "animation", "chase", "closed_loop", "rivals", "safety", "style", "sweep", "theory")


def plain() -> Figure:
    with style.page(3.0, 2.0) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [1, 2], label="a")
        axes.set_ylabel("a long name\nin three\nlines")
    return figure


def test_the_style_is_the_recorded(record: Record) -> None:
    record({name: repr(value) for name, value in style.STYLE.items()})
    shown = [(style.colour(i), style.dash(i), style.marker(i)) for i in range(9)]
    assert [row[0] for row in shown].index(style.colour(7)) == 0
    assert len({row[0] for row in shown}) == 7
    assert len({row[1] for row in shown}) == 4
    assert len({row[2] for row in shown}) == 8


def test_a_page_is_laid_out_once_for_all() -> None:
    figure = plain()
    assert figure.get_layout_engine() is None
    assert figure.get_size_inches().tolist() == [3.0, 2.0]
    (axes,) = figure.axes
    place = axes.get_position().bounds
    with style.page(3.0, 2.0) as other:
        other.subplots().plot([0, 1], [1, 2])
    assert place[0] > other.axes[0].get_position().x0 + 0.05  # room for the long name
    style.images(figure)
    assert axes.get_position().bounds == place


def test_a_picture_has_two_hundred_points_an_inch_and_a_pdf_no_date() -> None:
    from PIL import Image

    figure = plain()
    with matplotlib.rc_context({"savefig.dpi": 50, "font.size": 30}):
        found = style.images(figure)
    assert list(found) == ["png", "pdf"]
    with Image.open(io.BytesIO(found["png"])) as picture:
        assert picture.size == (600, 400)
    assert b"CreationDate" not in found["pdf"]
    assert b"/MediaBox [ 0 0 216 144 ]" in found["pdf"]


def test_figures_are_kept_while_it_is_asked_for_and_not_after() -> None:
    figure = Figure()
    with style.keep_figures() as kept:
        drawn = style.images(figure)
        with style.keep_figures() as inner:
            style.images(figure)
        style.images(figure)
    style.images(figure)
    assert kept == [(figure, drawn["png"])] * 2
    assert len(inner) == 1


@pytest.mark.parametrize(("count", "columns", "rows"), [(1, 1, 1), (4, 2, 2), (5, 2, 3), (5, 3, 2)])
@pytest.mark.parametrize("share", [False, True])
def test_panels_are_in_rows_of_which_the_last_may_be_shorter(
    count: int, columns: int, rows: int, share: bool
) -> None:
    figure = Figure()
    grid = style.subplots(figure, count, columns, sharex=share, sharey=not share)
    assert len(grid) == count
    assert [axes.get_visible() for axes in figure.axes] == [True] * count + [False] * (rows * columns - count)
    assert grid[0].get_subplotspec().get_gridspec().get_geometry() == (rows, columns)
    grid[0].set(xlim=(3, 4), ylim=(5, 6))
    for axes in grid[1:]:
        assert (axes.get_xlim() == (3, 4)) is share
        assert (axes.get_ylim() == (5, 6)) is not share
    alone = style.subplots(Figure(), 2, 2)
    alone[0].set(xlim=(3, 4), ylim=(5, 6))
    assert alone[1].get_xlim() == alone[1].get_ylim() == (0, 1)


@pytest.mark.parametrize(("count", "most", "above", "of_all"), [(2, 6, 2, 2), (5, 3, 5, 3), (7, 6, 5, 6)])
def test_legends_have_few_columns(count: int, most: int, above: int, of_all: int) -> None:
    figure = Figure()
    axes = figure.subplots()
    for i in range(count):
        axes.plot([0, 1], [i, i], label=str(i))
    style.legend_above(axes, count)
    assert axes.get_legend()._ncols == above
    style.legend_of_all(figure, axes, most)
    (legend,) = figure.legends
    assert legend._ncols == of_all
    assert [text.get_text() for text in legend.get_texts()] == [str(i) for i in range(count)]


def test_letters_go_through_the_panels_with_a_title_where_there_are_titles() -> None:
    grid = list(Figure().subplots(1, 3))
    style.letter(grid)
    assert [axes.get_title(loc="left") for axes in grid] == ["(a)", "(b)", "(c)"]
    style.letter(grid, "x", "y", "z")
    assert [axes.get_title(loc="left") for axes in grid] == ["(a) x", "(b) y", "(c) z"]


def test_ticks_are_exactly_the_given_ones_as_plain_numbers() -> None:
    axes = Figure().subplots()
    axes.set(xscale="log", yscale="log", xlim=(0.01, 10), ylim=(0.01, 10))
    style.ticks(axes, "x", iter((0.02, 1.0, 3)))
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0.02", "1", "3"]
    assert (len(axes.get_xticks(minor=True)), len(axes.get_yticks(minor=True)) > 0) == (0, True)
    style.ticks(axes, "y", (0.5,))
    assert axes.get_yticks().tolist() == [0.5]
    assert axes.get_xticks().tolist() == [0.02, 1.0, 3.0]
    assert len(axes.get_yticks(minor=True)) == 0


def test_a_number_that_is_not_positive_is_a_gap() -> None:
    np.testing.assert_array_equal(
        style.positive(np.array([-1.0, 0.0, 1e-300, 2.0])), [np.nan, np.nan, 1e-300, 2]
    )


def test_columns_are_drawn_each_in_its_look_and_counted_from_one() -> None:
    axes = Figure().subplots()
    values = np.arange(12.0).reshape(4, 3)
    style.curves(axes, np.arange(4.0), values, "$x_{%d}$")
    for i, line in enumerate(axes.get_lines()):
        assert (line.get_label(), line.get_color()) == (f"$x_{{{i + 1}}}$", style.colour(i))
        assert line.get_linestyle() == style.dash(i)
        np.testing.assert_array_equal(line.get_ydata(), values[:, i])


def test_no_room_of_figures_imports_matplotlib_before_the_first_is_drawn() -> None:
    rooms = ", ".join(f"staf_torch.figures.{name}" for name in ROOMS)
    program = f"import sys, {rooms}; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], env=environment(), check=True)


@pytest.mark.parametrize(("count", "columns"), [(5, 5), (6, 3), (7, 4)])
def test_names_of_many_curves_stand_in_two_rows_that_end_in_the_corner(count: int, columns: int) -> None:
    axes = Figure().subplots()
    closed_loop._lines(axes, np.arange(3.0), np.ones((3, count)), "weights", "w%d")
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == [f"w{i + 1}" for i in range(count)]
    assert legend._ncols == columns
    corner = legend.get_bbox_to_anchor().transformed(axes.transAxes.inverted()).p0
    np.testing.assert_allclose(corner, (1.0, 1.0), atol=1e-12)
