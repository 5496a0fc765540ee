"""Figures of what is seldom drawn: many panels, histories with parts missing, thresholds of legends."""

from __future__ import annotations

import base64
import io
import json
import re

import numpy as np
import pytest
from figures.drawing import (
    T,
    legend,
    lines,
    visible,
    wave,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from staf_torch.figures import adaptation, animation, closed_loop, rivals, safety, sweep, theory
from staf_torch.figures.animation import Curves, Scene, _Stage

pytestmark = pytest.mark.usefixtures("not_laid_out", "looks_are_the_recorded")


def labelled(axes: Axes) -> tuple[bool, bool]:
    """Whether the numbers below, and those on the left, are shown."""
    below, left = (axis.get_major_ticks()[0].label1.get_visible() for axis in (axes.xaxis, axes.yaxis))
    return below, left


def test_bounds_of_many_radii_are_in_rows_of_four_with_names_at_the_left_and_at_the_bottom() -> None:
    epsilons = 0.5 ** np.arange(13)
    radii = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    row = {"count": 1000.0, "one_polynomial_count": 30.0, "measured_count": None}
    figure = theory.draw_exponential_bound({(r, e): row for r in radii for e in epsilons})
    panels = visible(figure)
    assert [axes.get_title() for axes in panels] == [f"$r = {r:g}$" for r in radii]
    places = [axes.get_subplotspec().num1 for axes in panels]
    assert places == [0, 1, 2, 3, 4, 5]
    assert panels[0].get_subplotspec().get_gridspec().get_geometry() == (2, 4)
    assert [axes.get_ylabel() for axes in panels] == ["kernels $M$", "", "", "", "kernels $M$", ""]
    assert [bool(axes.get_xlabel()) for axes in panels] == [False, False, True, True, True, True]
    assert [labelled(axes)[0] for axes in panels] == [False, False, True, True, True, True]
    counts = [label.get_text() for label in panels[0].get_yticklabels()]
    assert counts == ["1", "2", "3", "6", "10", "20", "50", "100", "200", "500", "1000"]
    assert [label.get_text() for label in panels[4].get_xticklabels()] == [
        f"${e:g}$" if e < 1 else "$10^{0}$" for e in sorted(epsilons)[::3]
    ]
    assert len(panels[0].get_xticks(minor=True)) == len(panels[0].get_yticks(minor=True)) == 0


def test_counts_that_are_small_have_small_ticks_and_no_more_than_six_values_are_all_named() -> None:
    epsilons = (0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
    row = {"count": 3.0, "one_polynomial_count": 2.0, "measured_count": None}
    (axes,) = visible(theory.draw_exponential_bound({(0.1, e): row for e in epsilons}))
    assert [label.get_text() for label in axes.get_yticklabels()] == ["1", "2", "3"]
    names = [label.get_text() for label in axes.get_xticklabels()]
    assert names == ["$10^{-1}$", "$0.2$", "$0.3$", "$0.4$", "$0.5$", "$0.6$"]


@pytest.mark.parametrize("sizes", [(1.0, 1.009), (1.0, 1.02)])
def test_an_arc_may_leave_its_circle_by_a_hundredth(sizes: tuple[float, float]) -> None:
    angles = np.linspace(0.0, 4.0, 9)
    state = np.stack((np.cos(angles), np.sin(angles)), -1) * np.linspace(*sizes, 9)[:, None]
    found = theory.Feasibility(T, state, 0.5, T[:1], T[:1], np.array([3]), np.ones((1, 9)), np.ones((1, 1)))
    left, right = visible(theory.draw_feasibility(found))
    circle = sizes[1] < 1.01
    assert left.get_xlabel() == ("angle passed on the circle (degrees)" if circle else "time (s)")
    np.testing.assert_allclose(lines(left)[0][1], np.degrees(angles) if circle else T)
    assert labelled(right)[1] is False
    solid = found._replace(state=np.concatenate((state, 0 * state[:, :1]), axis=1))
    assert visible(theory.draw_feasibility(solid))[0].get_xlabel() == "time (s)"
    still = found._replace(state=0 * state)  # no circle either
    assert visible(theory.draw_feasibility(still))[0].get_xlabel() == "time (s)"


def test_values_of_epsilon_are_named_six_in_a_row() -> None:
    for count, columns in ((6, 6), (7, 6)):
        epsilons = 0.5 ** np.arange(count)
        needed = np.full((count, 9), 3.0)
        found = theory.Feasibility(
            T, np.ones((9, 3)), 0.5, T[:1], epsilons, np.array([3]), needed, needed[:, :1].T
        )
        assert theory.draw_feasibility(found).legends[0]._ncols == columns


def test_methods_in_a_box_are_named_three_in_a_row() -> None:
    paths, margins, costs = ({name: wave(9, *size) for name in "abcd"} for size in ((2,), (), ()))
    nowhere = np.full(2, np.inf)
    figure = safety.draw_box(safety.BoxHistory(T, paths, margins, costs, wave(9, 2), -nowhere, nowhere))
    assert legend(figure) == list("abcd")
    assert figure.legends[0]._ncols == 3


def test_without_rings_the_layouts_of_the_ball_are_drawn_against_the_radius_and_the_largest_polygon() -> None:
    radii = np.array([0.1, 0.2, 0.4])
    tried = ("ball", 3), ("ball", 5), ("polygon", 3), ("polygon", 7), ("cross_polytope", 4)
    found = [
        theory.LayoutCurve(family, count, 2, 0.1 * (k + 1), wave(3) + k, 1.0 + k)
        for k, (family, count) in enumerate(tried)
    ]
    left, right = visible(theory.draw_layouts(found, 0.2, radii))
    assert [name for name, *_ in lines(left)] == ["ball", "polygon", "cross-polytope"]
    assert [name for name, *_ in lines(right)] == ["ball, 3: 1.00", "ball, 5: 2.00", "polygon, 7: 4.00"]
    assert legend(right) == [name for name, *_ in lines(right)]
    assert [label.get_text() for label in left.get_xticklabels()] == ["3", "5"]


def test_errors_in_two_rows_have_their_names_at_the_edges() -> None:
    errors = {"old": [0.5, 0.3], "new": [0.1, 0.2]}
    panels = [theory.ErrorPanel(str(k), 1e-8, [0.1, 0.01], errors) for k in range(6)]
    figure = theory.draw_errors(panels, 2)
    grid = visible(figure)
    assert grid[0].get_subplotspec().get_gridspec().get_geometry() == (2, 3)
    label = r"relative error of $\hat V$"
    assert [axes.get_ylabel() for axes in grid] == [label, "", "", label, "", ""]
    assert [axes.get_xlabel() for axes in grid] == ["", "", "", *["radius $r$"] * 3]
    assert [labelled(axes) for axes in grid] == [(k > 2, k % 3 == 0) for k in range(6)]
    assert [axes.get_title(loc="left") for axes in grid] == [f"({chr(97 + k)}) {k}" for k in range(6)]


@pytest.mark.parametrize("known", [200, 201])
def test_up_to_two_hundred_known_errors_are_marked(known: int) -> None:
    time = np.linspace(0.0, 1.0, 300)
    error = np.full(300, np.nan)
    error[:known] = wave(known)
    error[3] = 0.0  # a gap
    history = closed_loop.AdpHistory(time, *[wave(300, 1)] * 4, wave(300), error, None, 3.0)
    panels = visible(closed_loop.draw_adp(history))
    assert len(panels) == 5
    assert panels[3].get_ylabel() == r"$|u - u^*|$"
    (line,) = panels[3].get_lines()
    assert line.get_marker() == ("." if known == 200 else "")
    np.testing.assert_array_equal(line.get_ydata(), np.where(error[:known] > 0, error[:known], np.nan))
    assert panels[3].get_subplotspec().get_gridspec().get_geometry() == (3, 2)


def test_methods_beyond_seven_are_dashed_in_a_comparison() -> None:
    ratios = {str(k): 1.1 + 0.1 * np.arange(3) for k in range(9)}
    (axes,) = visible(closed_loop.draw_comparison(ratios))
    assert [line.get_linestyle() for line in axes.get_lines()] == [*["-"] * 7, "--", "--"]
    assert len({(line.get_color(), line.get_linestyle()) for line in axes.get_lines()}) == 9


def test_discs_are_drawn_up_to_the_first_time_of_the_second_half() -> None:
    time = np.linspace(0.0, 3.0, 31)
    paths = {"a": wave(31, 2)}
    history = safety.AvoidanceHistory(
        time, paths, wave(31, 1, 2), 0.3, {"a": wave(31)}, {"a": wave(31)}, {"a": wave(3)}
    )
    plane = visible(safety.draw_avoidance(history))[0]
    shown = [0, 4, 8, 11, 15]
    np.testing.assert_array_equal([disc.center for disc in plane.patches], history.discs[shown, 0])
    assert [round(float(disc.get_facecolor()[0]), 3) for disc in plane.patches] == [
        0.92,
        0.84,
        0.76,
        0.68,
        0.6,
    ]
    np.testing.assert_array_equal(plane.get_lines()[1].get_xdata(), paths["a"][shown, 0])


@pytest.mark.parametrize(("size", "room"), [(0.1, 0.3), (5.0, 1.5)])
@pytest.mark.parametrize("last", [1.5, 2.5])
def test_parameters_have_room_around_them_and_the_first_two_seconds(
    size: float, room: float, last: float
) -> None:
    time = np.linspace(0.0, last, 9)
    truth = 4.0 + size * np.linspace(0.0, 1.0, 9)[:, None]
    case = adaptation.FaultPicture(time, {"a": wave(9)}, wave(9, 1), truth, np.ones(9, dtype=bool))
    above, below = visible(adaptation.draw_faults({"one": case}))
    assert below.get_ylim() == pytest.approx((4.0 - room, 4.0 + size + room))
    assert below.get_xlim() == pytest.approx((0.0, min(last, 2.0)))
    assert above.get_xlim() == pytest.approx((0.0, last))


@pytest.mark.parametrize("plants", [1, 5])
def test_names_of_rivals_are_at_the_left_and_where_no_panel_is_below(plants: int) -> None:
    rows = [
        {"plant": str(k), "method": "a", "us_median": 2.0, "ratio_median": 3.0, "regulated": 1.0}
        for k in range(plants)
    ]
    panels = visible(rivals.draw_rivals(rows))
    across = min(plants, 3)
    assert panels[0].get_subplotspec().get_gridspec().get_geometry() == (-(-plants // 3), across)
    assert [bool(axes.get_ylabel()) for axes in panels] == [k % across == 0 for k in range(plants)]
    below = [k + across >= plants for k in range(plants)]
    assert [bool(axes.get_xlabel()) for axes in panels] == below
    assert [labelled(axes)[0] for axes in panels] == below
    assert {(axes.get_xlim(), axes.get_ylim()) for axes in panels} == {
        (panels[0].get_xlim(), panels[0].get_ylim())
    }


def _sweep_panels(count: int, *, curves: int = 1, spread: float = 1.3) -> list[sweep.Panel]:
    points = tuple(sweep.Point(x, x, x / spread, x * spread) for x in (0.1, 0.2))
    return [
        sweep.Panel(f"kernel {k}", tuple(sweep.Curve(f"{i} centers", points) for i in range(curves)))
        for k in range(count)
    ]


@pytest.mark.parametrize(
    ("count", "curves", "columns"), [(1, 2, 3), (1, 3, 2), (1, 6, 3), (2, 5, 6), (2, 6, 4), (4, 11, 6)]
)
def test_the_legend_of_a_sweep_has_rows_of_equal_length(count: int, curves: int, columns: int) -> None:
    figure = sweep.draw_error_against_radius(_sweep_panels(count, curves=curves), None)
    assert legend(figure) == [*[f"{i} centers" for i in range(curves)], "95 % over seeds"]
    assert figure.legends[0]._ncols == columns
    grid = visible(figure)
    assert grid[0].get_subplotspec().get_gridspec().get_geometry() == (-(-count // 3), min(count, 3))
    assert [bool(axes.get_ylabel()) for axes in grid] == [k % 3 == 0 for k in range(count)]


@pytest.mark.parametrize(("spread", "seen"), [(1.09, False), (1.11, True)])
def test_a_band_is_named_where_its_ends_are_a_fifth_apart(spread: float, seen: bool) -> None:
    figure = sweep.draw_cost_against_accuracy(_sweep_panels(1, spread=spread))
    assert ("95 % over seeds" in legend(figure)) is seen


@pytest.mark.parametrize(
    ("low", "bottom"), [(2.0, 0.1 / 3), (0.2, 0.05), (1e-8, 2.5e-9), (2e-11, 0.1 / 3), (0.13, 0.13 / 4)]
)
def test_the_frame_of_errors_is_half_a_decade_and_what_lies_near_below(low: float, bottom: float) -> None:
    curve = sweep.Curve("3 centers", (sweep.Point(0.1, 0.1, 0.1, 0.1), sweep.Point(0.2, 0.3, 0.3, 0.3)))
    floor = (sweep.Point(0.1, low, low, low), sweep.Point(0.2, np.inf, 1.0, 1.0))
    figure = sweep.draw_error_against_radius([sweep.Panel("a", (curve._replace(floor=floor),))], None)
    low_end, top = figure.axes[0].get_ylim()
    assert top == pytest.approx(0.9)
    assert low_end == pytest.approx(min(bottom, 0.1 / 3, 0.1 / 4))


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (0.0099, "9.9e-3"),
        (0.01, "0.01"),
        (999.0, "1e+03"),
        (1000.0, "1.0e3"),
        (1e-12, "1.0e-12"),
        (12.3, "12"),
    ],
)
def test_a_cell_of_a_map_has_two_digits(error: float, said: str) -> None:
    assert sweep._short(error) == said


def test_maps_in_several_rows_have_their_names_at_the_left() -> None:
    one = sweep.HeatMap("k", (0.1,), (3, 6), ((1e-3,), (1.0,)))
    figure = sweep.draw_heat_maps([one._replace(title=str(k)) for k in range(4)])
    *grid, _ = visible(figure)
    assert [axes.get_title(loc="left") for axes in grid] == ["0", "1", "2", "3"]
    assert grid[0].get_subplotspec().get_gridspec().get_geometry() == (2, 3)
    assert [axes.get_ylabel() for axes in grid] == ["centers $M$", "", "", "centers $M$"]
    assert all(axes.images[0].norm.vmin == 1e-3 and axes.images[0].norm.vmax == 1.0 for axes in grid)
    assert all(axes.images[0].origin == "lower" and axes.get_aspect() == "auto" for axes in grid)


# Animations

BARE = Scene(
    *("title", T, wave(9, 2), wave(9, 0, 2), np.zeros(9), Curves("control", wave(9, 1), None)),
    *(np.linspace(-1, 1, 5), None, None, None),
)


def stage(scene: Scene, frame: int) -> Figure:
    figure = Figure()
    _Stage(figure, scene).show(frame)
    return figure


def test_a_scene_without_values_has_no_panel_of_them() -> None:
    figure = stage(BARE, 3)
    plane, across, curves = figure.axes
    assert across.get_visible() is False
    assert across.get_legend() is None
    assert plane.patches[-1].radius == 0
    ((_, x, y), *rest) = lines(plane)
    np.testing.assert_array_equal((x, y), BARE.state[:4].T)
    assert [len(part[1]) for part in rest] == [0, 1]
    (now,) = lines(curves)
    np.testing.assert_array_equal(now[2], BARE.curves.values[:4, 0])
    low, high = BARE.curves.values.min(), BARE.curves.values.max()
    assert curves.get_ylim() == pytest.approx((low - 0.08 * (high - low), high + 0.08 * (high - low)))
    low, high = BARE.state[:, 0].min(), BARE.state[:, 0].max()
    assert plane.get_xlim() == pytest.approx((low - 0.08 * (high - low), high + 0.08 * (high - low)))


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("known", ["value", "estimate"])
def test_one_of_both_values_is_drawn_alone(known: str, relative: bool) -> None:
    values = wave(9, 5) - (1.5 if known == "estimate" else 0.0)
    scene = BARE._replace(relative=relative, **{known: values})
    across = stage(scene, 2).axes[1]
    assert across.get_visible()
    ((name, x, y),) = lines(across)
    name_of_value = "$V^*$" if relative else "$V$"
    assert name == (name_of_value if known == "value" else r"$\hat V$")
    assert legend(across) == [name]
    unit = np.abs(values[2]).max() if relative else 1.0
    np.testing.assert_allclose(x, scene.along)
    np.testing.assert_allclose(y, values[2] / unit)
    low, high = values.min(), values.max()
    usual = low - 0.08 * (high - low), high + 0.08 * (high - low)
    wanted = (-0.15 if known == "value" else -1.15, 1.15) if relative else usual
    assert across.get_ylim() == pytest.approx(wanted)


def test_a_value_that_is_zero_in_the_whole_ball_is_drawn_as_it_is() -> None:
    scene = BARE._replace(value=np.zeros((9, 5)), estimate=wave(9, 5), relative=True)
    (_, zero), (_, found) = ((name, y) for name, _, y in lines(stage(scene, 1).axes[1]))
    assert not zero.any()
    np.testing.assert_array_equal(found, scene.estimate[1])


def test_levels_of_a_value_over_the_plane_set_its_limits() -> None:
    x, y = np.linspace(-2, 2, 9), np.linspace(-1, 3, 7)
    scene = BARE._replace(grid=(x, y, x[None, :] ** 2 + y[:, None] ** 2))
    plane = stage(scene, 0).axes[0]
    assert (plane.get_xlim(), plane.get_ylim()) == ((-2.0, 2.0), (-1.0, 3.0))
    levels = plane.collections[0].levels
    assert 10 <= len(levels) <= 16
    assert stage(BARE, 0).axes[0].collections == [] or not len(stage(BARE, 0).axes[0].collections)


@pytest.mark.parametrize(
    ("values", "more", "limits"),
    [
        ([2.0, 2.0], 0.0, (1.0, 3.0)),
        ([1.0, np.nan, 3.0], 0.5, (0.26, 3.74)),
        ([-1.0, 1.0], 0.0, (-1.16, 1.16)),
    ],
)
def test_limits_leave_room_at_both_ends(
    values: list[float], more: float, limits: tuple[float, float]
) -> None:
    assert animation._limits(np.array(values), more) == pytest.approx(limits)


def test_a_page_plays_ten_pictures_a_second_and_keeps_what_differs_from_the_first() -> None:
    from PIL import Image

    scene = BARE._replace(time=T[:3])
    text = animation.animate(scene, "html")["html"].decode()
    found = re.search(r"const pictures = (\[.*?\]);", text, re.DOTALL)
    assert found is not None
    pictures = json.loads(found[1])
    assert len(pictures) == 3
    assert "show(frame + 1); }, 100);" in text
    assert animation.FRAMES == 60  # of an experiment: six seconds
    opened = [Image.open(io.BytesIO(base64.b64decode(each))) for each in pictures]
    assert {picture.size for picture in opened} == {(900, 412)}
    shares = [np.asarray(picture.convert("RGBA"))[..., 3].astype(bool).mean() for picture in opened]
    assert shares[0] == 1.0
    assert all(0 < share < 0.2 for share in shares[1:])
    whole = np.asarray(opened[0].convert("RGBA"))[..., :3]
    assert len(np.unique(whole.reshape(-1, 3), axis=0)) <= 64
    shown = np.asarray(opened[2].convert("RGBA"))
    at = shown[..., 3] > 0
    assert (np.abs(shown[..., :3].astype(int) - whole)[at].sum(-1) > 0).mean() > 0.5
