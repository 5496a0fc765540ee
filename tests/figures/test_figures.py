"""The figures: panels, scales, and the same bytes on every run."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from staf_torch.figures.chase import ChaseHistory, ConvergenceCurve, draw_chase, draw_convergence
from staf_torch.figures.closed_loop import AdpHistory, draw_adp
from staf_torch.figures.style import colour, dash, images, marker, page


def _history(count: int, dim: int = 2, lost: bool = False) -> ChaseHistory:
    time = np.linspace(0, 1, 50)
    wave = np.sin(time[:, None] + np.arange(10))
    excess = np.abs(wave[:, 0]) * 1e-3
    excess[7] = 0.0
    if lost:
        excess[30:] = np.nan
    return ChaseHistory(
        time=time,
        state=wave[:, :dim],
        value=wave[:, 0],
        estimate=wave[:, 0] + 1e-3,
        ideal_estimate=wave[:, 0] + 1e-4,
        weights=wave[:, :count],
        ideal_weights=wave[:, :count],
        excess=excess,
    )


@pytest.mark.parametrize(("count", "dim", "lost"), [(3, 2, False), (10, 1, False), (3, 5, True)])
def test_a_chase_has_four_panels(count: int, dim: int, lost: bool) -> None:
    figure = draw_chase(_history(count, dim, lost))
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["(a)", "(b)", "(c)", "(d)"]
    assert figure.axes[3].get_yscale() == "log"


def test_images_are_the_same_on_every_run_a_png_and_a_pdf_with_fonts_that_a_journal_takes() -> None:
    step = np.array([0.01, 0.02])
    curves = [ConvergenceCurve("exact x1", step, step**2, 2.0), ConvergenceCurve("x3", step, step, None)]
    drawn, again = (images(draw_convergence(curves)) for _ in range(2))
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


@pytest.mark.parametrize(("weights", "known", "panels"), [(3, True, 6), (0, False, 3), (0, True, 5)])
def test_a_closed_loop_has_a_panel_for_all_that_is_known(weights: int, known: bool, panels: int) -> None:
    time = np.linspace(0, 1, 20)
    wave = np.sin(time[:, None] + np.arange(8))
    error = np.abs(wave[:, 0]) if known else None
    figure = draw_adp(
        AdpHistory(
            time, wave[:, :2], wave[:, :1], wave[:, :weights], wave[:, :weights], time, error, error, None
        )
    )
    visible = [axes for axes in figure.axes if axes.get_visible()]
    assert len(visible) == panels
    assert all(axes.get_xlabel() == "time (s)" and axes.get_ylabel() for axes in visible)


def test_a_slope_that_is_not_known_is_a_dash() -> None:
    step = np.array([0.01, 0.02])
    figure = draw_convergence([ConvergenceCurve("exact x1", step, step**2, None)])
    (legend,) = [axes.get_legend() for axes in figure.axes]
    assert [text.get_text() for text in legend.get_texts()] == ["exact x1: -"]


def test_colours_dashes_and_markers_begin_again() -> None:
    assert (colour(7), dash(4), marker(8)) == (colour(0), dash(0), marker(0))
