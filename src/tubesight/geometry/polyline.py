"""Polylines: arc lengths along them, places at arc lengths, and the nearest place of a point."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array


def lengths_along(points: Array) -> Array:
    """Arc lengths (M,) of the points (M, D) of a polyline from its first one."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def points_at(points: Array, along: Array, places: Array) -> Array:
    """Points (N, D) of a polyline (M, D) at arc lengths (N,), its own being `along` (M,); its ends beyond them."""
    return np.stack([np.interp(places, along, column) for column in points.T], -1)


def place_along(arc_xy: Array, xy: Array) -> tuple[Array, Array]:
    """Nearest place of points on a polyline.

    Parameters
    ----------
    arc_xy
        (M, 2) polyline, M >= 2; neighbouring points may coincide.
    xy
        (N, 2) points; rows of NaN give NaN.

    Returns
    -------
    place, off
        (N,) arc length along the polyline, extended in a straight line past both ends, and (N,) distance from it, past
        the ends the distance to the end point.
    """
    start, step = arc_xy[:-1], np.diff(arc_xy, axis=0)
    length = np.linalg.norm(step, axis=1)
    unit = np.divide(step, length[:, None], out=np.zeros_like(step), where=length[:, None] > 0)
    along = np.concatenate([[0.0], np.cumsum(length)])
    offset = xy[:, None, :] - start[None]
    t = np.einsum("nmk,mk->nm", offset, unit)
    inside = np.clip(t, 0.0, length)
    distance = np.linalg.norm(offset - inside[..., None] * unit, axis=-1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    best = distance.argmin(1)
    rows = np.arange(len(xy))
    before = (best == 0) & (t[rows, best] < 0)
    after = (best == len(step) - 1) & (t[rows, best] > length[best])
    place = along[best] + np.where(before | after, t[rows, best], inside[rows, best])
    off = distance[rows, best]
    missing = ~np.isfinite(off)
    return np.where(missing, np.nan, place), np.where(missing, np.nan, off)
