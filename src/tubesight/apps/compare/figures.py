"""Drawings of a comparison: error against time, and both against the pictures' resolution."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tubesight.apps.compare.comparison import Comparison
from tubesight.apps.compare.measure import mean
from tubesight.apps.reproduce import drawing
from tubesight.core import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

_DPI = 130
# Okabe and Ito (2008) without yellow, which is hard to see on white. Both go by turns; their numbers have no common
# divisor.
_MARKERS = "os^Dv<>pP*X"
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
# Points: half a mark, and the extent of text of 8 points.
_MARK_PT, _LETTER_PT, _LINE_PT = 5.0, 4.6, 9.0


def drawings(made: Comparison) -> dict[str, bytes]:
    """PNG by name of the file; what nothing was measured for is left out."""
    with drawing.style():
        made_drawings = {"error_time.png": _error_time(made)}
        if made.by_resolution:
            made_drawings["resolution.png"] = _resolution(made)
        return {name: _png(figure) for name, figure in made_drawings.items() if figure is not None}


def _png(figure: Drawing) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI)
    return data.getvalue()


def _looks(names: Sequence[str]) -> Mapping[str, tuple[str, str]]:
    """Colour and marker of each method: no two have both alike."""
    return {name: (_COLOURS[k % len(_COLOURS)], _MARKERS[k % len(_MARKERS)]) for k, name in enumerate(names)}


def _error_time(made: Comparison) -> Drawing | None:
    looks = _looks(made.methods)
    places = {n: (mean(made.of(n), "ms"), mean(made.of(n), "curve_mean_mm")) for n in made.methods}
    places = {n: place for n, place in places.items() if np.isfinite(place).all() and min(place) > 0}
    if not places:
        return None
    figure, ((panel,),) = drawing.panels(1, 1, (8.0, 4.8))
    for name, (ms, off) in places.items():
        colour, marker = looks[name]
        panel.plot(ms, off, marker, color=colour, markersize=8)
    _log_axes(panel, "time for a pair of pictures [ms]", "mean distance to the true centreline [mm]")
    panel.axvline(1e3 / 30, color=drawing.COLOURS["paper"], linestyle="--", linewidth=1)
    panel.axhline(1.0, color=drawing.COLOURS["paper"], linestyle="--", linewidth=1)
    panel.margins(0.12)
    _label(figure, panel, places)
    return figure


def _label(figure: Drawing, panel: Axes, places: Mapping[str, tuple[float, float]]) -> None:
    """Write each name beside its mark, where it covers neither a mark nor another name."""
    figure.canvas.draw()
    per_point = figure.dpi / 72
    marks = {name: panel.transData.transform(place) / per_point for name, place in places.items()}
    # Boxes (left, bottom, right, top) in points, of the marks and of the names written so far.
    taken = [np.array([*(mark - _MARK_PT), *(mark + _MARK_PT)]) for mark in marks.values()]
    for name, mark in marks.items():
        half = np.array([_LETTER_PT * len(name), _LINE_PT]) / 2
        spots = [
            np.array([side * (half[0] + _MARK_PT), rise])
            if side
            else np.array([0.0, np.sign(rise) * (half[1] + _MARK_PT) + rise])
            for rise in (0.0, 6.0, -6.0, 14.0, -14.0, 24.0, -24.0)
            for side in (1, -1, 0)
            if side or rise
        ]
        boxes = [np.array([*(mark + spot - half), *(mark + spot + half)]) for spot in spots]
        free = [k for k, box in enumerate(boxes) if not any(_overlap(box, other) for other in taken)]
        best = free[0] if free else 0
        taken.append(boxes[best])
        x, y = spots[best].tolist()
        panel.annotate(name, places[name], (x, y), textcoords="offset points", ha="center", va="center", fontsize=8)


def _overlap(one: Array, other: Array) -> bool:
    return bool((one[:2] < other[2:]).all() and (other[:2] < one[2:]).all())


def _resolution(made: Comparison) -> Drawing:
    looks = _looks(made.methods)
    figure, ((errors, times),) = drawing.panels(1, 2, (10.0, 4.6))
    for name in made.methods:
        rows = [row for row in made.by_resolution if row.method == name]
        widths = sorted({row.width_px for row in rows})
        colour, marker = looks[name]
        for panel, column in ((errors, "curve_mean_mm"), (times, "ms")):
            values = [mean([row for row in rows if row.width_px == width], column) for width in widths]
            panel.plot(widths, values, marker=marker, color=colour, label=name)
    _log_axes(errors, "width of the pictures [px]", "mean distance to the true centreline [mm]")
    _log_axes(times, "width of the pictures [px]", "time for a pair of pictures [ms]")
    for panel in (errors, times):
        ticks = sorted({row.width_px for row in made.by_resolution})
        panel.set_xticks(ticks, [str(tick) for tick in ticks])
        panel.minorticks_off()
    drawing.legend_below(figure, errors, columns=6)
    return figure


def _log_axes(panel: Axes, x: str, y: str) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel(x)
    panel.set_ylabel(y)
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
