"""Experiment 1 (figures 5 to 7): circular tubes and an elliptic one at eight orientations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

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
from tubesight.apps.reproduce.mockup import PAPER_MAX_DEG, PAPER_MAX_MM
from tubesight.apps.reproduce.shots import METHODS, Row
from tubesight.apps.reproduce.study import Context, StudyResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

# Section 3.2 of the paper.
BENDING_DEG = (10, 30, 50, 70)
ORIENTATIONS_DEG = (30, 60, 120, 150, 210, 240, 300, 330)
# Errors are drawn on a logarithmic axis; smaller ones lie on its lower end.
_AXIS_FROM = 1e-3


def run(context: Context) -> StudyResult:
    """Measure the tubes and draw figures 5, 6 and 7."""
    tubes = [*circular(BENDING_DEG), ELLIPTIC]
    rows, configuration = photograph_and_measure(context, tubes, ORIENTATIONS_DEG)
    configuration = {**configuration, "bending_deg": BENDING_DEG, "orientations_deg": ORIENTATIONS_DEG}
    data = context.write_data("experiment1", rows, configuration)
    summary = summary_of(rows)
    names = [tube.name for tube in tubes]
    figures = (
        context.write_figure("figure5", _absolute(rows, names[:-1], _TIP, PAPER_MAX_MM), _caption("5", "tip position")),
        context.write_figure(
            "figure6", _absolute(rows, names[:-1], _ANGLES, PAPER_MAX_DEG), _caption("6", "bending and orientation")
        ),
        context.write_figure(
            "figure7",
            _absolute(rows, names, _LENGTHS, PAPER_MAX_MM),
            _caption("7", "length, by a circle and by an ellipse through the measured centreline"),
        ),
    )
    text = (
        "Circular tubes of 10, 30, 50 and 70 degrees and an elliptic one of 40 degrees were photographed at eight "
        "orientations. The cameras were calibrated and registered from rendered pictures of a board, as a user does it."
    )
    circle, ellipse = _elliptic_lengths(rows)
    lengths = (
        "A circle through the centreline of the elliptic tube gives a length that is wrong by "
        f"{circle:.2f} mm in the mean, an ellipse by {ellipse:.2f} mm (silhouette); for circular tubes both agree."
    )
    return StudyResult(
        "Experiment 1 (figures 5 to 7): tubes at eight orientations",
        (text, verdict(summary), lengths),
        figures,
        (error_table(summary, "Five tubes at eight orientations"),),
        summary,
        (data,),
    )


_TIP = (("tip_x_error_mm", "tip x [mm]"), ("tip_y_error_mm", "tip y [mm]"), ("tip_z_error_mm", "tip z [mm]"))
_ANGLES = (("bending_error_deg", "bending [deg]"), ("orientation_error_deg", "orientation [deg]"))
_LENGTHS = (("length_circle_error_mm", "by circle [mm]"), ("length_ellipse_error_mm", "by ellipse [mm]"))


def _caption(number: str, what: str) -> str:
    return f"Figure {number} of the paper: absolute errors of {what}; dashed: largest error in the paper."


def _elliptic_lengths(rows: Sequence[Row]) -> tuple[float, float]:
    """Mean absolute errors of the elliptic tube's length by circle and by ellipse."""
    own = of(rows, tube=ELLIPTIC.name, rig=CALIBRATED, method="silhouette")
    circle, ellipse = (np.nanmean(np.abs([row[key] for row in own])) for key, _ in _LENGTHS)
    return float(circle), float(ellipse)


def _absolute(
    rows: Sequence[Row], tubes: Sequence[str], quantities: Sequence[tuple[str, str]], paper: float
) -> Drawing:
    """Absolute errors over orientation: a row of panels each quantity, a column each method, a line each tube."""
    size = (9.0, 1.0 + 1.7 * len(quantities))
    made, axes = drawing.panels(len(quantities), len(METHODS), size, sharex=True, sharey="row")
    colours = drawing.shades(len(tubes))
    for column, method in enumerate(METHODS):
        axes[0][column].set_title(method)
        axes[-1][column].set_xlabel("orientation [deg]")
        for (key, label), row_axes in zip(quantities, axes, strict=True):
            panel = row_axes[column]
            for tube, colour, marker in zip(tubes, colours, "os^Dv", strict=False):
                own = of(rows, tube=tube, method=method, rig=CALIBRATED)
                size_of = np.maximum(np.abs([row[key] for row in own]), _AXIS_FROM)
                orientations = [row["true_orientation_deg"] for row in own]
                panel.plot(orientations, size_of, marker=marker, color=colour, label=f"{tube} deg")
            drawing.paper_line(panel, [paper], f"largest in the paper, {paper}")
            panel.set_yscale("log")
            panel.set_ylim(_AXIS_FROM)
            drawing.orientation_axis(panel)
            if column == 0:
                panel.set_ylabel(f"error of {label}" if "tip" in label else f"error, {label}")
    drawing.legend_below(made, axes[0][0], columns=3)
    return made
