"""The closed form: cone over one view's conic, rays of the other (Dalvand, Nahavandi & Howe 2016).

Three choices differ from the paper, each because it fails less: the cone camera is the one whose curve the other's
rays cross most squarely (the paper: the more curved one), the root is the one whose reprojection runs along the
observed arc in order (equation 10: nearest in depth), and the tip is triangulated from the two tip axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.arcs import clamped_arc, clamped_ellipse, free_arc, free_ellipse, free_line
from tubesight.geometry.cone import Cone, epipolar_crossing, ordered_depths
from tubesight.geometry.conic import CONIC_FITS, Conic
from tubesight.geometry.curve import Arc, Curve3D
from tubesight.geometry.polyline import lengths_along, place_along
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import base_of, best_pair, reprojection_rms_px, triangulate_tip
from tubesight.vision.view import View

# The simplest model whose rms is within this factor of the best model's is taken: residuals are systematic, so that a
# more general model always fits a little better.
_SIMPLEST_WITHIN = 1.35
# Rms under which models are not compared: an edge is not known better than this.
_RMS_FLOOR_PX = 0.1
# A reprojection this far off both centrelines means that no quadratic curve describes the tube (right models on
# photographs: 0.05 to 0.3 px, wrong ones 2 px and more).
_RMS_MAX_PX = 1.0
# Fewest rays that have to meet the cone, of those that cross the observed arc.
_HITS_MIN = 6
# |sin| of the crossing angle below which a ray's depth is noise.
_CROSSING_MIN = 0.05


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Reconstruct a quadratic curve from two views.

    Parameters
    ----------
    views
        By camera name; the two that see most of the tube at the largest angle are used where there are more.

    Raises
    ------
    Unmeasurable
        If the views contradict each other, or no line, circle or ellipse describes what they show.
    """
    pair = best_pair(views, rig)
    tip = triangulate_tip(views, rig)
    if tube.clamped:
        models = _clamped(lambda: curve_points(views[pair[0]], views[pair[1]], rig), tip)
    else:
        points, weights = curve_points(views[pair[0]], views[pair[1]], rig)
        base = base_of(views, rig)
        points = points if base is None else np.vstack([base, points])
        weights = weights if base is None else np.append(weights.max(), weights)
        models = _free(points, weights, tip)
    return _simplest(models, views, rig)


def curve_points(one: View, other: View, rig: Rig) -> tuple[Array, Array]:
    """Points of the curve in space from the rays of one view and the cone of the other.

    Returns
    -------
    points_mm, weights
        (N, 3) in the base frame, in order from the base, and (N,) relative precision: |sin| of the angle at which the
        ray's epipolar line crosses the cone view's curve.
    """
    crossing = {
        cone.camera: epipolar_crossing(cone.rays[:, :2], rig.relative_pose(cone.camera, ray.camera).translation_mm)
        for cone, ray in ((one, other), (other, one))
    }
    cone_view, ray_view = (one, other) if crossing[one.camera] >= crossing[other.camera] else (other, one)
    pose = rig.relative_pose(cone_view.camera, ray_view.camera)
    focal = rig.cameras[cone_view.camera].focal_px
    arc = cone_view.rays[:, :2]
    conic = simplest_conic(arc, focal)
    hits = Cone(conic).intersect(pose, ray_view.rays)
    # The observed arcs start and end at slightly different places of the tube: a width of room beyond the ends.
    width = float(np.median(cone_view.widths_px))
    extended = _extend(arc, 2 * width / focal)
    depths = ordered_depths(hits, pose, ray_view.rays, extended, 0.25 * width / focal)
    points = ray_view.rays * depths[:, None]
    in_cone = pose.apply(points)
    place, _ = place_along(arc, in_cone[:, :2] / in_cone[:, 2:])
    weights = _crossing_weights(arc, place, pose.translation_mm)
    good = np.isfinite(depths) & (weights > _CROSSING_MIN)
    if good.sum() < _HITS_MIN:
        raise Unmeasurable(
            Status.NEAR_DEGENERATE, detail=f"{int(good.sum())} of {len(good)} rays meet the other view's cone"
        )
    base_from_ray = rig.camera_from_base[ray_view.camera].inverse()
    return base_from_ray.apply(points[good]), weights[good]


def simplest_conic(arc: Array, focal_px: float) -> Conic:
    """Simplest conic that describes an arc: line, parabola or a conic of any kind (Taubin)."""
    conics = [CONIC_FITS[name](arc) for name in ("line", "parabola", "taubin")]
    rms = [float(np.sqrt(np.mean((c.sampson(arc) * focal_px) ** 2))) for c in conics]
    limit = max(_SIMPLEST_WITHIN * min(rms), _RMS_FLOOR_PX / 4)
    return next(c for c, r in zip(conics, rms, strict=True) if r <= limit)


def _extend(arc: Array, length: float) -> Array:
    """Prolong a polyline straight at both ends."""
    k = min(5, len(arc) - 1)
    first, last = arc[0] - arc[k], arc[-1] - arc[-1 - k]
    return np.concatenate(
        [[arc[0] + first / np.linalg.norm(first) * length], arc, [arc[-1] + last / np.linalg.norm(last) * length]]
    )


def _crossing_weights(arc: Array, place: Array, epipole: Array) -> Array:
    along = lengths_along(arc)
    tangent = np.gradient(arc, along, axis=0)
    towards = epipole[:2] - epipole[2] * arc
    sine = np.abs(tangent[:, 0] * towards[:, 1] - tangent[:, 1] * towards[:, 0])
    sine /= np.linalg.norm(tangent, axis=1) * np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
    return np.asarray(np.interp(np.nan_to_num(place), along, sine))


def _clamped(points: Callable[[], tuple[Array, Array]], tip: Array) -> list[Callable[[], Curve3D]]:
    """Models of a tube in its clamp: a line and an arc are known by their tip, only an ellipse needs the points."""
    along = max(float(tip[2]), 1e-9)

    def ellipse() -> Curve3D:
        places, weights = points()
        return clamped_ellipse(np.vstack([places, tip]), np.append(weights, 3 * weights.max()), tip)

    return [lambda: Arc(np.zeros(2), along), lambda: clamped_arc(tip), ellipse]


def _free(points: Array, weights: Array, tip: Array) -> list[Callable[[], Curve3D]]:
    return [
        lambda: free_line(points, weights, tip),
        lambda: free_arc(points, weights, tip),
        lambda: free_ellipse(points, weights, tip),
    ]


def _simplest(models: list[Callable[[], Curve3D]], views: Mapping[str, View], rig: Rig) -> Curve3D:
    """Choose the first of the models, from the simplest on, that is nearly as good as the best.

    No later model is made once one explains all, to what an edge is known, and much better than those before it.
    """
    fits: list[tuple[float, Curve3D]] = []
    for model in models:
        try:
            curve = model()
        except ValueError:
            continue
        rms = reprojection_rms_px(curve, views, rig)
        if math.isfinite(rms):
            if rms <= _RMS_FLOOR_PX and all(other > _SIMPLEST_WITHIN * rms for other, _ in fits):
                return curve
            fits.append((rms, curve))
    best = min((rms for rms, _ in fits), default=math.inf)
    if best > _RMS_MAX_PX:
        seen = f"rms {best:.1f} px" if fits else "no curve"
        raise Unmeasurable(Status.NOT_QUADRATIC, detail=f"best line, circle or ellipse: {seen}")
    limit = max(_SIMPLEST_WITHIN * best, _RMS_FLOOR_PX)
    return next(curve for rms, curve in fits if rms <= limit)
