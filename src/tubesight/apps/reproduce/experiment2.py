"""Experiment 2 (figures 8 to 11): circular tubes and an elliptic one turned once round."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.experiment import (
    CALIBRATED,
    ELLIPTIC,
    circular,
    error_table,
    of,
    photograph_and_measure,
    summary_of,
    verdict,
)
from tubesight.apps.reproduce.mockup import PAPER_MAX_DEG, PAPER_MAX_MM, phantom_of
from tubesight.apps.reproduce.shots import METHODS, Row
from tubesight.apps.reproduce.study import Context, StudyResult, Table
from tubesight.core import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

# Section 3.2 of the paper.
_BENDING_DEG = (10, 20, 30, 40, 50, 60, 70)
# The paper turns by hand and measures all the while.
_STEP_DEG, _QUICK_STEP_DEG = 5, 30
# Half the height of the panels: in the paper's largest errors, and enlarged, in mm or degrees. What lies beyond runs
# out of the panel; the data have it.
_SCALE, _ENLARGED = 1.4, 0.2
# Heights of the tips of figure 11: 160 mm straight down, 129 mm at 70 degrees.
_HEIGHTS_MM = (120.0, 165.0)
_TIP_Z, _BENDING = "tip_z_error_mm", "bending_error_deg"
_CIRCLE, _ELLIPSE = "length_circle_error_mm", "length_ellipse_error_mm"


def run(context: Context) -> StudyResult:
    """Turn the tubes, measure them, and draw figures 8 to 11."""
    tubes = [*circular(_BENDING_DEG), ELLIPTIC]
    orientations = range(0, 360, _QUICK_STEP_DEG if context.quick else _STEP_DEG)
    rows, configuration = photograph_and_measure(context, tubes, orientations)
    configuration = {**configuration, "bending_deg": _BENDING_DEG, "orientations_deg": list(orientations)}
    data = context.write_data("experiment2", rows, configuration)
    summary = summary_of(rows)
    names = [tube.name for tube in tubes]
    dashed = "dashed: largest error in the paper"
    figures = (
        context.write_figure(
            "figure8",
            _turned(rows, names, ((_TIP_Z, "tip z [mm]"),), PAPER_MAX_MM),
            f"Figure 8 of the paper: errors of the tip's height, a tube each row, right enlarged; {dashed}.",
        ),
        context.write_figure(
            "figure9",
            _turned(rows, names, ((_BENDING, "bending [deg]"),), PAPER_MAX_DEG),
            f"Figure 9 of the paper: errors of the bending angle, a tube each row, right enlarged; {dashed}.",
        ),
        context.write_figure(
            "figure10",
            _turned(
                rows, names, ((_CIRCLE, "length by circle [mm]"), (_ELLIPSE, "length by ellipse [mm]")), PAPER_MAX_MM
            ),
            f"Figure 10 of the paper: errors of the length by circle and ellipse, a tube each row; {dashed}.",
        ),
        context.write_figure(
            "figure11",
            _trajectories(rows, _BENDING_DEG),
            "Figure 11 of the paper: tips of the circular tubes while they turn; lines are true, dots measured.",
        ),
    )
    text = (
        f"Seven circular tubes and the elliptic one were turned once round in steps of {orientations.step} degrees. "
        "The calibration is that of experiment 1."
    )
    return StudyResult(
        "Experiment 2 (figures 8 to 11): tubes turned once round",
        (text, verdict(summary), _noise_with_bending(rows)),
        figures,
        (error_table(summary, "Eight tubes turned once round"), _by_tube(rows, names)),
        summary,
        (data,),
    )


def _scatter(rows: Sequence[Row], key: str) -> float:
    values = [row[key] for row in rows if row["status"] == Status.OK]
    return float(np.std(values)) if values else float("nan")


def _noise_with_bending(rows: Sequence[Row]) -> str:
    """Say whether the scatter grows with the bending, as it does in the paper."""
    first, last = (f"circular {bending}" for bending in (_BENDING_DEG[0], _BENDING_DEG[-1]))
    parts = []
    for method in METHODS:
        low, high = (_scatter(of(rows, tube=t, method=method, rig=CALIBRATED), _TIP_Z) for t in (first, last))
        parts.append(f"{low:.3f} and {high:.3f} mm ({method})")
    return (
        "In the paper the scatter grows with the bending. Here the standard deviations of the tip's height at "
        f"{_BENDING_DEG[0]} and {_BENDING_DEG[-1]} degrees are {', '.join(parts)}; the study sensitivity tests whether "
        "lens distortion, the paper's guess, makes it grow."
    )


def _by_tube(rows: Sequence[Row], names: Sequence[str]) -> Table:
    """Scatter of the errors by tube."""
    heading = ("tube", *(f"{method}, {what}" for method in METHODS for what in ("tip z [mm]", "bending [deg]")))
    cells = [
        (f"{name} deg", *(
            f"{_scatter(of(rows, tube=name, method=method, rig=CALIBRATED), key):.3f}"
            for method in METHODS
            for key in (_TIP_Z, _BENDING)
        ))
        for name in names
    ]  # fmt: skip
    return Table("Standard deviation of the errors over one turn.", heading, tuple(cells))


def _turned(rows: Sequence[Row], tubes: Sequence[str], quantities: Sequence[tuple[str, str]], paper: float) -> Drawing:
    """Signed errors over orientation: a row of panels each tube; each quantity on the paper's scale and enlarged."""
    columns = 2 * len(quantities)
    made, axes = drawing.panels(len(tubes), columns, (2.0 + 3.0 * columns, 1.0 + 1.15 * len(tubes)), sharex=True)
    for tube, row_axes in zip(tubes, axes, strict=True):
        for column, panel in enumerate(row_axes):
            key, enlarged = quantities[column // 2][0], column % 2
            # The reference runs far out of the enlarged panels.
            for method in METHODS[enlarged:]:
                own = of(rows, tube=tube, method=method, rig=CALIBRATED)
                panel.plot(
                    [row["true_orientation_deg"] for row in own],
                    [row[key] for row in own],
                    color=drawing.COLOURS[method],
                    marker=drawing.MARKERS[method],
                    markersize=2.5,
                    label=method,
                )
            drawing.paper_line(panel, [paper, -paper], f"largest in the paper, {paper}")
            drawing.orientation_axis(panel)
            panel.set_ylim(*((-_ENLARGED, _ENLARGED) if enlarged else (-_SCALE * paper, _SCALE * paper)))
        row_axes[0].set_title(f"{tube} deg", loc="left", pad=3)
    for panel in axes[-1]:
        panel.set_xlabel("orientation [deg]")
    for column, panel in enumerate(axes[len(tubes) // 2]):
        panel.set_ylabel(f"error of {quantities[column // 2][1]}{', enlarged' if column % 2 else ''}")
    drawing.legend_below(made, axes[0][0], columns=4)
    return made


def _trajectories(rows: Sequence[Row], bending_deg: Sequence[int]) -> Drawing:
    """Tips in space, a panel each method."""
    made, axes = drawing.panels(1, len(METHODS), (12.0, 4.4), subplot_kw={"projection": "3d"})
    turn = np.radians(np.arange(0, 361, 3))
    for method, panel in zip(METHODS, axes[0], strict=True):
        space: Any = panel
        for bending, colour in zip(bending_deg, drawing.shades(len(bending_deg)), strict=True):
            tip = phantom_of(bending, 0.0)
            radius, _, height = tip.at(np.array([tip.length_mm]))[0]
            circle = radius * np.cos(turn), radius * np.sin(turn), np.full(turn.shape, height)
            space.plot(*circle, color=colour, linewidth=0.8)
            own = of(rows, tube=f"circular {bending}", method=method, rig=CALIBRATED)
            points = np.array([[row["tip_x_mm"], row["tip_y_mm"], row["tip_z_mm"]] for row in own])
            space.plot(*points.T, linestyle="", marker="o", markersize=2, color=colour, label=f"{bending} deg")
        # The tube hangs: z, along it, points down.
        space.set(title=method, xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]", zlim=_HEIGHTS_MM[::-1])
        space.set(xticks=(-80, 0, 80), yticks=(-80, 0, 80), zticks=(120, 140, 160))
        # Room for the label of z, which the layout does not see.
        space.set_box_aspect((1, 1, 0.9), zoom=0.87)
    drawing.legend_below(made, axes[0][0], columns=len(bending_deg), title="bending")
    return made
