"""Does lens distortion that is not corrected make errors grow with bending? The paper's guess in section 4, tested."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.experiment import circular, of
from tubesight.apps.reproduce.mockup import true_rig
from tubesight.apps.reproduce.session import PlainRig
from tubesight.apps.reproduce.shots import METHODS, Row, Shot, measured
from tubesight.apps.reproduce.study import Context, StudyResult, Table
from tubesight.core import Status

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_BENDING_DEG = (10, 20, 30, 40, 50, 60, 70)
_STEP_DEG, _QUICK_STEP_DEG = 15, 90
# Shares of the distortion that the rig to measure with corrects.
_CORRECTED = (("corrected", 1.0), ("nine tenths corrected", 0.9), ("not corrected", 0.0))


def distortion_study(context: Context) -> StudyResult:
    """Turn circular tubes once round and measure them with rigs that know the distortion, nearly, or not at all."""
    true = PlainRig.of(true_rig())
    rigs = tuple((name, _with_distortion(true, share)) for name, share in _CORRECTED)
    step = _QUICK_STEP_DEG if context.quick else _STEP_DEG
    shots = [
        Shot(tube.name, tube.bending_deg, 1.0, phi, true, rigs, context.seed_of(tube.name, phi))
        for tube in circular(_BENDING_DEG)
        for phi in range(0, 360, step)
    ]
    rows = [row for found in context.map(measured, shots) for row in found]
    data = context.write_data("sensitivity_distortion", rows, {"step_deg": step, "corrected": dict(_CORRECTED)})
    figure = context.write_figure(
        "sensitivity_distortion",
        _growth(rows),
        "Scatter of the tip over one turn, by bending, with the lens distortion corrected and not.",
    )
    text = (
        "The paper sees its errors scatter more the more a tube bends, and guesses that radial distortion of the "
        "webcams is why. Here is how the errors of the tip scatter over one turn of a tube (root mean square over x, y "
        f"and z) at {_BENDING_DEG[0]} and at {_BENDING_DEG[-1]} degrees. "
        + " ".join(_grown(rows, name) for name, _ in _CORRECTED)
    )
    return StudyResult("", (text,), (figure,), (_table(rows),), data=(data,))


def _with_distortion(rig: PlainRig, share: float) -> PlainRig:
    return PlainRig(tuple(replace(c, distortion=tuple(share * k for k in c.distortion)) for c in rig.cameras))


def _scatter_mm(rows: Sequence[Row], bending_deg: float, rig: str, method: str) -> float:
    """Return the standard deviation of the tip's error over one turn, root mean square over x, y and z."""
    own = [r for r in of(rows, true_bending_deg=bending_deg, rig=rig, method=method) if r["status"] == Status.OK]
    errors = np.array([[r["tip_x_error_mm"], r["tip_y_error_mm"], r["tip_z_error_mm"]] for r in own])
    return float(np.sqrt(errors.var(axis=0).mean())) if len(own) > 1 else float("nan")


def _grown(rows: Sequence[Row], rig: str) -> str:
    """Scatter at the least and the largest bending, in words."""
    parts = []
    for method in METHODS:
        low, high = (_scatter_mm(rows, _BENDING_DEG[i], rig, method) for i in (0, -1))
        parts.append(f"{method} {low:.3f} to {high:.3f} mm ({high / low:.1f} times)")
    return f"Distortion {rig}: {', '.join(parts)}."


def _table(rows: Sequence[Row]) -> Table:
    heading = ("bending", *(f"{method}, {name}" for method in METHODS for name, _ in _CORRECTED))
    cells = [
        (f"{b} deg", *(f"{_scatter_mm(rows, b, name, method):.3f}" for method in METHODS for name, _ in _CORRECTED))
        for b in _BENDING_DEG
    ]
    return Table("Scatter of the tip over one turn [mm].", heading, tuple(cells))


def _growth(rows: Sequence[Row]) -> Drawing:
    made, axes = drawing.panels(1, len(METHODS), (9.0, 3.2), sharey=True)
    styles = (("-", "o"), ("--", "s"), (":", "^"))
    for method, panel in zip(METHODS, axes[0], strict=True):
        for (name, _), colour, (line, marker) in zip(_CORRECTED, drawing.shades(3), styles, strict=True):
            scatter = [_scatter_mm(rows, bending, name, method) for bending in _BENDING_DEG]
            panel.plot(_BENDING_DEG, scatter, color=colour, linestyle=line, marker=marker, label=name)
        panel.set(title=method, xlabel="bending [deg]", yscale="log")
    axes[0][0].set_ylabel("scatter of the tip [mm]")
    drawing.legend_below(made, axes[0][0], columns=3, title="lens distortion")
    return made
