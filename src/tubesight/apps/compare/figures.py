"""Drawings of a comparison: error against time, and both against the pictures' resolution."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tubesight.apps.compare.comparison import Comparison
from tubesight.apps.compare.measure import mean
from tubesight.apps.reproduce import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

_DPI = 130
# Markers by turns, so that methods of like colours differ.
_MARKERS = "os^Dv<>pP*Xh"


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
    """Colour and marker of each method; ours stands out."""
    shades = drawing.shades(max(len(names), 2))
    looks = {name: (shades[k], _MARKERS[k % len(_MARKERS)]) for k, name in enumerate(names)}
    if "silhouette" in looks:
        looks["silhouette"] = (drawing.COLOURS["reference"], "o")
    return looks


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
    _label(panel, places)
    panel.axvline(1e3 / 30, color=drawing.COLOURS["paper"], linestyle="--", linewidth=1)
    panel.axhline(1.0, color=drawing.COLOURS["paper"], linestyle="--", linewidth=1)
    panel.margins(0.12)
    return figure


def _label(panel: Axes, places: Mapping[str, tuple[float, float]]) -> None:
    """Write the names beside the marks, above or below in turn where they stand close."""
    order = sorted(places, key=lambda n: places[n][0])
    for k, name in enumerate(order):
        above = k % 2 == 0
        panel.annotate(
            name,
            places[name],
            xytext=(0, 8 if above else -8),
            textcoords="offset points",
            ha="center",
            va="bottom" if above else "top",
            fontsize=8,
        )


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
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlabel(x)
    panel.set_ylabel(y)
