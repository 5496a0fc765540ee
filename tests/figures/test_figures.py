"""The figures: panels, one style, and the same bytes on every run."""

from __future__ import annotations

import io
import pkgutil
import subprocess
import sys

import matplotlib
import numpy as np
from command_line import environment
from matplotlib.figure import Figure
from PIL import Image

from staf_torch import figures
from staf_torch.figures.chase import ConvergenceCurve, draw_convergence
from staf_torch.figures.style import colour, curves, dash, images, keep_figures, marker, page


def test_images_are_the_same_on_every_run_a_png_and_a_pdf_with_fonts_that_a_journal_takes() -> None:
    step = np.array([0.01, 0.02])
    lines = [ConvergenceCurve("exact x1", step, step**2, 2.0), ConvergenceCurve("x3", step, step, None)]
    drawn, again = (images(draw_convergence(lines)) for _ in range(2))
    assert drawn == again
    assert drawn["png"].startswith(b"\x89PNG")
    assert drawn["pdf"].startswith(b"%PDF")
    assert b"/Type3" not in drawn["pdf"]


def test_the_style_is_ours_whatever_the_caller_has_set_and_is_taken_back() -> None:
    with matplotlib.rc_context({"font.size": 30, "axes.grid": False}):
        with page(3, 2) as figure:
            axes = figure.subplots()
            axes.set_xlabel("time (s)")
        assert axes.xaxis.label.get_size() == 8
        assert matplotlib.rcParams["font.size"] == 30


def plain() -> Figure:
    with page(3.0, 2.0) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [1, 2], label="a")
        axes.set_ylabel("a long name\nin three\nlines")
    return figure


def test_a_page_is_laid_out_once_with_room_for_its_names() -> None:
    figure = plain()
    (axes,) = figure.axes
    place = axes.get_position().bounds
    with page(3.0, 2.0) as other:
        other.subplots().plot([0, 1], [1, 2])
    assert place[0] > other.axes[0].get_position().x0 + 0.05
    with matplotlib.rc_context({"savefig.dpi": 50, "font.size": 30}):  # of the caller's own
        found = images(figure)
    assert axes.get_position().bounds == place
    with Image.open(io.BytesIO(found["png"])) as picture:
        assert picture.size == (600, 400)
    assert b"CreationDate" not in found["pdf"]


def test_figures_are_kept_while_it_is_asked_for_and_not_after() -> None:
    figure = plain()
    with keep_figures() as kept:
        drawn = images(figure)
        with keep_figures() as inner:
            images(figure)
    images(figure)
    assert kept == [(figure, drawn["png"])]
    assert len(inner) == 1


def test_seven_curves_have_a_colour_each_and_every_curve_its_name() -> None:
    assert len({colour(i) for i in range(7)}) == 7
    assert len({(colour(i), dash(i), marker(i)) for i in range(28)}) == 28
    axes, values = Figure().subplots(), np.arange(12.0).reshape(4, 3)
    curves(axes, np.arange(4.0), values, "$x_{%d}$")
    assert [line.get_label() for line in axes.get_lines()] == ["$x_{1}$", "$x_{2}$", "$x_{3}$"]
    np.testing.assert_array_equal([line.get_ydata() for line in axes.get_lines()], values.T)


def test_no_room_of_figures_imports_matplotlib_before_the_first_is_drawn() -> None:
    rooms = ", ".join(f"staf_torch.figures.{name.name}" for name in pkgutil.iter_modules(figures.__path__))
    program = f"import sys, {rooms}; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", program], env=environment(), check=True)
