"""One photograph of one tube, measured by every method: the task that the experiments are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from tubesight.apps.reproduce.mockup import TUBE, phantom_of, photograph
from tubesight.apps.reproduce.session import PlainRig
from tubesight.core import Array, Status
from tubesight.geometry.arcs import free_arc, free_ellipse
from tubesight.geometry.curve import Curve3D
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.simulate import Phantom, Scene, truth

# In the order of the report: the paper's pipeline, its closed form on sub-pixel edges, the fit to the edges.
METHODS = ("reference", "cone_ray", "silhouette")
# Points of a measured centreline through which circle and ellipse are laid: every 4 mm.
_LENGTH_POINTS = 41
ERRORS = (
    *("tip_x_error_mm", "tip_y_error_mm", "tip_z_error_mm", "bending_error_deg", "orientation_error_deg"),
    *("length_error_mm", "length_circle_error_mm", "length_ellipse_error_mm"),
)

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Shot:
    """A pose of a tube, and the rigs to measure it with; the task of `measured`.

    Attributes
    ----------
    tube
        Name of the tube.
    true
        The rig that takes the photograph.
    rigs
        Rigs to measure with, by name.
    seed
        Of the scene's grain and noise.
    """

    tube: str
    bending_deg: float
    ratio: float
    orientation_deg: float
    true: PlainRig
    rigs: tuple[tuple[str, PlainRig], ...]
    seed: int


def measured(shot: Shot) -> list[Row]:
    """Photograph the tube once and measure it by every method with every rig: a row each, measured minus true."""
    phantom = phantom_of(shot.bending_deg, shot.orientation_deg, shot.ratio)
    pair = photograph(shot.true.rig(), phantom, Scene(seed=shot.seed), "")
    about = {"tube": shot.tube, "true_bending_deg": shot.bending_deg, "true_orientation_deg": shot.orientation_deg}
    return [
        about | {"rig": name, "method": method} | errors(ShapeSensor(rig.rig(), TUBE, method)(pair), phantom)
        for name, rig in shot.rigs
        for method in METHODS
    ]


def errors(result: Reconstruction, phantom: Phantom) -> Row:
    """Status, measured tip, and errors (`ERRORS`) of a measurement; NaN where there is none."""
    if result.shape is None or result.curve is None:
        return {"status": str(result.status), **dict.fromkeys(("tip_x_mm", "tip_y_mm", "tip_z_mm", *ERRORS), nan)}
    shape, true = result.shape, truth(phantom)
    off = shape.tip_mm - np.array(true["tip"])
    turned = np.degrees(shape.orientation_rad) - true["phi"]
    circle, ellipse = (_length_mm(fit, result.curve) for fit in (free_arc, free_ellipse))
    values = (
        *(*off, np.degrees(shape.bending_rad) - true["theta"], (turned + 180) % 360 - 180),
        *(length - true["length"] for length in (shape.length_mm, circle, ellipse)),
    )
    tip = dict(zip(("tip_x_mm", "tip_y_mm", "tip_z_mm"), map(float, shape.tip_mm), strict=True))
    return {"status": str(result.status), **tip, **dict(zip(ERRORS, map(float, values), strict=True))}


def _length_mm(fit: Callable[[Array, Array, Array], Curve3D], curve: Curve3D) -> float:
    """Length by a circle or an ellipse through the measured centreline; NaN for a straight one."""
    points = curve.at(np.linspace(0.0, curve.length_mm, _LENGTH_POINTS))
    try:
        return fit(points, np.ones(len(points)), points[-1]).length_mm
    except ValueError:
        return nan


def statistics(rows: Sequence[Row]) -> dict[str, float]:
    """Largest and mean absolute errors of rows, as an entry of ``summary.json``.

    `tip` is over x, y and z; a row that is not ``ok`` counts as a failure and in nothing else.
    """
    good = [row for row in rows if row["status"] == Status.OK]
    entry: dict[str, float] = {}
    for name, keys in (
        ("tip_{}_mm", ERRORS[:3]),
        ("bending_{}_deg", ERRORS[3:4]),
        ("orientation_{}_deg", ERRORS[4:5]),
        ("length_{}_mm", ERRORS[5:6]),
        ("length_circle_{}_mm", ERRORS[6:7]),
        ("length_ellipse_{}_mm", ERRORS[7:8]),
    ):
        values = np.abs([row[key] for row in good for key in keys])
        values = values[np.isfinite(values)]
        entry[name.format("max")] = float(values.max()) if len(values) else nan
        entry[name.format("mean")] = float(values.mean()) if len(values) else nan
    return entry | {"failures": len(rows) - len(good), "n": len(rows)}
