"""The solve of Dalvand, Nahavandi & Howe 2016 (section 2.1), literally.

The paper's choices are kept where they are known to fail: Halir and Flusser's ellipse for the image of any arc, the
cone over the view of higher curvature, and equation 10 for the root. `cone_ray` is the same closed form with others.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.arcs import free_arc, free_ellipse, free_line
from tubesight.geometry.cone import Cone, nearest_depth
from tubesight.geometry.conic import fit_halir_flusser
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.polyline import place_along
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.methods.centreline import way_of
from tubesight.vision.view import View

# Sagitta of the centreline in every view, pixels, below which the tube is straight: points found on whole pixels
# scatter by less than half of it, a tube of one degree of bend has it in one view.
_STRAIGHT_PX = 1.5
# Fewest points that fix plane and circle with some to spare.
_POINTS_MIN = 5
# The circle is kept where the ellipse is not better by this factor, or fits within this: circular tubes leave 0.04 to
# 0.13 mm at 0.3 m, the elliptic tube of 40 degrees leaves 0.45 mm to a circle.
_SIMPLEST_WITHIN, _RMS_FLOOR_MM = 1.35, 0.2

# The paper has no check of its result. Right curves reproject within 1 px of the points of both views; farther off the
# errors are millimetres (wrong roots, shapes that are not quadratic).
_RMS_MAX_PX = 1.5


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Reconstruct a line, circle or ellipse from two views.

    Parameters
    ----------
    views
        By camera name; the first two are used, as the paper has two cameras.

    Raises
    ------
    Unmeasurable
        If there are not two views, too few rays of one meet the cone over the other, or the curve does not agree with
        the views.
    """
    if len(views) < 2:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="two views are needed")
    names = list(views)[:2]
    curve = _reconstruct(names, views, rig)
    rms = reprojection_rms_px(curve, {name: views[name] for name in names}, rig)
    if not rms <= _RMS_MAX_PX:
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.1f} px")
    return curve


def _reconstruct(names: list[str], views: Mapping[str, View], rig: Rig) -> Curve3D:
    """Figure 1 of the paper from the centreline points on: triangulated line, or circle or ellipse through the cone."""
    arcs = {n: way_of(views[n]) for n in names}
    if all(sagitta(arcs[n]) * rig.cameras[n].focal_px < _STRAIGHT_PX for n in names):
        ends = rig.triangulate({n: arcs[n][[0, -1]] for n in names})
        return free_line(ends, np.ones(2), ends[1])
    cone, ray = sorted(names, key=lambda n: curvature(arcs[n]), reverse=True)
    return _circle_or_ellipse(curve_points(arcs[cone], arcs[ray], cone, ray, rig))


def sagitta(arc: Array) -> float:
    """Largest distance of the points of an arc (N, 3) on the image plane from the chord of its ends."""
    chord = arc[-1, :2] - arc[0, :2]
    off = arc[:, :2] - arc[0, :2]
    return float(np.abs(off[:, 0] * chord[1] - off[:, 1] * chord[0]).max() / np.linalg.norm(chord))


def curvature(arc: Array) -> float:
    """Curvature of an arc (N, 3) on the image plane: that of the circle with its chord c and sagitta s, 8 s / c^2."""
    chord = float(np.linalg.norm(arc[-1, :2] - arc[0, :2]))
    return 8 * sagitta(arc) / chord**2


def curve_points(cone_arc: Array, rays: Array, cone: str, ray: str, rig: Rig) -> Array:
    """Points (N, 3) of the curve in the base frame: equations 2 and 6 to 11.

    Parameters
    ----------
    cone_arc, rays
        (M, 3) and (N, 3) rays ``v = (x, y, 1)`` of origin, centreline and tip in the cone's camera and the other one.
    cone, ray
        Names of the two cameras.

    Raises
    ------
    Unmeasurable
        If too few rays, or not that of the tip, meet the cone.
    """
    conic = fit_halir_flusser(cone_arc[:, :2])
    hits = Cone(conic).intersect(rig.relative_pose(cone, ray), rays)
    base_depth = float(rig.camera_from_base[ray].translation_mm[2])
    depth = nearest_depth(hits, base_depth)
    met = np.isfinite(depth)
    if met.sum() < _POINTS_MIN or not met[-1]:
        raise Unmeasurable(
            Status.NEAR_DEGENERATE,
            detail=f"{int(met.sum())} of {len(met)} rays meet the cone, that of the tip {'too' if met[-1] else 'not'}",
        )
    return rig.camera_from_base[ray].inverse().apply(rays[met] * depth[met, None])


def _circle_or_ellipse(points: Array) -> Curve3D:
    weights = np.ones(len(points))
    fits: list[tuple[float, Curve3D]] = []
    for model in (free_arc, free_ellipse):
        try:
            curve: Curve3D = model(points, weights, points[-1])
        except ValueError:
            continue
        _, off = place_along(curve.at(np.linspace(0.0, curve.length_mm, 201)), points)
        fits.append((float(np.sqrt(np.mean(off**2))), curve))
    if not fits:
        raise Unmeasurable(Status.NOT_QUADRATIC, detail="neither circle nor ellipse passes through the points")
    limit = max(_SIMPLEST_WITHIN * min(rms for rms, _ in fits), _RMS_FLOOR_MM)
    return next(curve for rms, curve in fits if rms <= limit)
