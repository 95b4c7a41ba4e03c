"""A curve and its mirror image as a stereo pair, after Hong, Ma & Yu (2004).

A curve that is symmetric about a plane ``n . x = d`` shows each of its halves as a mirrored camera would, whose centre
and rays are reflected by ``R = I - 2 n n^T``. Rays of both halves correspond where they lie in one plane with n, that
is, in the picture, on one line through the vanishing point of n; real and mirrored ray meet in the curve. Each picture
gives a curve for every hypothesis (n, d); two pictures choose the hypothesis on which they agree.

A circular arc is symmetric about its middle. A clamped tube whose curvature varies is not, and is refused where the
pictures agree on no plane. Where a camera stands in the mirror plane its mirror image is itself, and tells nothing.

Reconstructed here: the search starts from the plane half way between base and tip, tilted to both sides.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.polyline import place_along
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import smoothing
from tubesight.methods.agreement import base_of, best_pair, reprojection_rms_px, triangulate_tip
from tubesight.methods.centreline import resampled, way_of
from tubesight.vision.view import View

# Places of each centreline, and pairs of mirrored places that make a curve.
_PLACES, _PAIRS = 121, 24
# Pairs lie between the ends and this share of the way to the apex: there the halves run along the lines that match
# them.
_APEX = 0.93
# Hypotheses at first: tilts of the plane (rad) to both sides of that across the chord.
_TILTS = (-0.15, 0.0, 0.15)
# Scale of the search: radians of tilt, and shares of the chord.
_TILT_RAD, _SHIFT_SHARE, _EVALUATIONS = 0.03, 0.02, 160
# Least distance between a camera and its mirror image, and least rise of the curve over its ends, in shares of the
# distance of the curve from the camera: below them a pixel is centimetres.
_BASELINE_MIN, _RISE_MIN = 0.15, 0.02
# Largest distance (rms, px) of one view's curve from the other view's: pairs on one plane leave 0.2 to 1.
_RMS_MAX_PX = 2.0
# What a curve costs that a hypothesis does not give, px.
_NO_CURVE_PX = 1e3
# Deviation of a point, px in the picture: matching along lines that cross the curve flatly is worth half a pixel.
_SD_PX = 0.3


class _Sight(NamedTuple):
    """One view: its camera's centre (3,), unit rays (N, 3) of its centreline in the base frame, and its name."""

    centre: Array
    rays: Array
    name: str


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Find the mirror plane on which two views agree, and the curve that it gives.

    Raises
    ------
    Unmeasurable
        If there are not two views, both cameras stand in the mirror plane or see no bend, or they agree on no plane.
    """
    names = best_pair(views, rig)
    share = np.linspace(0.0, 1.0, _PLACES)
    ways = {name: resampled(way_of(views[name]), share) for name in names}
    sights = [_Sight(rig.centre_mm(name), rig.directions(name, ways[name]), name) for name in names]
    tip = triangulate_tip({name: views[name] for name in names}, rig)
    base = np.zeros(3) if tube.clamped else base_of(views, rig)
    if base is None:
        raise Unmeasurable(Status.BASE_HIDDEN, detail="the views do not tell where the tube starts")
    chord = tip - base
    frame = np.linalg.svd(chord[None])[2]

    def plane(x: Array) -> tuple[Array, float]:
        n = chord / np.linalg.norm(chord) + np.tan(x[0]) * frame[1] + np.tan(x[1]) * frame[2]
        n /= np.linalg.norm(n)
        return n, float(n @ (base + tip)) / 2 + x[2]

    def miss(x: Array) -> float:
        return _disagreement_px(sights, ways, *plane(x), rig)

    best = min((np.array([a, b, 0.0]) for a, b in product(_TILTS, _TILTS)), key=miss)
    steps = np.array([_TILT_RAD, _TILT_RAD, _SHIFT_SHARE * float(np.linalg.norm(chord))])
    simplex = np.vstack([best, best + np.diag(steps)])
    found = minimize(miss, best, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": _EVALUATIONS})
    normal, offset = plane(found.x)
    halves = [points for sight in sights if (points := mirrored_curve(sight, normal, offset)) is not None]
    if not halves:
        raise Unmeasurable(
            Status.NEAR_DEGENERATE, detail="the cameras stand in the mirror plane, or see no bend to be mirrored"
        )
    if not found.fun <= _RMS_MAX_PX:
        raise Unmeasurable(
            Status.RESIDUAL_TOO_LARGE, detail=f"the views agree on no mirror plane, rms {found.fun:.1f} px"
        )
    curve = _joined(min(halves, key=lambda p: _seen_off_px(p, ways, rig)), rig, names)
    rms = reprojection_rms_px(curve, {name: views[name] for name in names}, rig)
    if not rms <= 2 * _RMS_MAX_PX:
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.1f} px")
    return curve


def mirrored_curve(sight: _Sight, normal: Array, offset_mm: float) -> Array | None:
    """Points (2 K, 3) of a symmetric curve, in order, from one view and its mirror plane; None where it gives none.

    Parameters
    ----------
    normal, offset_mm
        (3,) unit normal n and offset d of the plane ``n . x = d``.
    """
    distance = float(sight.centre @ normal) - offset_mm
    across = np.linalg.svd(normal[None])[2][1:]
    flat = sight.rays @ across.T
    middle = flat.mean(0)
    # Angle about n of the plane through n and each ray, from the middle one: equal for mirrored rays.
    angle = np.arctan2(flat[:, 1] * middle[0] - flat[:, 0] * middle[1], flat @ middle)
    rise = angle - (angle[0] + angle[-1]) / 2
    apex = int(np.abs(rise).argmax())
    sign = float(np.sign(rise[apex]))
    low, high = sign * max(sign * rise[0], sign * rise[-1]), float(rise[apex])
    if not (0 < apex < len(rise) - 1 and abs(high - low) > _RISE_MIN):
        return None
    first, second = np.maximum.accumulate(sign * rise[: apex + 1]), np.maximum.accumulate(sign * rise[apex:][::-1])
    levels = sign * (low + (high - low) * _APEX * np.linspace(0.0, 1.0, _PAIRS))
    one = _at(sight.rays, np.interp(levels, first, np.arange(apex + 1)))
    other = _at(sight.rays, len(rise) - 1 - np.interp(levels, second, np.arange(len(second))))
    mirrored = other - 2 * (other @ normal)[:, None] * normal
    points = _meeting(sight.centre, one, sight.centre - 2 * distance * normal, mirrored)
    depth = ((points - sight.centre) * one).sum(1)
    if not (np.isfinite(points).all() and depth.min() > 0 and 2 * abs(distance) > _BASELINE_MIN * depth.mean()):
        return None
    return np.vstack([points, (points - 2 * (points @ normal - offset_mm)[:, None] * normal)[::-1]])


def _at(rays: Array, place: Array) -> Array:
    k = np.arange(len(rays))
    return np.stack([np.interp(place, k, rays[:, c]) for c in range(3)], -1)


def _meeting(centre: Array, rays: Array, other_centre: Array, other_rays: Array) -> Array:
    """Points (N, 3) nearest to two bundles of rays (N, 3), pair by pair; NaN where they are parallel."""
    a, b, c = (rays * rays).sum(1), (rays * other_rays).sum(1), (other_rays * other_rays).sum(1)
    off = other_centre - centre
    determinant = a * c - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (c * (rays @ off) - b * (other_rays @ off)) / determinant
        t = (b * (rays @ off) - a * (other_rays @ off)) / determinant
    return np.asarray((centre + s[:, None] * rays + other_centre + t[:, None] * other_rays) / 2)


def _disagreement_px(
    sights: list[_Sight], ways: Mapping[str, Array], normal: Array, offset_mm: float, rig: Rig
) -> float:
    """Root mean square distance of the curve that each view gives from the centrelines of both."""
    curves = [mirrored_curve(sight, normal, offset_mm) for sight in sights]
    off = [_seen_off_px(points, ways, rig) for points in curves if points is not None]
    return float(np.sqrt(np.mean(np.square(off)))) if off else _NO_CURVE_PX


def _seen_off_px(points: Array, ways: Mapping[str, Array], rig: Rig) -> float:
    """Root mean square distance (px) of projected points from both centrelines, and of these from them."""
    squares = []
    for name, way in ways.items():
        local = rig.camera_from_base[name].apply(points)
        if not local[:, 2].min() > 0:
            return _NO_CURVE_PX
        plane = local[:, :2] / local[:, 2:]
        for line, seen in ((way[:, :2], plane), (plane, way[:, :2])):
            squares.append((place_along(line, seen)[1] * rig.cameras[name].focal_px) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def _joined(points: Array, rig: Rig, names: tuple[str, str]) -> Curve3D:
    """Smoothing spline through the halves."""
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    apart = np.append(True, step > 0)
    place = np.concatenate([[0.0], np.cumsum(step)])[apart]
    depth = np.mean([np.linalg.norm(points - rig.centre_mm(n), axis=1).mean() / rig.cameras[n].focal_px for n in names])
    return smoothing(points[apart], place, np.full(len(place), _SD_PX * float(depth)))
