"""What the picture of one camera tells of a clamped circular tube, as a Fisher information.

The pictures of several cameras are independent: their information adds, and so does what a calibration error does to
each. The deviations of a rig are those of the sum (`tubesight.apps.planning.prediction`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tubesight.core import Array, Tube
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods.fit import CLAMP_MM, CLAMP_RAD
from tubesight.simulate.outlines import CONTOUR, SCANS, Outline, Stations, outline, stations
from tubesight.simulate.phantom import Arc, Phantom, Placed

# Unknowns: bend vector (x, y, rad), length (mm), offset of the base (x, y, mm), its tilts about x and y (rad).
PARAMETERS = 7
# Steps of central differences: edges move by less than 0.1 px and far more than their rounding of 1e-10 px.
_STEPS = np.array([1e-4, 1e-4, 1e-2, 1e-3, 1e-3, 1e-5, 1e-5])
# Share of the deviation of a calibrated parameter by which differences move it, and the least such step.
_CALIBRATION_SHARE, _CALIBRATION_LEAST = 0.1, 1e-9


@dataclass(frozen=True, slots=True)
class Errors:
    """What is not exact, as standard deviations.

    Attributes
    ----------
    noise_px
        Of each edge by itself.
    shading_px
        Of a whole row of edges, which light and compression shift and tilt.
    bias_px
        Of all edges of a picture, which blur moves outwards or inwards.
    clamp_mm, clamp_rad
        Of place and direction of the clamp.
    """

    # A photograph leaves residuals of 0.06 px to the right curve; shading moves rows by 0.05 px, and blur and gamma all
    # edges by 0.03 to 0.1 px where the threshold has been improved. The clamp is as good as the fit takes it to be.
    noise_px: float = 0.06
    shading_px: float = 0.05
    bias_px: float = 0.1
    clamp_mm: float = CLAMP_MM
    clamp_rad: float = float(CLAMP_RAD)


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What one picture tells.

    Attributes
    ----------
    seen
        Whether the whole tube lies in the picture, with an edge on both sides; if not, the rest is zero.
    matrix
        (7, 7) inverse covariance of the unknowns.
    by_calibration
        (7, Q) ``J^T S^-1 C``: what each of the camera's calibrated parameters, in their deviations, adds to the normal
        equations' right side.
    """

    seen: bool
    matrix: Array
    by_calibration: Array


def placed(phantom: Arc, offset: Array) -> Placed:
    """Circular tube with its seven unknowns changed by `offset` (`PARAMETERS`)."""
    bend = phantom.theta_rad * np.array([np.cos(phantom.phi_rad), np.sin(phantom.phi_rad)]) + offset[:2]
    theta, phi = float(np.hypot(*bend)), float(np.arctan2(bend[1], bend[0]))
    base = Pose.from_rotvec(np.array([offset[5], offset[6], 0.0]), np.array([offset[3], offset[4], 0.0]))
    return Placed(Arc(theta, phi, phantom.length_mm + float(offset[2])), base)


@lru_cache(maxsize=512)
def _moved(phantom: Arc, tube: Tube) -> Stations:
    """Stations (15, ...) of the tube: as it is, then with each unknown a step up and down."""
    offsets = np.concatenate([np.zeros((1, PARAMETERS)), np.diag(_STEPS), -np.diag(_STEPS)])
    each = [stations(placed(phantom, offset), tube) for offset in offsets]
    return Stations(np.stack([s.points_mm for s in each]), np.stack([s.tangents for s in each]))


def information(phantom: Arc, rig: Rig, name: str, tube: Tube, errors: Errors, margin_px: float = 0.0) -> Information:
    """Fisher information of the unknowns from one camera's picture.

    ``J^T S^-1 J``, J the derivatives of the edges across the silhouette, S their covariance: independent noise, shifts
    and tilts of each row, and one shift of all edges.

    Parameters
    ----------
    margin_px
        How far from the border of the picture the tube has to stay.
    """
    camera, pose = rig.cameras[name], rig.camera_from_base[name]
    moved = outline(_moved(phantom, tube), camera, pose, tube)
    at = Outline(moved.edges_px[0], moved.contour_px[0], moved.tip_px[0], moved.base_px[0])
    calibrated = _calibrated(rig, name)
    pixels = flat(at)
    if not camera.contains(np.vstack([pixels, at.base_px]), margin_px).all():
        return Information(False, np.zeros((PARAMETERS, PARAMETERS)), np.zeros((PARAMETERS, len(calibrated))))
    normal = normals(at)
    every = flat(moved)
    by_unknown = (every[1 : 1 + PARAMETERS] - every[1 + PARAMETERS :]) / (2 * _STEPS[:, None, None])
    jacobian = np.einsum("pnk,nk->np", by_unknown, normal)
    weighted = _weighted(jacobian, shifts(at, errors), errors.noise_px)
    still = Stations(_moved(phantom, tube).points_mm[0], _moved(phantom, tube).tangents[0])
    columns = np.zeros((len(pixels), len(calibrated)))
    for k, (there, share) in enumerate(calibrated):
        off = flat(outline(still, there.cameras[name], there.camera_from_base[name], tube)) - pixels
        columns[:, k] = (off * normal).sum(1) / share
    return Information(True, weighted.T @ jacobian, weighted.T @ columns)


