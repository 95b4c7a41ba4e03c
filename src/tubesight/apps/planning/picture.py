"""A plan as one picture: where the cameras stand, and the deviations over the workspace."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from tubesight.apps.planning.workspace import QUANTITIES
from tubesight.apps.reproduce.drawing import style
from tubesight.core import Array

if TYPE_CHECKING:
    from tubesight.apps.planning.plan import Plan

_TITLES = {"tip": "tip", "bending": "bending angle", "orientation": "orientation angle", "length": "length"}
# Tubes drawn in the views of the rig: more hide each other.
_DRAWN_BENDINGS, _DRAWN_ORIENTATIONS = 3, 12
# Arrows of the lines of sight end at this share of the way to the workspace.
_SIGHT = 0.45
# Distance of a camera's name from it, in points of the page.
_NAME_PT = 12.0


def draw_plan(plan: Plan) -> bytes:
    """Draw a plan as a PNG: the rig from above and from the side, and polar maps of the four deviations.

    In the maps the angle is the orientation of the tube and the radius its bending; white is not seen by all cameras,
    or (orientation) not defined.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with style():
        figure = Figure(figsize=(11, 7.2), layout="constrained")
        FigureCanvasAgg(figure)
        grid: Any = figure.add_gridspec(2, 3)
        _draw_rig(figure.add_subplot(grid[0, 0]), plan, (0, 1), "from above (along the clamp)")
        _draw_rig(figure.add_subplot(grid[1, 0]), plan, (0, 2), "from the side")
        for k, name in enumerate(QUANTITIES):
            axes: Any = figure.add_subplot(grid[k // 2, 1 + k % 2], projection="polar")
            _draw_map(figure, axes, plan, name)
        figure.suptitle("Predicted standard deviations. Research use only, not a medical device.", fontsize=10)
        data = io.BytesIO()
        figure.savefig(data, format="png", dpi=130)
    return data.getvalue()


def _draw_rig(axes: Any, plan: Plan, shown: tuple[int, int], title: str) -> None:
    pick = list(shown)
    for phantom in plan.task.workspace.poses(_DRAWN_BENDINGS, _DRAWN_ORIENTATIONS):
        points = phantom.at(np.linspace(0.0, phantom.length_mm, 25))[:, pick]
        axes.plot(*points.T, color="#888888", linewidth=0.8, zorder=1)
    target = _middle(plan)
    for name in plan.rig.names:
        centre = plan.rig.centre_mm(name)
        sight = centre + _SIGHT * (target - centre)
        axes.annotate(
            "", sight[pick], centre[pick], arrowprops={"arrowstyle": "->", "color": "#0072B2", "linewidth": 1.2}
        )
        axes.plot(*centre[pick], marker="s", color="#0072B2", markersize=7, zorder=3)
        # The name stands clear of the arrow, above the camera or below it.
        upwards = (target - centre)[shown[1]] * (-1 if shown[1] == 2 else 1) > 0
        offset = (0.0, -_NAME_PT if upwards else _NAME_PT)
        axes.annotate(
            name, centre[pick], textcoords="offset points", xytext=offset, fontsize=8, ha="center", va="center"
        )
    axes.plot(0, 0, marker="o", color="#D55E00", markersize=5, zorder=4)
    axes.annotate("clamp", (0, 0), textcoords="offset points", xytext=(5, 5), fontsize=8, color="#D55E00")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.3)
    axes.set(xlabel=f"{'xyz'[shown[0]]} [mm]", ylabel=f"{'xyz'[shown[1]]} [mm]", title=title)
    if shown[1] == 2:
        axes.invert_yaxis()


def _middle(plan: Plan) -> Array:
    points = [p.at(np.linspace(0.0, p.length_mm, 9)) for p in plan.task.workspace.poses(3, 8)]
    return np.asarray(np.concatenate(points).mean(0))


def _draw_map(figure: Any, axes: Any, plan: Plan, name: str) -> None:
    unit = QUANTITIES[name]
    bending = np.unique([pose.bending_deg for pose in plan.poses])
    orientation = np.unique([pose.orientation_deg for pose in plan.poses])
    value = np.full((len(bending), len(orientation)), np.nan)
    for pose in plan.poses:
        row = int(np.searchsorted(bending, pose.bending_deg))
        column = int(np.searchsorted(orientation, pose.orientation_deg))
        # One straight tube stands for all orientations.
        value[row, slice(None) if pose.bending_deg == 0 else column] = pose.of(name)
    shown = axes.pcolormesh(
        np.radians(_edges(orientation, None)), _edges(bending, 0.0), value, cmap="viridis", shading="flat"
    )
    figure.colorbar(shown, ax=axes, shrink=0.75, pad=0.12, label=f"[{unit}]")
    axes.set_title(f"{_TITLES[name]} [{unit}]")
    axes.grid(False)
    axes.set_axisbelow(False)
    axes.set_rlabel_position(22)
    top = float(bending.max())
    axes.set_rticks([tick for tick in (30.0, 60.0, 90.0, 120.0, 150.0) if tick <= top] or [top])
    axes.yaxis.set_major_formatter(lambda tick, _: f"{tick:.0f}°")
    axes.tick_params(labelsize=8)
    for label in axes.get_yticklabels():
        label.set_bbox({"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 0.6})


def _edges(centres: Array, least: float | None) -> Array:
    """Borders of cells around values, none below `least`."""
    if len(centres) == 1:
        return np.array([centres[0] - 5.0, centres[0] + 5.0])
    middle = (centres[1:] + centres[:-1]) / 2
    edges = np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])
    return edges if least is None else np.maximum(edges, least)
