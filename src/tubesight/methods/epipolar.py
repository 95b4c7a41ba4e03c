"""Point by point along epipolar lines, after Lee & Poston (1997).

Made for angiograms taken about two degrees apart: the epipolar line of each point of one skeleton is intersected with
every segment of the other, the hit that continues the last one is kept, points where the line runs along the curve are
dropped and bridged by a cubic, and what was triangulated is smoothed. So near to each other two views match easily and
measure depth badly: a pixel of one centreline is ``Z / (2 f sin(angle / 2))`` of depth (`depth_per_px`).

Reconstructed here: the skeleton is the bisector of both edges, which a wave that starts from both would meet on; the
ends of the skeletons are a match of their own; across and along the line of sight each is smoothed by its own
deviation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline, UnivariateSpline

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.geometry.shape import angle_between
from tubesight.geometry.splines import by_arc_length
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.methods.centreline import resampled, way_of
from tubesight.vision.view import View

# Places of each skeleton: 1.3 mm apart on a tube of 160 mm.
_PLACES = 121
# |sin| of the angle between epipolar line and skeleton below which the line counts as a tangent.
_TANGENT = 0.12
# A hit may lie off the continuation of the last ones by this share of the skeleton, and by this one for each point
# dropped since.
_JUMP, _JUMP_EACH = 0.04, 0.01
# The way of the hits is extrapolated from so many last ones.
_LAST = 4
# Deviation of a centreline, px: photographs leave 0.1.
_SD_PX = 0.15
# Fewest matches: a cubic with some to spare.
_MATCHES_MIN = 8
# A bridge over a larger share of the skeleton is a guess, not a measurement.
_BRIDGE_MAX = 0.5
# Curves that leave the centrelines by more than this are wrong: right ones leave 0.1 to 0.5 px.
_RMS_MAX_PX = 3.0


def depth_per_px(rig: Rig, one: str, other: str, point_mm: Array) -> float:
    """Depth (mm) of a place for each pixel by which its match in one of two views is off."""
    way, back = rig.centre_mm(one) - point_mm, rig.centre_mm(other) - point_mm
    depth = (float(np.linalg.norm(way)) + float(np.linalg.norm(back))) / 2
    focal = min(rig.cameras[name].focal_px for name in (one, other))
    return depth / (2 * focal * float(np.sin(angle_between(way, back) / 2)))


class _Matches(NamedTuple):
    """Matched places: (N,) of the first skeleton, (N,) of the second, in places; (N,) sines of the crossing angles."""

    place: Array
    other: Array
    crossing: Array


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Match two skeletons point by point, triangulate, bridge and smooth.

    Parameters
    ----------
    views
        By camera name; the first two are used.

    Raises
    ------
    Unmeasurable
        If there are not two views, too few points match, or the curve does not agree with the views.
    """
    if len(views) < 2:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="two views are needed")
    one, other = list(views)[:2]
    share = np.linspace(0.0, 1.0, _PLACES)
    ways = [resampled(way_of(views[name]), share) for name in (one, other)]
    matches = match(ways[0], ways[1], rig.essential(one, other))
    gap = float(np.diff(matches.place).max()) / (_PLACES - 1)
    if len(matches.place) < _MATCHES_MIN or gap > _BRIDGE_MAX:
        raise Unmeasurable(
            Status.NEAR_DEGENERATE,
            detail=f"{len(matches.place)} of {_PLACES} points match; the epipolar lines run along the tube",
        )
    points = rig.triangulate({one: _along(ways[0], matches.place), other: _along(ways[1], matches.other)})
    if not np.isfinite(points).all():
        raise Unmeasurable(Status.VIEWS_DISAGREE, detail="matched points do not lie in front of the cameras")
    curve = _smoothed(points, matches, rig, one, other)
    rms = reprojection_rms_px(curve, {name: views[name] for name in (one, other)}, rig)
    if not rms <= _RMS_MAX_PX:
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.1f} px")
    return curve


def match(one: Array, other: Array, essential: Array) -> _Matches:
    """Follow the first skeleton (N, 3) and keep, of all hits of its epipolar lines, those that continue one another."""
    lines = one @ essential
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    off = lines @ other.T
    segment = np.diff(other, axis=0)[:, :2]
    length = np.linalg.norm(segment, axis=1)
    scale = (len(other) - 1) / (len(one) - 1)
    found = [(0.0, 0.0, 1.0)]
    for i in range(1, len(one) - 1):
        before, after = off[i, :-1], off[i, 1:]
        hit = np.flatnonzero((before * after <= 0) & (before != after))
        if not len(hit):
            continue
        place = hit + before[hit] / (before[hit] - after[hit])
        best = int(np.abs(place - _expected(found, i, scale)).argmin())
        room = (_JUMP + _JUMP_EACH * (i - found[-1][0])) * (len(other) - 1)
        crossing = float(np.abs(lines[i, :2] @ segment[hit[best]]) / length[hit[best]])
        forwards = place[best] > found[-1][1]
        if crossing > _TANGENT and forwards and abs(place[best] - _expected(found, i, scale)) < room:
            found.append((float(i), float(place[best]), crossing))
    found.append((float(len(one) - 1), float(len(other) - 1), 1.0))
    return _Matches(*np.array(found).T)


def _expected(found: list[tuple[float, float, float]], i: int, scale: float) -> float:
    """Where the next hit is expected: the last ones continued, or the same share of both skeletons."""
    last = found[-_LAST:]
    rate = (last[-1][1] - last[0][1]) / (last[-1][0] - last[0][0]) if len(last) > 1 else scale
    return last[-1][1] + rate * (i - last[-1][0])


def _along(way: Array, place: Array) -> Array:
    k = np.arange(len(way))
    return np.stack([np.interp(place, k, way[:, c]) for c in range(3)], -1)


def _smoothed(points: Array, matches: _Matches, rig: Rig, one: str, other: str) -> Curve3D:
    """Bridge what was dropped by cubics and smooth, in a frame whose third axis is the line of sight."""
    places, bridged = _bridged(points, matches.place)
    sight = rig.camera_from_base[one].rotation[2] + rig.camera_from_base[other].rotation[2]
    frame = np.linalg.svd(sight[None] / np.linalg.norm(sight))[2]
    local = bridged @ frame.T
    focal = min(rig.cameras[name].focal_px for name in (one, other))
    across = _SD_PX * float(np.linalg.norm(rig.centre_mm(one) - points.mean(0))) / focal
    crossing = np.interp(places, matches.place, matches.crossing)
    deep = _SD_PX * depth_per_px(rig, one, other, points.mean(0)) / crossing
    u = places / places[-1]
    # The first axis of the frame is the line of sight, the others lie across it.
    splines = [
        UnivariateSpline(u, local[:, k], w=1 / (deep if k == 0 else np.full(len(u), across)), s=len(u))
        for k in range(3)
    ]
    slopes = [spline.derivative() for spline in splines]
    return by_arc_length(
        "spline",
        lambda t: np.stack([spline(t) for spline in splines], -1) @ frame,
        lambda t: np.stack([slope(t) for slope in slopes], -1) @ frame,
    )


def _bridged(points: Array, place: Array) -> tuple[Array, Array]:
    """Fill gaps of the places (N,) by a cubic Hermite piece between their ends (N, 3)."""
    tangent = np.gradient(points, place, axis=0)
    spline = CubicHermiteSpline(place, points, tangent)
    missing = np.setdiff1d(np.arange(place[-1] + 1), place)
    places = np.sort(np.concatenate([place, missing]))
    return places, np.asarray(spline(places))
