"""Figure of methods on plants: what a control costs to compute against what it costs to apply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from .style import colour, marker, page

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = 3
_LEAST = 1e-5  # excess cost that is drawn at the edge


def draw_rivals(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """One panel a plant: median excess cost over the best known against microseconds a control.

    A method that regulated some of the states alone is hollow; one that regulated none is not drawn.

    Args:
        rows: ``plant``, ``method``, ``ratio_median``, ``regulated``, ``us_median``; None where not measured.
    """
    plants = list(dict.fromkeys(row["plant"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    across = min(_COLUMNS, len(plants))
    down = -(-len(plants) // across)
    with page(2.4 * across + 1.6, 2.3 * down) as figure:
        grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
        for axes, plant in zip(grid.flat, plants, strict=False):
            for row in rows:
                if row["plant"] == plant and row["ratio_median"] is not None:
                    index = methods.index(row["method"])
                    axes.plot(
                        row["us_median"],
                        max(row["ratio_median"] - 1, _LEAST),
                        marker(index),
                        color=colour(index),
                        fillstyle="full" if row["regulated"] == 1 else "none",
                        linestyle="none",
                    )
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_title(plant.replace("_", " "), fontsize="small")
        for axes in list(grid.flat)[len(plants) :]:
            axes.set_visible(False)
        for axes in list(grid.flat)[: len(plants)][-across:]:  # with no panel below
            axes.set_xlabel(r"$\mu$s a control")
            axes.tick_params(labelbottom=True)
        for axes in grid[:, 0]:
            axes.set_ylabel("median excess cost")
        for index, method in enumerate(methods):
            grid[0, 0].plot([], [], marker(index), color=colour(index), linestyle="none", label=method)
        figure.legend(loc="outside right center", title="hollow: not all regulated", title_fontsize="small")
    return figure
