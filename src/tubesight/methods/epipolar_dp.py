"""Two centrelines matched as a whole: the monotone correspondence of least epipolar distance (after Hoffmann 2012).

Both centrelines run from base to tip, so that their correspondence is a monotone way through the square of their
places. The signed epipolar distance is a smooth function on that square and vanishes on the true way; dynamic
programming finds the cheapest monotone way, whatever the shape: also where a centreline crosses
itself or an epipolar line meets it often. Where the tube runs along the epipolar plane, the distance is flat across the
way and a match says little: there the smoothing spline bridges, since it weighs points by their crossing angle.

The dynamic programming is a reconstruction from the descriptions in Hoffmann, Brost, Schaefer, Koch, Bourier,
Strobel 2012 and its successors, which skeletonise and match by epipolar distance; not their code.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from scipy.ndimage import map_coordinates

from tubesight.core import Array, Indices, Mask, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.matching import monotone_way
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import smoothing
from tubesight.methods.agreement import best_pair, reprojection_rms_px, triangulate_tip
from tubesight.methods.centreline import resampled, way_and_gaps
from tubesight.vision.view import View

# Places of each centreline: 1.3 mm apart on a tube of 160 mm; matches are found between them.
_PLACES = 121
# Deviation of a centreline from the true one, with what a linear step between places adds, px: photographs leave 0.1.
_SD_PX = 0.15
# An epipolar distance above this says no more than that there is no match: what hides a part of the tube must not
# decide where the rest goes.
_LARGEST_PX = 6.0
# A step of a centreline over this many times the usual one spans a gap. What lies in it is not seen but continued as a
# cubic, on the shapes of the tests a few pixels off: it decides less of the way, and of the curve.
_GAP_STEPS, _GAP_SD = 3.0, 10.0
# Cost of a step along one centreline alone, in squared pixels: it breaks ties where the distance is flat.
_SKIP = 0.01
# |sin| of the crossing angle below which a match is not used at all.
_CROSSING_MIN = 0.02
# Steps by which a match slides to distance zero between places: the distance is nearly linear there.
_REFINE = 3
# Deviation of a clamp or of a triangulated tip against a match: they hold the ends of the spline.
_END_SD_MM = 0.01
# Median distance, px, of the matches from each other's epipolar lines above which the views are not of one curve.
_GAP_MAX_PX = 2.0
# Fewest usable matches: four knots of a cubic with some to spare.
_MATCHES_MIN = 12
# Curves that leave the tube's centreline in a view by more than this are wrong: right ones leave 0.1 to 0.6 px.
_RMS_MAX_PX = 1.5
# Fits of edges still reach their end from curves that are this far off.
_RMS_START_PX = 6.0


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Match two centrelines, triangulate the matches and smooth them by a cubic spline of fewest knots.

    Parameters
    ----------
    views
        By camera name; the two at the largest angle are used where there are more.

    Raises
    ------
    Unmeasurable
        If the centrelines are not of one curve, or too few of the matches fix a point.
    """
    curve, rms = _likeliest(views, rig, tube)
    if not rms <= _RMS_MAX_PX:
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.1f} px")
    return curve


