"""What a figure looks like, in words: what `test_drawn.py` records beside the data that it reads back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Tick
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.spines import Spine
from matplotlib.text import Text

_ASKED = (
    *("alpha", "zorder", "visible", "linestyle", "linewidth", "marker", "markersize", "drawstyle", "label"),
    *("text", "fontsize", "rotation", "ha", "va", "position", "aspect", "title", "frame_on", "anchor"),
    *("xlim", "ylim", "xscale", "yscale", "xlabel", "ylabel", "size_inches", "dpi", "hatch", "fill", "clim"),
)
_USUAL = ("", "None", "True", "solid", "default", "nan")
_OF_TEXTS = ("position", "size_inches", "text")
_OF_TICKS = ("gridOn", "bottom", "left", "labelbottom", "labelleft")
_COLOURS = ("color", "facecolor", "edgecolor", "markerfacecolor", "markeredgecolor")


def version() -> str:
    """What looks depend on, beside the figure: the next matplotlib may draw a legend of other parts."""
    return ".".join(mpl.__version__.split(".")[:2])


def looks(figure: Figure) -> list[str]:
    """A line an artist, ticks and what lies in legends left out; of a legend where it is, and its columns."""
    return [f"{type(artist).__name__}: {'; '.join(_said(artist))}" for artist in _artists(figure)]


def _artists(artist: Artist) -> Iterator[Artist]:
    if isinstance(artist, Tick | Spine) or (isinstance(artist, Text) and not artist.get_text()):
        return
    if isinstance(artist, Figure | Axes | Legend | Text | Line2D | Patch) or hasattr(artist, "get_cmap"):
        yield artist
    if not isinstance(artist, Legend):
        for child in artist.get_children():
            yield from _artists(child)


def _said(artist: Any) -> Iterator[str]:
    for name in (*_ASKED, *_COLOURS):
        get = getattr(artist, f"get_{name}", None)
        if get is None or (name in _OF_TEXTS and not isinstance(artist, Text | Figure)):
            continue
        value = get()
        if name in _COLOURS:
            value = _colour(value)
        elif isinstance(value, Text):
            value = value.get_text()
        if (said := _short(value)) not in _USUAL:
            yield f"{name} {said}"
    if hasattr(artist, "levels"):
        yield f"levels {_short(artist.levels)}"
    if isinstance(artist, Legend):
        columns = getattr(artist, "_ncols", 1)
        names = [text.get_text() for text in artist.get_texts()]
        padding = [
            round(getattr(artist, each), 6) for each in ("borderaxespad", "handlelength", "columnspacing")
        ]
        yield f"at {artist._loc_real}, {columns} columns, {padding}, {names}"  # type: ignore[attr-defined]
        box, whole = artist.get_bbox_to_anchor(), artist.parent.bbox
        at = (box.p0 - whole.p0) / whole.size
        yield f"beside {_short(at.round(4))}, title of {artist.get_title().get_size():g}"
        for line in artist.get_lines():
            yield f"{line.get_linestyle()} {line.get_marker()} {_colour(line.get_color())}"
    if isinstance(artist, Axes):
        for axis in (artist.xaxis, artist.yaxis):
            ticks = axis.get_major_ticks()
            size = ticks[0]._size if ticks else None  # type: ignore[attr-defined]
            told = {name: axis.get_tick_params().get(name) for name in _OF_TICKS}
            said = ", ".join(name for name, on in told.items() if on)
            yield f"ticks {_short(axis.get_majorticklocs())} of {size}: {said}"
            yield f"{len(axis.get_minorticklocs())} minor ones"


def _colour(value: Any) -> str:
    rows = np.atleast_2d(np.asarray(value, dtype=object))
    try:
        return " ".join(
            dict.fromkeys(
                to_hex(row if len(row) > 1 else row[0], keep_alpha=True).removesuffix("ff") for row in rows
            )
        )
    except (TypeError, ValueError):
        return str(value)


def _short(value: Any) -> str:
    if isinstance(value, int | float | np.number | np.ndarray | tuple | list):
        flat = np.asarray(value, dtype=object).reshape(-1)
        return " ".join(f"{each:.5g}" if isinstance(each, float) else str(each) for each in flat[:40])
    return str(value)
