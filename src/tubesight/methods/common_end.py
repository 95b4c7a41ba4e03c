"""Where the end of a tube is not seen: the last point that all views see stands for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tubesight.core import Array, Status, Unmeasurable
from tubesight.geometry.polyline import lengths_along, points_at
from tubesight.geometry.rig import Rig
from tubesight.vision.locate import open_tip
from tubesight.vision.view import View

# Places along each centreline that are compared.
_PLACES = 128
# Views of a tube without a clamp may start at different places: by up to this share of what they show.
_START_SHARE = 0.2
# Centrelines that miss each other's epipolar lines by more than this (rms) are of different things. A rig registered by
# hand from points on a plate gave 1 px, photographs with a good rig 0.1 px.
_MISS_MAX_PX = 4.0
# The end is looked for among this many neighbours of the place that the comparison found.
_NEIGHBOURS = 6
# Fewest scans that have to be left.
_SCANS_MIN = 8


def to_common_end(views: Mapping[str, View], rig: Rig) -> dict[str, View]:
    """Let all views end at the last point of the tube that each of them sees.

    Centrelines are matched in order: among all ways to run along two of them at the same time, forwards, until one
    ends, the one whose places lie nearest to each other's epipolar lines is taken. Where a tube runs along an epipolar
    line for a while, order alone tells its points apart.

    Raises
    ------
    Unmeasurable
        If the centrelines are not of one tube, or little of them is seen by all views.
    """
    names = list(views)
    if len(names) < 2:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="two views are needed")
    ends = {
        name: {other: _place_of_end(views[name], views[other], rig) for other in names if other != name}
        for name in names
    }
    first = max(names, key=lambda name: sum(np.isfinite(place) for place in ends[name].values()))
    return {
        name: _noted(view) if name == first else _until(view, ends[first][name], rig) for name, view in views.items()
    }


def _noted(view: View) -> View:
    return replace(view, notes=(*view.notes, "its last point stands for the tip: the tube may go on"))


def _place_of_end(view: View, other: View, rig: Rig) -> float:
    """Where the end of a view lies along the centreline of another, px; NaN where that ends before."""
    rays, along = _evenly(view)
    other_rays, other_along = _evenly(other)
    miss = epipolar_miss_px(rays, other_rays, rig, view.camera, other.camera)
    last, mean = _in_order(miss**2)
    if not mean <= _MISS_MAX_PX**2:
        raise Unmeasurable(
            Status.VIEWS_DISAGREE,
            detail=f"the centrelines in {view.camera} and {other.camera} miss each other by {mean**0.5:.1f} px",
        )
    if last[0] < len(along) - 1:
        return float("nan")
    low, high = max(last[1] - _NEIGHBOURS, 0), min(last[1] + _NEIGHBOURS + 1, len(other_along))
    row = miss[-1, low:high]
    crossing = np.flatnonzero(np.sign(row[:-1]) != np.sign(row[1:]))
    if not len(crossing):
        return float(other_along[low + int(np.abs(row).argmin())])
    k = crossing[np.abs(crossing + low - last[1]).argmin()]
    return float(np.interp(row[k] / (row[k] - row[k + 1]), [0.0, 1.0], other_along[low + k : low + k + 2]))


def _evenly(view: View) -> tuple[Array, Array]:
    """Rays (K, 3) of a centreline, evenly spread, and their places (K,) along it in px."""
    chord = lengths_along(view.centreline_px)
    along = np.linspace(0.0, chord[-1], _PLACES)
    return points_at(view.rays, chord, along), along


def epipolar_miss_px(rays: Array, other_rays: Array, rig: Rig, camera: str, other: str) -> Array:
    """How far places of two views miss being images of one point: signed Sampson distances (N, M) in pixels.

    ``e / sqrt(|E v'|^2 / f^2 + |E^T v|^2 / f'^2)`` with ``e = v^T E v'``; only the first two components of the lines
    count (Hartley & Zisserman 2004, equation 11.9).

    Parameters
    ----------
    rays, other_rays
        (N, 3), (M, 3) rays ``(x, y, 1)`` of the two cameras.
    """
    essential = rig.essential(camera, other)
    lines, other_lines = other_rays @ essential.T, rays @ essential
    gradient = (lines[:, :2] ** 2).sum(1) / rig.cameras[camera].focal_px ** 2
    other_gradient = (other_lines[:, :2] ** 2).sum(1) / rig.cameras[other].focal_px ** 2
    return np.asarray(rays @ lines.T / np.sqrt(gradient + other_gradient[:, None]))


def _in_order(cost: Array) -> tuple[tuple[int, int], float]:
    """Cheapest way through costs (N, M) from the start of both rows and columns to the end of one (time warping).

    It goes on by one row, one column, or both, and may skip a share of one of them at the start.

    Returns
    -------
    last, mean
        The cell where it ends, and its mean cost.
    """
    rows, columns = cost.shape
    total, cells = np.full((rows + 1, columns + 1), np.inf), np.zeros((rows + 1, columns + 1))
    total[0, : int(_START_SHARE * columns) + 1] = 0.0
    total[: int(_START_SHARE * rows) + 1, 0] = 0.0
    for diagonal in range(rows + columns - 1):
        i = np.arange(max(diagonal - columns + 1, 0), min(diagonal, rows - 1) + 1)
        j = diagonal - i
        before = np.stack([total[i, j], total[i, j + 1], total[i + 1, j]])
        best = before.argmin(0)
        total[i + 1, j + 1] = cost[i, j] + before.min(0)
        cells[i + 1, j + 1] = 1 + np.stack([cells[i, j], cells[i, j + 1], cells[i + 1, j]])[best, np.arange(len(i))]
    mean = total[1:, 1:] / cells[1:, 1:]
    mean[:-1, :-1] = np.inf
    row, column = divmod(int(mean.argmin()), columns)
    return (row, column), float(mean[row, column])


def _until(view: View, place_px: float, rig: Rig) -> View:
    """Leave out what a view shows after a place along its centreline, which becomes its tip."""
    chord = lengths_along(view.centreline_px)
    keep = chord <= place_px
    if keep.sum() < _SCANS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, view.camera, "little of the tube is seen by all cameras")
    ray = points_at(view.rays, chord, np.array(place_px))
    return view.scans(keep, tip=open_tip(ray, rig.cameras[view.camera].project(ray)))
