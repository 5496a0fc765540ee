"""What a figure draws is what it was given: curves, scales, limits and names, read back from the axes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from figures.drawing import (
    LINEAR_LOG,
    LOG,
    Curve,
    T,
    holds,
    legend,
    lines,
    span,
    visible,
    wave,
)
from matplotlib.figure import Figure

from staf_torch.figures import chase, closed_loop, sweep
from staf_torch.figures.animation import AnimationStage, Curves, Scene
from staf_torch.figures.style import positive

pytestmark = pytest.mark.usefixtures("not_laid_out")


class Drawn(NamedTuple):
    """A figure, and what it must show."""

    figure: Figure
    curves: list[tuple[Any, Any]]  # times and values: (T,), or (T, k) for a curve a column
    panels: list[str]  # names of their vertical axes
    names: list[str]  # of curves, in their order


def of_a_chase() -> Drawn:
    parts = [wave(9, 2), wave(9), wave(9) + 0.1 * T, wave(9) + 0.01 * T, wave(9, 2), wave(9, 2) + 1]
    excess = np.where(np.arange(9) == 3, 0.0, wave(9))
    errors = [0.1 * T, 0.01 * T, positive(excess)]  # on a logarithmic axis
    names = ["$x_{1}$", "$x_{2}$", "$V(x)$", r"$\hat V(x)$"]
    names += ["$a_{1}$", "$a_{2}$"]
    names += ["ideal $w$", r"$|V - \hat V|$", "of ideal $w$", "$F(a) - F(w)$"]
    figure = chase.draw_chase(chase.ChaseHistory(T, *parts, excess))
    shown = [(T, values) for values in (*parts[:3], *parts[4:], *errors)]
    return Drawn(figure, shown, ["state $x$", "value", "weights", "error at $x$; excess $F$"], names)


def of_a_loop(weights: int, shooting: bool) -> Drawn:
    known = np.where(np.arange(9) % 2, wave(9), np.nan) if shooting else np.linspace(1, 2, 9)
    parts = [wave(9, 2), wave(9, 1), wave(9, weights), wave(9, weights) + 1, wave(9)]
    figure = closed_loop.draw_adp(
        closed_loop.AdpHistory(T, *parts, known, known + 1, 0.7 if shooting else None)
    )
    at = np.isfinite(known)
    shown = [(T, parts[0]), *((T, part) for part in (parts[2:4] if weights else parts[1:2])), (T, parts[4])]
    shown += [(T[at], known[at]), (T[at], known[at] + 1)] + [([0, 1], np.array([0.7, 0.7]))] * shooting
    middle = [r"actor $\hat W_a$", r"critic $\hat W_c$"] if weights else ["control $u$"]
    names = [rf"$\hat W_{{{kind},{i + 1}}}$" for kind in "ac" for i in range(weights)] or ["$u_{1}$"]
    names = names if weights < 7 else []
    names = ["$x_{1}$", "$x_{2}$", *names, "so far", *(["optimal, $V^*(x(0))$"] if shooting else [])]
    return Drawn(figure, shown, ["state $x$", *middle, "$|u - u^*|$", r"$|V^* - \hat V|$", "cost"], names)


def of_a_box() -> Drawn:
    paths, margins, costs = (
        {name: wave(9, *size) + k for k, name in enumerate("ab")} for size in ((3,), (), ())
    )
    walls = np.array([-1.0, -np.inf, 0.0]), np.array([np.inf, 4.0, 0.0])
    figure = closed_loop.draw_box(closed_loop.BoxHistory(T, paths, margins, costs, wave(9, 3), *walls))
    shown = [(path[:, 0], path[:, 1]) for path in paths.values()]
    shown += [(T, values) for values in (*margins.values(), *costs.values(), wave(9, 3))]
    shown += [([-1, -1], np.array([0, 1])), ([0, 1], np.array([4, 4]))]  # the walls that there are
    panels = ["$x_2$", "distance to a wall", "barrier coordinates $s$", "cost of $s$ so far"]
    return Drawn(figure, shown, panels, [*"abab", *(f"$s_{{{i + 1}}}$" for i in range(3)), *"ab"])


def of_faults() -> Drawn:
    cases = {
        name: closed_loop.FaultPicture(
            T, {"a": wave(9) + k, "b": wave(9) + 2}, wave(9, 2), wave(9, 2) + k, np.arange(9) > 3
        )
        for k, name in enumerate(("loss", "gain"))
    }
    figure = closed_loop.draw_faults(cases)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["(a) loss", "(b) loss, first 2 s", "(c) gain", "(d) gain, first 2 s"]
    each = [(*case.norms.values(), case.parameters, case.truth) for case in cases.values()]
    panels = ["$|x|$", r"parameters $\hat\theta$"] * 2
    names = ["a", "b", "estimates", "true"] * 2
    return Drawn(figure, [(T, values) for case in each for values in case], panels, names)


FIGURES: dict[str, Callable[[], Drawn]] = {
    "a chase": of_a_chase,
    "a loop that learns": lambda: of_a_loop(3, True),
    "a loop of many functions": lambda: of_a_loop(7, False),
    "a feedback": lambda: of_a_loop(0, False),
    "a box": of_a_box,
    "faults": of_faults,
}


CROWDED = {"a chase", "a loop that learns", "faults"}
"""Those whose legends and names are looked at in a column of 3.4 inches, laid out."""


@pytest.mark.parametrize("circle", [True, False])
def test_feasibility_is_drawn_along_the_arc_or_over_time(circle: bool) -> None:
    angles = np.linspace(3.0, -1.0, 9)
    state = np.stack((np.cos(angles), np.sin(angles)), -1) * (2.0 if circle else T[:, None])
    pointwise, overall = np.array([[3.0] * 8 + [0], [6.0] * 9]), np.array([[3.0, 6], [0, 10]])
    radii, epsilons = np.array([0.1, 0.5]), np.array([0.1, 0.003])
    counts = np.array([3, 6, 10])
    found = chase.Feasibility(T, state, 0.5, radii, epsilons, counts, pointwise, overall)
    figure = chase.draw_feasibility(found)
    left, right = visible(figure)
    labels = "$\\epsilon = 10^{-1}$", "$\\epsilon = 0.003$"
    place = np.degrees(3.0 - angles) if circle else T
    names = "angle passed on the circle (degrees)" if circle else "time (s)", "centers $M$"
    curves = [(label, place, positive(pointwise[i])) for i, label in enumerate(labels)]
    holds(left, curves, names, scales=LINEAR_LOG, xlim=span(place))
    curves = [(label, radii, positive(overall[:, i])) for i, label in enumerate(labels)]
    holds(right, curves, ("radius $r$ of the ball", ""), scales=LOG)
    assert [label.get_text() for label in left.get_yticklabels()] == ["3", "6", "10"]
    assert [label.get_text() for label in right.get_xticklabels()] == ["0.1", "0.5"]
    titles = [axes.get_title(loc="left") for axes in (left, right)]
    assert titles == ["(a) at each state, $r = 0.5$", "(b) along the whole trajectory"]
    assert legend(figure) == list(labels)


def test_a_failure_is_a_mark_and_an_exact_result_a_tenth_of_rounding() -> None:
    radius = [0.1, 0.01, 0.001]
    errors = {"old": [0.5, np.inf, np.inf], "new": [0.1, 0.0, np.inf]}
    panels = [chase.ErrorPanel(title, 1e-8, radius, errors) for title in ("float32", "float64")]
    figure = chase.draw_errors(panels, 1)
    for n, axes in enumerate(visible(figure)):
        curves = [
            ("old", radius, [0.5, np.nan, np.nan]),
            ("fails (in its colour)", [0.01, 0.001], [1, 1]),
            ("new", radius, [0.1, 1e-9, np.nan]),
            ("fails (in its colour)", [0.001], [4]),
            (r"$\varepsilon$ of the dtype", [0, 1], [1e-8, 1e-8]),
        ]
        names = "radius $r$", "" if n else r"relative error of $\hat V$"
        holds(axes, curves, names, scales=LOG, ylim=(5e-10, 12.0))
        assert axes.get_title(loc="left") == ("(b) float64" if n else "(a) float32")
    assert legend(figure) == ["old", "new", "fails (in its colour)", r"$\varepsilon$ of the dtype"]


def _panels(spread: float) -> list[sweep.Panel]:
    def points(factor: float) -> tuple[sweep.Point, ...]:
        return tuple(sweep.Point(x, factor * x, factor * x / spread, factor * x * spread) for x in (0.1, 0.2))

    curves = (sweep.Curve("3 centers", points(1.0), points(0.1)), sweep.Curve("6 centers", points(0.5)))
    return [sweep.Panel("Gaussian kernel", curves), sweep.Panel("exponential kernel", curves[:1])]


@pytest.mark.parametrize(("spread", "rounding"), [(1.5, 4e-3), (1.0, 1e-13)])
def test_errors_of_a_sweep_are_drawn_with_their_bands(spread: float, rounding: float | None) -> None:
    panels, x = _panels(spread), np.array([0.1, 0.2])
    figure = sweep.draw_error_against_radius(panels, rounding)
    grid = visible(figure)
    told = ["rounding of $V$"] if rounding == 4e-3 else []  # far below all data it takes no room
    level: list[Curve] = [(text, [0, 1], [rounding] * 2) for text in told]
    three: list[Curve] = [("3 centers", x, x), ("ideal weights", x, 0.1 * x)]
    many = [*three, ("6 centers", x, 0.5 * x), *level]
    error = r"$\sup\,|V - \hat V|$"
    holds(grid[0], many, ("radius $r$ of the ball", error), scales=LOG)
    holds(grid[1], [*three, *level], ("radius $r$ of the ball", ""), scales=LOG)
    assert [axes.get_title(loc="left") for axes in grid] == ["Gaussian kernel", "exponential kernel"]
    band = grid[0].collections
    assert len(band) == (2 if spread > 1 else 0)
    for shade, factor in zip(band, (1.0, 0.5), strict=False):
        y = shade.get_paths()[0].vertices[:, 1]
        assert (y.min(), y.max()) == pytest.approx((factor * 0.1 / spread, factor * 0.2 * spread))
    assert grid[0].get_ylim()[0] > (2e-3 if told else 5e-3) / 2.1
    said = ["3 centers", "6 centers", "ideal weights", *told]
    assert legend(figure) == said + (["95 % over seeds"] if spread > 1.2**0.5 else [])
    costly = sweep.draw_cost_against_accuracy(panels, "multiplications")
    holds(costly.axes[0], many[:3], ("multiplications a simulated second", error), scales=LOG)


def test_a_map_shows_the_number_of_every_cell() -> None:
    shown = sweep.HeatMap("k", (0.1, 0.2, 0.4), (3, 6), ((1e-3, 2.5, None), (1234.0, 0.05, 1e-5)))
    axes, bar = visible(sweep.draw_heat_maps([shown]))
    assert {tuple(text.get_position()): text.get_text() for text in axes.texts} == {
        (0, 0): "1.0e-3",
        (1, 0): "2.5",
        (2, 0): "-",
        (0, 1): "1.2e3",
        (1, 1): "0.05",
        (2, 1): "1.0e-5",
    }
    (image,) = axes.images
    np.testing.assert_allclose(image.get_array().filled(np.nan), np.array(shown.errors, dtype=float))
    assert (image.norm.vmin, image.norm.vmax) == (1e-5, 1234.0)
    assert [label.get_text() for label in axes.get_xticklabels()] == ["0.1", "0.2", "0.4"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["3", "6"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("radius $r$ of the ball", "centers $M$")
    assert bar.get_ylabel() == r"$\sup\,|V - \hat V|$"
    (same, _) = visible(sweep.draw_heat_maps([sweep.HeatMap(*shown[:3], ((2.0,) * 3,) * 2)]))
    assert (same.images[0].norm.vmin, same.images[0].norm.vmax) == (2.0, 20.0)


SCENE = Scene(
    *("title", T, wave(9, 2), wave(9, 3, 2), wave(9)),
    Curves("weights", wave(9, 2), wave(9, 2) + 1),
    *(np.linspace(-1, 1, 5), wave(9, 5), wave(9, 5) + 1, None, wave(9, 2) + 2, wave(9, 2, 3)),
)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("frame", [0, 4])
def test_a_frame_shows_the_way_so_far_and_all_else_as_it_is_then(frame: int, relative: bool) -> None:
    scene, figure = Scene(*SCENE[:-1], relative), Figure()
    AnimationStage(figure, scene).show(frame)
    plane, across, curves = figure.axes
    way = slice(0, frame + 1)
    names = [(None, *part) for part in (scene.state[way].T, scene.followed.T, scene.followed[[frame]].T)]
    drawn = lines(plane)
    want = [names[0], names[1], names[2], (None, *scene.centers[frame].T), (None, *scene.state[[frame]].T)]
    for (_, x, y), (_, want_x, want_y) in zip(drawn, want, strict=True):
        np.testing.assert_array_equal(x, want_x)
        np.testing.assert_array_equal(y, want_y)
    *discs, ball = plane.patches
    np.testing.assert_allclose([(*disc.center, disc.radius) for disc in discs], scene.discs[frame])
    np.testing.assert_allclose((*ball.center, ball.radius), (*scene.state[frame], scene.radius[frame]))
    unit = scene.value[frame].max() if relative else 1.0
    pair = ("$V^*$" if relative else "$V$", scene.value), (r"$\hat V$", scene.estimate)
    label = "place in the ball (radii, along the way)", "share of the largest" if relative else ""
    holds(across, [(n, scene.along, v[frame] / unit) for n, v in pair], label, xlim=(-1, 1))
    ideal = [(None, T, column) for column in scene.curves.ideal.T]
    now = [(None, T[way], column[way]) for column in scene.curves.values.T]
    holds(curves, [*ideal, *now], ("time (s)", ""), xlim=span(T))