def start(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Find the same curve as a start for another method: it may be farther off the centrelines."""
    curve, rms = _likeliest(views, rig, tube)
    if not rms <= _RMS_START_PX:
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.1f} px")
    return curve


def _likeliest(views: Mapping[str, View], rig: Rig, tube: Tube) -> tuple[Curve3D, float]:
    """Of the ways to bridge gaps, curves or corners, take that with the least distance from the centrelines."""
    one, other = best_pair(views, rig)
    options = {name: [way_and_gaps(views[name], corners) for corners in (False, True)] for name in (one, other)}
    for ways in options.values():
        if np.array_equal(ways[0][0], ways[1][0]):
            ways.pop()
    found: list[tuple[float, Curve3D]] = []
    failure = Unmeasurable(Status.VIEWS_DISAGREE)
    for pair in product(*options.values()):
        try:
            curve = _matched(dict(zip((one, other), pair, strict=True)), views, rig, tube)
        except Unmeasurable as caught:
            failure = caught
        else:
            found.append((max(reprojection_rms_px(curve, {n: views[n]}, rig) for n in (one, other)), curve))
    if not found:
        raise failure
    rms, curve = min(found, key=lambda each: each[0])
    return curve, rms


def _matched(whole: Mapping[str, tuple[Array, Mask]], views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Curve from two whole centrelines by camera, each with its gaps."""
    one, other = whole
    share = np.linspace(0.0, 1.0, _PLACES)
    ways = {name: resampled(way, share) for name, (way, _) in whole.items()}
    off = epipolar_distance_px(ways[one], ways[other], rig, one, other)
    unseen = [in_gap(*whole[name], share) for name in (one, other)]
    doubt = np.where(unseen[0][:, None] | unseen[1], _GAP_SD, 1.0)
    way = monotone_way(np.minimum(np.abs(off) / doubt, _LARGEST_PX) ** 2, _SKIP)
    guessed = unseen[0][way[:, 0]] | unseen[1][way[:, 1]]
    u, v = _refined(off, way)
    if not float(np.median(np.abs(_at(off, u, v)))) <= _GAP_MAX_PX:
        raise Unmeasurable(Status.VIEWS_DISAGREE, detail="the two centrelines do not match along epipolar lines")
    crossing = _crossing(off, u, v, ways, rig)
    used = (crossing > _CROSSING_MIN) & (np.abs(_at(off, u, v)) < _GAP_MAX_PX)
    if used.sum() < _MATCHES_MIN:
        raise Unmeasurable(
            Status.NEAR_DEGENERATE, detail=f"{int(used.sum())} places of the tube lie across the epipolar plane"
        )
    points = rig.triangulate({one: _along(ways[one], u[used]), other: _along(ways[other], v[used])})
    depth = np.mean([rig.camera_from_base[n].apply(points)[:, 2] / rig.cameras[n].focal_px for n in ways], axis=0)
    sd = _SD_PX * depth / crossing[used] * np.where(guessed[used], _GAP_SD, 1.0)
    ends = [np.zeros(3) if tube.clamped else None, triangulate_tip(views, rig)]
    return smoothing(*_with_ends(points, (u + v)[used], sd, ends))


def in_gap(way: Array, hidden: Mask, share: Array) -> Mask:
    """Which shares (K,) of the length of a centreline (N, 3), some of whose places (N,) are hidden, were not seen."""
    step = np.linalg.norm(np.diff(way, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(step)]) / step.sum()
    gap = (step > _GAP_STEPS * np.median(step)) | hidden[1:] | hidden[:-1]
    # Clamp and tip are known where the edges beside them are not measured.
    gap[[0, -1]] = False
    return np.asarray(gap[np.clip(np.searchsorted(along, share, side="right") - 1, 0, len(gap) - 1)])


def epipolar_distance_px(one_way: Array, other_way: Array, rig: Rig, one: str, other: str) -> Array:
    """Signed distances (N, M) of each pair of rays from satisfying the epipolar constraint, in pixels.

    ``x^T E y`` over the root of the squares of its derivatives by both image points (Sampson's approximation).

    Parameters
    ----------
    one_way, other_way
        (N, 3), (M, 3) rays ``v = (x, y, 1)`` of cameras `one` and `other`.
    """
    essential = rig.essential(one, other)
    lines, back = other_way @ essential.T, one_way @ essential
    slope = (lines[None, :, :2] ** 2).sum(-1) / rig.cameras[one].focal_px ** 2
    slope = slope + (back[:, None, :2] ** 2).sum(-1) / rig.cameras[other].focal_px ** 2
    return np.asarray(one_way @ lines.T / np.sqrt(slope))


def _at(off_px: Array, u: Array, v: Array) -> Array:
    return np.asarray(map_coordinates(off_px, [u, v], order=1, mode="nearest"))


def _refined(off_px: Array, way: Indices) -> tuple[Array, Array]:
    """Slide the matches of a way to distance zero between the places (K,), by at most one place."""
    slope = [np.gradient(off_px, axis=axis) for axis in (0, 1)]
    u, v = way[:, 0].astype(float), way[:, 1].astype(float)
    for _ in range(_REFINE):
        du, dv = (_at(part, u, v) for part in slope)
        size = np.maximum(du * du + dv * dv, 1e-12)
        by = _at(off_px, u, v) / size
        u = np.clip(u - np.clip(by * du, -0.5, 0.5), 0, off_px.shape[0] - 1)
        v = np.clip(v - np.clip(by * dv, -0.5, 0.5), 0, off_px.shape[1] - 1)
    # What slid past its neighbour is held back: the way stays monotone.
    return np.maximum.accumulate(u), np.maximum.accumulate(v)


def _crossing(off_px: Array, u: Array, v: Array, ways: Mapping[str, Array], rig: Rig) -> Array:
    """How squarely the epipolar lines cross the curve at each match: pixels of distance by pixel along the curve."""
    slopes = []
    for axis, (name, way) in enumerate(ways.items()):
        step_px = rig.cameras[name].focal_px * np.linalg.norm(np.diff(way, axis=0), axis=1).sum() / (len(way) - 1)
        slopes.append(_at(np.gradient(off_px, axis=axis), u, v) / step_px)
    return np.asarray(np.hypot(*slopes))


def _along(way: Array, place: Array) -> Array:
    return np.stack([map_coordinates(way[:, k], [place], order=3, mode="nearest") for k in range(3)], -1)


def _with_ends(points: Array, place: Array, sd: Array, ends: list[Array | None]) -> tuple[Array, Array, Array]:
    """Put known ends before and after the matches, one match a place, in order."""
    last = 2.0 * (_PLACES - 1)
    inner = (place > 0) & (place < last) & np.isfinite(points).all(1)
    _, first = np.unique(np.round(place[inner], 3), return_index=True)
    points, place, sd = points[inner][first], place[inner][first], sd[inner][first]
    for end, at in zip(ends, (0.0, last), strict=True):
        if end is not None:
            points, place, sd = np.vstack([points, end]), np.append(place, at), np.append(sd, _END_SD_MM)
    order = np.argsort(place)
    return points[order], place[order], sd[order]
