"""The whole centreline of a view: from base to tip, over its gaps."""

from __future__ import annotations

import math

import numpy as np

from tubesight.core import Array, Mask
from tubesight.geometry.polyline import lengths_along
from tubesight.vision.view import View

# Places of a centreline nearer to the next one than this share of the median step are left out of a spline.
_NEAR_STEPS = 0.3
# Steps of so many usual ones are gaps. Ways that turn by less have no corner; where they meet farther away than so many
# times the gap they are nearly parallel, and say little of it.
_GAP_STEPS, _CORNER_RAD, _CORNER_FAR = 1.6, 0.8, 3.0
# Fewest places that tell the way at an end.
_ENDS = 5


def way_of(view: View) -> Array:
    """Rays ``v = (x, y, 1)`` (N, 3) of the whole centreline of a view: base, centreline with its gaps bridged, tip."""
    return way_and_gaps(view)[0]


def way_and_gaps(view: View, corners: bool = False) -> tuple[Array, Mask]:
    """Rays (N, 3) of the whole centreline of a view, as `way_of`, and which of them (N,) lie in gaps.

    Parameters
    ----------
    corners
        Where the ways on both sides of a gap meet at an angle, it is bridged by that corner: a tube that bends towards
        the camera goes round one. Else by a cubic that continues both.
    """
    way, gap = _bridged(view.rays, corners)
    whole = np.vstack([view.base, way, view.tip.axis / view.tip.axis[2]])
    return whole, np.concatenate([[False], gap, [False]])


def _bridged(way: Array, corners: bool) -> tuple[Array, Mask]:
    """Add to a centreline (N, 3) what lies in its gaps; tell which it is."""
    step = np.linalg.norm(np.diff(way[:, :2], axis=0), axis=1)
    usual = float(np.median(step))
    inserted, at = [], []
    for k in np.flatnonzero(step > _GAP_STEPS * usual):
        if not _ENDS <= k + 1 <= len(way) - _ENDS:
            continue
        reach = max(step[k], _ENDS * usual)
        one, other = _end_way(way[: k + 1, :2], reach), _end_way(way[:k:-1, :2], reach)
        count = math.ceil(step[k] / usual)
        chord = way[k + 1, :2] - way[k, :2]
        corner = _corner(one, other, chord) if corners else None
        places = (_cubic(one, other, chord, count) if corner is None else corner) + way[k, :2]
        inserted.append(np.column_stack([places, np.ones(len(places))]))
        at += [k + 1] * len(places)
    if not at:
        return way, np.zeros(len(way), dtype=bool)
    return np.insert(way, at, np.concatenate(inserted), axis=0), np.insert(np.zeros(len(way)), at, 1.0) > 0


def _turn(one: Array, other: Array) -> float:
    """Angle between a way that leaves one end and one that comes to another one, which is left along `other`."""
    return math.atan2(one[0] * other[1] - one[1] * other[0], -(one @ other))


def _corner(one: Array, other: Array, chord: Array) -> Array | None:
    """Corner (1, 2) in which the ways that leave both ends of a chord meet; None where they are nearly one line."""
    if abs(_turn(one, other)) < _CORNER_RAD:
        return None
    a, b = np.linalg.solve(np.stack([one, -other], 1), chord)
    far = _CORNER_FAR * np.linalg.norm(chord)
    return (a * one)[None] if 0 < a < far and 0 < b < far else None


def _cubic(one: Array, other: Array, chord: Array, count: int) -> Array:
    """Places (count - 1, 2) of a cubic over a chord that leaves both of its ends along given ways."""
    # Tangents of this length make an arc of a circle of a cubic.
    size = float(np.linalg.norm(chord)) / math.cos(_turn(one, other) / 4) ** 2
    t = np.arange(1, count)[:, None] / count
    return np.asarray(t * (1 - t) ** 2 * size * one + t**2 * (3 - 2 * t) * chord + t**2 * (1 - t) * size * other)


def _end_way(way: Array, reach: float) -> Array:
    """Tell the unit way (2,) in which places (N, 2) leave their end, by a parabola through the last `reach`."""
    off = np.linalg.norm(way - way[-1], axis=1)
    first = min(int(np.flatnonzero(off > reach).max(initial=-1)) + 1, len(way) - _ENDS)
    along = np.vander(-off[first:] / off[first], 3, increasing=True)
    slope = np.linalg.lstsq(along, way[first:], rcond=None)[0][1]
    return np.asarray(slope / np.linalg.norm(slope))


def resampled(way: Array, share: Array) -> Array:
    """Rays (K, 3) at shares (K,) of the length of a centreline (N, 3) on the image plane, by a cubic spline."""
    from scipy.interpolate import CubicSpline  # here: importing it takes as long as a first result

    step = np.linalg.norm(np.diff(way, axis=0), axis=1)
    # Of two places nearer to each other than a part of the usual step the direction is noise: the end stays.
    apart = np.append(step > _NEAR_STEPS * np.median(step), True)
    kept = way[apart]
    along = lengths_along(kept)
    return np.asarray(CubicSpline(along / along[-1], kept)(share))
