"""Trials on drawn edges: what methods make of a tube whose edges, clamp and calibration err as they are told to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import nan
from typing import Any

import numpy as np

from tubesight.apps.planning.information import Errors
from tubesight.apps.planning.prediction import predict
from tubesight.apps.planning.views import draw
from tubesight.apps.reproduce.mockup import LENGTH_MM, TUBE
from tubesight.core import Status, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig, RigCovariance
from tubesight.geometry.shape import shape_of
from tubesight.methods import METHODS
from tubesight.simulate import Phantom, rig_around, truth
from tubesight.simulate.phantom import Arc

Row = dict[str, Any]

# Each edge by itself, and nothing else: for the Cramer-Rao bound. The clamp errs as methods expect it to.
INDEPENDENT = Errors(shading_px=0.0, bias_px=0.0)
QUANTITIES = ("tip_x_mm", "tip_y_mm", "tip_z_mm", "bending_deg", "orientation_deg", "length_mm")
_SD = ("tip_x", "tip_y", "tip_z", "bending", "orientation", "length")
# Deviations of calibrated parameters, as board pictures of a webcam leave them: focal length and principal point in
# px, rotation in rad, position in mm.
_CALIBRATION = {"f": 0.5, "cx": 0.4, "cy": 0.4, "rx": 2e-4, "ry": 2e-4, "rz": 2e-4, "tx": 0.04, "ty": 0.04, "tz": 0.04}


@dataclass(frozen=True, slots=True)
class Trial:
    """Draws of one pose; the task of `tried`.

    Attributes
    ----------
    angle_deg
        Between the two cameras.
    calibrated
        Whether the calibration errs too, and its covariance is known.
    """

    angle_deg: float
    bending_deg: float
    orientation_deg: float
    errors: Errors
    calibrated: bool
    methods: tuple[str, ...]
    draws: int
    seed: int


def rig_of_trial(angle_deg: float, calibrated: bool) -> Rig:
    """Two cameras of the mock-up at an angle, with the covariance of a calibration or without."""
    rig = rig_around(angle_deg)
    if not calibrated:
        return rig
    names = tuple(f"{camera}.{parameter}" for camera in rig.names for parameter in _CALIBRATION)
    matrix = np.diag(np.tile(list(_CALIBRATION.values()), len(rig.names)) ** 2)
    return Rig(rig.cameras, rig.camera_from_base, covariance=RigCovariance(names, matrix))


def tried(trial: Trial) -> list[Row]:
    """Draw edges and solve by each method: a row each with errors, stated deviations and the predicted ones."""
    rig = rig_of_trial(trial.angle_deg, trial.calibrated)
    phantom = Arc(float(np.radians(trial.bending_deg)), float(np.radians(trial.orientation_deg)), LENGTH_MM)
    predicted = asdict(predict(phantom, rig, TUBE, trial.errors))
    angles = {f"predicted_{k}_deg": float(np.degrees(predicted[f"{k}_rad"])) for k in ("bending", "orientation")}
    lengths = {f"predicted_{k}": predicted[k] for k in ("tip_x_mm", "tip_y_mm", "tip_z_mm", "tip_mm", "length_mm")}
    rows = []
    for index in range(trial.draws):
        drawn = draw(phantom, rig, TUBE, trial.errors, np.random.default_rng([trial.seed, index]))
        for method in trial.methods:
            about = {
                "angle_deg": trial.angle_deg,
                "true_bending_deg": trial.bending_deg,
                "true_orientation_deg": trial.orientation_deg,
                "draw": index,
                "method": method,
            }
            try:
                curve = METHODS[method].solve(drawn.views, rig, TUBE)
                measured = _measured(curve, drawn.tube_as_it_is) | {"status": str(Status.OK)}
            except Unmeasurable as failure:
                unknown = [f"{q}{kind}" for q in QUANTITIES for kind in ("_error", "_sd")]
                measured = dict.fromkeys((*unknown, "tip_mm_error"), nan) | {"status": str(failure.status)}
            rows.append(about | measured | lengths | angles)
    return rows


def _measured(curve: Curve3D, phantom: Phantom) -> Row:
    shape, true = shape_of(curve, 0.0), truth(phantom)
    off = shape.tip_mm - np.array(true["tip"])
    turned = (np.degrees(shape.orientation_rad) - true["phi"] + 180) % 360 - 180
    errors = [*off, np.degrees(shape.bending_rad) - true["theta"], turned, shape.length_mm - true["length"]]
    sd = np.array([shape.sd[name] for name in _SD])
    sd[3:5] = np.degrees(sd[3:5])
    row = {f"{q}_error": float(e) for q, e in zip(QUANTITIES, errors, strict=True)}
    row |= {f"{q}_sd": float(s) for q, s in zip(QUANTITIES, sd, strict=True)}
    return row | {"tip_mm_error": float(np.linalg.norm(off))}


def column(rows: Sequence[Row], key: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Numbers of a column; what is not known is NaN."""
    return np.array([nan if row[key] is None else row[key] for row in rows], float)


def rms(values: Any) -> float:
    """Root mean square of what is known; NaN of nothing."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else nan
