"""Deviations of tip, angles and length that a rig will have, from the information of its cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tubesight.apps.planning.information import PARAMETERS, Errors, Information, information, placed
from tubesight.core import Array, Tube
from tubesight.geometry.rig import Rig
from tubesight.simulate.phantom import Arc

# Step of the differences of the tip by the unknowns (mm, rad): it is smooth over far more than that.
_STEP = 1e-4
# Deviation of the tip's distance from the axis against that distance, above which its azimuth is not defined.
_AZIMUTH_SHARE = 1 / 3


@dataclass(frozen=True, slots=True)
class Deviations:
    """Predicted standard deviations at one pose of the tube; NaN where not all cameras see all of it.

    Attributes
    ----------
    tip_mm
        Root of the sum of the variances of x, y and z.
    orientation_rad
        NaN also where the tip is so near the axis that its azimuth is not defined.
    """

    tip_x_mm: float
    tip_y_mm: float
    tip_z_mm: float
    tip_mm: float
    bending_rad: float
    orientation_rad: float
    length_mm: float

    @classmethod
    def unknown(cls) -> Deviations:
        """All NaN."""
        return cls(*[float("nan")] * 7)


def predict(phantom: Arc, rig: Rig, tube: Tube, errors: Errors, margin_px: float = 0.0) -> Deviations:
    """Predict the deviations of one pose with all cameras of a rig."""
    told = {name: information(phantom, rig, name, tube, errors, margin_px) for name in rig.names}
    return combine(phantom, told, rig, errors)


def combine(phantom: Arc, told: Mapping[str, Information], rig: Rig, errors: Errors) -> Deviations:
    """Put together what the pictures of some cameras of a rig tell.

    ``H = P + sum J^T S^-1 J`` with P the inverse covariance of the clamp; the covariance is
    ``H^-1 + G S_c G^T``, ``G = H^-1 sum J^T S^-1 C`` with S_c the covariance of the calibration.
    """
    if not told or not all(view.seen for view in told.values()):
        return Deviations.unknown()
    covariance = covariance_of([view.matrix for view in told.values()], errors)
    if rig.covariance is not None:
        by_camera = np.array([name.rpartition(".")[0] for name in rig.covariance.names])
        deviation = np.sqrt(np.diag(rig.covariance.matrix))
        gain = np.zeros((PARAMETERS, len(deviation)))
        for name, view in told.items():
            gain[:, by_camera == name] = view.by_calibration
        safe = np.where(deviation > 0, deviation, 1.0)
        correlation = rig.covariance.matrix / np.outer(safe, safe)
        gain = covariance @ gain
        covariance = covariance + gain @ correlation @ gain.T
    return deviations_of(phantom, covariance)


def covariance_of(told: Sequence[Array], errors: Errors) -> Array:
    """Covariance (7, 7) of the unknowns from the information of pictures and the clamp."""
    prior = np.zeros(PARAMETERS)
    prior[3:5], prior[5:] = errors.clamp_mm**-2, errors.clamp_rad**-2
    return np.asarray(np.linalg.inv(np.sum(told, axis=0) + np.diag(prior)))


def deviations_of(phantom: Arc, covariance: Array) -> Deviations:
    """Deviations of what is reported from the covariance (7, 7) of the unknowns."""
    jacobian = derivatives(phantom)
    reported = jacobian @ covariance @ jacobian.T
    x, y, z, bending, side, length = np.sqrt(np.maximum(np.diag(reported), 0.0)).tolist()
    tip = phantom.at(phantom.length_mm)
    radius = float(np.hypot(tip[0], tip[1]))
    across = float(np.sqrt(reported[0, 0] + reported[1, 1]))
    azimuth = side / radius if across < _AZIMUTH_SHARE * radius else float("nan")
    return Deviations(x, y, z, float(np.sqrt(x * x + y * y + z * z)), bending, azimuth, length)


@lru_cache(maxsize=4096)
def derivatives(phantom: Arc) -> Array:
    """Differentiate tip x, y, z, bending, the tip's way around the axis (mm) and length by the unknowns: (6, 7).

    The bending is that of the unknown vector along the tube's own orientation, which is regular at a straight tube.
    """
    made = np.stack([(_tip(phantom, d) - _tip(phantom, -d)) / (2 * _STEP) for d in np.eye(PARAMETERS) * _STEP], 1)
    tip = phantom.at(phantom.length_mm)
    radius = float(np.hypot(tip[0], tip[1]))
    around = (tip[0] * made[1] - tip[1] * made[0]) / radius if radius > 0 else np.zeros(PARAMETERS)
    bending, length = np.zeros(PARAMETERS), np.eye(PARAMETERS)[2]
    bending[:2] = np.cos(phantom.phi_rad), np.sin(phantom.phi_rad)
    return np.vstack([made, bending, around, length])


def _tip(phantom: Arc, offset: Array) -> Array:
    there = placed(phantom, offset)
    return there.at(there.length_mm)
