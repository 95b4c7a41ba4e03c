"""One look for all figures: colours that colour-blind readers tell apart, with a marker each, units on every axis."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

# Okabe and Ito's palette (2008); with markers and dashes the series are told apart in gray too.
COLOURS: Mapping[str, str] = MappingProxyType(
    {"reference": "#D55E00", "cone_ray": "#0072B2", "silhouette": "#009E73", "paper": "#555555"}
)
MARKERS: Mapping[str, str] = MappingProxyType({"reference": "s", "cone_ray": "^", "silhouette": "o"})
_STYLE: Mapping[str, Any] = MappingProxyType(
    {
        "font.size": 9,
        "axes.titlesize": 9,
        "axes.grid": True,
        "grid.color": "#dddddd",
        "grid.linewidth": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "legend.frameon": False,
        "lines.linewidth": 1.2,
        "lines.markersize": 3.5,
        # Text stays text in the PDF.
        "pdf.fonttype": 42,
    }
)


@contextmanager
def style() -> Iterator[None]:
    """Draw and write figures in the look of the report."""
    import matplotlib

    settings: Any = dict(_STYLE)
    with matplotlib.rc_context(settings):
        yield


def panels(rows: int, columns: int, size_in: tuple[float, float], **options: Any) -> tuple[Drawing, list[list[Axes]]]:
    """Make a drawing with a grid of axes.

    Parameters
    ----------
    options
        Of `matplotlib.figure.Figure.subplots`: ``sharex``, ``sharey``, ``subplot_kw``.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = Figure(figsize=size_in, layout="constrained")
    FigureCanvasAgg(drawing)
    axes = drawing.subplots(rows, columns, squeeze=False, **options)
    return drawing, [list(row) for row in axes]


def shades(count: int) -> list[str]:
    """Colours of an ordered series, dark to light, monotonic in gray."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    # The lightest fifth of viridis is hard to see on white.
    return [to_hex(colormaps["viridis"](0.8 * i / max(count - 1, 1))) for i in range(count)]


def paper_line(axes: Axes, values: Sequence[float], text: str) -> None:
    """Draw the paper's value, or values, as a dashed line, named in the legend."""
    for i, value in enumerate(values):
        axes.axhline(value, color=COLOURS["paper"], linestyle="--", linewidth=1, label=text if i == 0 else "_nolegend_")


def legend_below(drawing: Drawing, axes: Axes, columns: int, title: str | None = None) -> None:
    """Put the legend of one of the axes below the whole drawing."""
    handles, labels = axes.get_legend_handles_labels()
    drawing.legend(handles, labels, loc="outside lower center", ncols=columns, title=title, frameon=False)


def orientation_axis(axes: Axes, step_deg: int = 90) -> None:
    """Ticks of an axis of orientations."""
    axes.set_xlim(0, 360)
    axes.set_xticks(range(0, 361, step_deg))


def decimal_log(axes: Axes) -> None:
    """Make the y axis logarithmic with ticks at 1, 2 and 5 of each decade, written as plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_locator(NullLocator())
