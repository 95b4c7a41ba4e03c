"""All curves of a run in one 3-D picture."""

from __future__ import annotations

import importlib.util
import io
from pathlib import Path

import numpy as np

from tubesight.files.safe import write_atomic
from tubesight.files.tables import Curves

# More names than this make a legend that hides the picture.
_LEGEND_FRAMES = 12


def plots_installed() -> bool:
    """Whether matplotlib is there, which the extra ``plots`` installs."""
    return importlib.util.find_spec("matplotlib") is not None


def write_plot(path: Path, curves: Curves) -> None:
    """Draw curves in the base frame, millimetres, to equal scales, as a PNG."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot(projection="3d")
    colours = colormaps["viridis"](np.linspace(0.0, 0.95, max(len(curves.frame), 1)))
    for name, xyz, colour in zip(curves.frame, curves.xyz_mm, colours, strict=False):
        axes.plot(*xyz.T, color=colour, label=name, linewidth=2)
        axes.scatter(*xyz[-1:].T, color=colour, s=20)
    points = curves.xyz_mm.reshape(-1, 3)
    if len(points):
        centre = (points.max(0) + points.min(0)) / 2
        half = max(float((points.max(0) - points.min(0)).max()) / 2, 1.0)
        axes.set(**{f"{a}lim": (c - half, c + half) for a, c in zip("xyz", centre, strict=True)})
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", title="centrelines in the base frame")
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=22, azim=-20)
    if 0 < len(curves.frame) <= _LEGEND_FRAMES:
        axes.legend(title="frame", loc="upper left")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=110)
    write_atomic(path, data.getvalue())