@lru_cache(maxsize=64)
def _calibrated(rig: Rig, name: str) -> tuple[tuple[Rig, float], ...]:
    """Rigs with each calibrated parameter of one camera moved, and by which share of its deviation."""
    if rig.covariance is None:
        return ()
    made = []
    for parameter, variance in zip(rig.covariance.names, np.diag(rig.covariance.matrix), strict=True):
        if parameter.rpartition(".")[0] == name:
            deviation = max(float(np.sqrt(variance)), _CALIBRATION_LEAST)
            made.append((rig.perturbed(parameter, _CALIBRATION_SHARE * deviation), _CALIBRATION_SHARE))
    return tuple(made)


def flat(seen: Outline) -> Array:
    """Edge points (..., 2 `SCANS` + `CONTOUR`, 2): left, right, contour of the tip."""
    return np.concatenate([seen.edges_px[..., 0, :], seen.edges_px[..., 1, :], seen.contour_px], -2)


def normals(seen: Outline) -> Array:
    """Outward unit normals (N, 2) of the silhouette at its edge points."""
    rows = []
    for row, outwards in (
        (seen.edges_px[:, 0], seen.edges_px[:, 0] - seen.edges_px[:, 1]),
        (seen.edges_px[:, 1], seen.edges_px[:, 1] - seen.edges_px[:, 0]),
        (seen.contour_px, seen.contour_px - seen.tip_px),
    ):
        along = np.gradient(row, axis=0)
        across = np.stack([along[:, 1], -along[:, 0]], -1)
        across *= np.sign((across * outwards).sum(1, keepdims=True))
        rows.append(across / np.linalg.norm(across, axis=1, keepdims=True))
    return np.concatenate(rows)


def shifts(seen: Outline, errors: Errors) -> Array:
    """How the shifts of a picture, each in its deviation, move the edge points outwards: (N, 7).

    One of all edges; of each side a shift and a tilt along the tube; of the tip's contour a shift along both axes of
    the picture.
    """
    design = np.zeros((2 * SCANS + CONTOUR, 7))
    design[:, 0] = errors.bias_px
    for side in range(2):
        at = slice(side * SCANS, (side + 1) * SCANS)
        design[at, 1 + 2 * side] = errors.shading_px
        design[at, 2 + 2 * side] = errors.shading_px * np.linspace(-1, 1, SCANS)
    design[2 * SCANS :, 5:] = errors.shading_px * normals(seen)[2 * SCANS :]
    return design


def _weighted(jacobian: Array, design: Array, noise_px: float) -> Array:
    """Solve ``S x = J`` for the covariance ``S = noise^2 I + D D^T`` of the edge points (Woodbury's identity)."""
    small = noise_px**2 * np.eye(design.shape[1]) + design.T @ design
    return np.asarray((jacobian - design @ np.linalg.solve(small, design.T @ jacobian)) / noise_px**2)


def noisy(seen: Outline, errors: Errors, rng: np.random.Generator) -> Outline:
    """Draw edge points with these errors."""
    move = rng.normal(size=2 * SCANS + CONTOUR) * errors.noise_px + shifts(seen, errors) @ rng.normal(size=7)
    moved = flat(seen) + move[:, None] * normals(seen)
    edges = np.stack([moved[:SCANS], moved[SCANS : 2 * SCANS]], 1)
    return Outline(edges, moved[2 * SCANS :], seen.tip_px, seen.base_px)


def clamped_anyhow(phantom: Arc, errors: Errors, rng: np.random.Generator) -> Phantom:
    """Draw the tube in a clamp that is a little off."""
    off = rng.normal(size=4) * [errors.clamp_mm, errors.clamp_mm, errors.clamp_rad, errors.clamp_rad]
    return placed(phantom, np.append(np.zeros(3), off))
