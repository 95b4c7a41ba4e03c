"""The naive baseline: both centrelines cut into equal shares of their length, paired in order, triangulated.

Equal shares of two pictures of a curve are different places of it unless both cameras see it from one side alike, so
that the points are off along and across the tube by as much as the pictures' foreshortening differs. It is here to show
what correspondence is worth.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import interpolating
from tubesight.methods.agreement import best_pair, reprojection_rms_px
from tubesight.methods.centreline import resampled, way_of
from tubesight.vision.view import View

# Points of the curve: one each 4 mm of a tube of 160 mm.
_POINTS = 41


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Triangulate equal shares of two centrelines (`cv2.triangulatePoints`) and join them by a cubic spline.

    Parameters
    ----------
    views
        By camera name; the two at the largest angle are used where there are more.

    Raises
    ------
    Unmeasurable
        If a point lies behind a camera, or the curve, projected back, leaves the tube in a picture.
    """
    one, other = best_pair(views, rig)
    share = np.linspace(0.0, 1.0, _POINTS)
    ways = [resampled(way_of(views[name]), share)[:, :2] for name in (one, other)]
    matrices = [_matrix(rig, name) for name in (one, other)]
    found = cv2.triangulatePoints(matrices[0], matrices[1], ways[0].T, ways[1].T)
    homogeneous = np.asarray(found, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = (homogeneous[:3] / homogeneous[3]).T
    depths = [rig.camera_from_base[name].apply(points)[:, 2] for name in (one, other)]
    if not (np.isfinite(points).all() and min(d.min() for d in depths) > 0):
        raise Unmeasurable(Status.NEAR_DEGENERATE, detail="a point paired by length lies behind a camera")
    curve = interpolating(points)
    pair = {name: views[name] for name in (one, other)}
    rms, width = reprojection_rms_px(curve, pair, rig), min(float(np.median(v.widths_px)) for v in pair.values())
    if not rms <= width / 2:
        raise Unmeasurable(
            Status.RESIDUAL_TOO_LARGE,
            detail=f"rms {rms:.0f} px: the curve leaves the tube ({width:.0f} px wide)",
        )
    return curve


def _matrix(rig: Rig, name: str) -> Array:
    """Projection (3, 4) from the base frame to the ideal image plane."""
    pose = rig.camera_from_base[name]
    return np.column_stack([pose.rotation, pose.translation_mm])
