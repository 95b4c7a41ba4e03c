"""Space carved by silhouettes, after Camarillo, Loewke, Carlson & Salisbury (2008).

Voxels whose projections lie in the silhouettes are kept, coarse to fine; of what is connected to the base, geodesic
distances from there order the voxels; the mean voxel of each step of distance is the centreline, and where the last
one ends is the tip. What is kept is the visual hull, which from few views is fatter than the tube.

Reconstructed here: with many views a voxel may miss one silhouette, since a holder hides a part of the tube from some;
the end of the hull is the surface of the tip, so that the tip lies its radius before it; the mean voxels are joined by
a smoothing spline. The least squares registration to the robot's frame is the rig's, which is calibrated in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from tubesight.core import Array, Mask, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.polyline import lengths_along
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import smoothing
from tubesight.methods.agreement import base_of, reprojection_rms_px, triangulate_tip
from tubesight.methods.regions import regions, rough_way
from tubesight.vision.region import RegionView
from tubesight.vision.view import View

Index = NDArray[np.int64]

# Voxels to a diameter of the tube, and diameters to a voxel of the coarsest grid (a power of two more).
_VOXELS, _HALVINGS = 10, 4
# From so many views on a voxel may miss one silhouette.
_MANY_VIEWS = 5
# Room around what the centrelines say, as a share of its length and in diameters.
_ROOM_SHARE, _ROOM_DIAMETERS = 0.15, 1.5
# Steps of geodesic distance, in diameters, and how much of the tube's start, where the fronts are not yet across it.
_STEP, _START = 0.4, 1.0
# The last steps run around the tip: they are left out from this many of its radii before the end.
_END_RADII = 1.2
# The way at the end is that of the last steps over so many diameters.
_LAST = 1.5
# The end is looked for within this distance of the axis (diameters), and ahead of the last way by so many radii of the
# tip and diameters.
_CORE, _AHEAD = 0.2, 3.0
# A tip is a ball of its own where it is so many times as wide as the tube. Means of its voxels that are taken: on five
# shapes the sixth one moved the tip by less than a tenth of a voxel.
_BALL, _MEANS = 1.2, 6
# Deviation of a mean voxel, in voxels: the grid's noise averages out, the hull's asymmetry does not.
_SD_VOXELS = 0.3
# Fewest steps that make a curve, and largest rms as a share of the tube's width.
_STEPS_MIN, _OFF_WIDTHS = 5, 0.5
# Neighbours of a voxel, each pair once.
_NEIGHBOURS = np.array([(i, j, k) for i in (0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)])


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Carve, thin to a centreline, and end it before the end of the hull.

    Raises
    ------
    Unmeasurable
        If there are not two views, their tips do not meet, no voxel is in their silhouettes, or what is left does not
        project onto the tube.
    """
    # Silhouettes alone tell badly whether the pictures are of one tube.
    triangulate_tip(views, rig)
    seen = regions(views)
    rough = rough_way(seen, rig, 9)
    diameter = tube.diameter_mm or _measured_diameter(seen, rig, rough)
    voxel = diameter / _VOXELS
    kept, sure = carve(seen, rig, rough, diameter)
    if not len(kept):
        raise Unmeasurable(Status.VIEWS_DISAGREE, detail="no place is inside of all silhouettes")
    base = np.zeros(3) if tube.clamped else base_of(views, rig)
    index, distance = _from_base(kept, voxel, rough[0] if base is None else base)
    points = kept[index]
    way = _mean_by_step(points, distance, diameter)
    if len(way) < _STEPS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(way)} steps along the hull")
    tip = _tip(points[sure[index]], way, voxel, diameter, _tip_radius(tube, diameter))
    curve = _joined(base, way, tip, voxel, _END_RADII * max(_tip_radius(tube, diameter), diameter / 2))
    rms = reprojection_rms_px(curve, views, rig)
    if not rms <= _OFF_WIDTHS * min(float(np.median(view.widths_px)) for view in seen.values()):
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.0f} px: the hull is not a tube")
    return curve


def _measured_diameter(views: Mapping[str, RegionView], rig: Rig, rough: Array) -> float:
    name, view = next(iter(views.items()))
    depth = float(rig.camera_from_base[name].apply(rough)[:, 2].mean())
    return float(np.median(view.widths_px)) * depth / rig.cameras[name].focal_px


def _tip_radius(tube: Tube, diameter_mm: float) -> float:
    """How far the surface of the tip lies beyond its place."""
    if tube.tip.shape == "flat":
        return 0.0
    return (tube.tip.diameter_mm or diameter_mm) / 2


def carve(views: Mapping[str, RegionView], rig: Rig, rough_mm: Array, diameter_mm: float) -> tuple[Array, Mask]:
    """Centres (N, 3) of the voxels that lie in all silhouettes, or, with many views, in all but one; which are in all.

    Parameters
    ----------
    rough_mm
        (M, 3) points near the tube.
    """
    misses = 1 if len(views) >= _MANY_VIEWS else 0
    beside = {name: _beside_px(view.mask) for name, view in views.items()}
    length = np.linalg.norm(np.diff(rough_mm, axis=0), axis=1).sum()
    room = _ROOM_SHARE * length + _ROOM_DIAMETERS * diameter_mm
    voxel = diameter_mm / _VOXELS
    size = voxel * 2**_HALVINGS
    low, high = rough_mm.min(0) - room, rough_mm.max(0) + room
    axes = [np.arange(np.floor(a / size), np.ceil(b / size)) for a, b in zip(low, high, strict=True)]
    centres = size * (np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + 0.5)
    for halving in range(_HALVINGS + 1):
        # A voxel may reach into a silhouette by half its diagonal; the finest ones count by their centres.
        reach = np.sqrt(3) / 2 * size if halving < _HALVINGS else 0.0
        missed = np.sum([_misses(centres, reach, name, beside[name], rig) for name in views], axis=0)
        centres, sure = centres[missed <= misses], missed[missed <= misses] == 0
        if halving < _HALVINGS:
            size /= 2
            eighths = size / 2 * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
            centres = (centres[:, None] + eighths).reshape(-1, 3)
    return np.asarray(centres), sure


def _beside_px(mask: Mask) -> Array:
    """Distance (H, W) of each pixel from the silhouette."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5), float)


def _misses(centres: Array, reach_mm: float, name: str, beside_px: Array, rig: Rig) -> Mask:
    """Which voxels (N,) lie beside a silhouette; what a camera does not see is not beside it."""
    camera, local = rig.cameras[name], rig.camera_from_base[name].apply(centres)
    px = camera.project(local)
    inside = camera.contains(px)
    at = np.rint(np.where(inside[:, None], px, 0.0)).astype(int)
    reach_px = reach_mm * camera.focal_px / np.maximum(local[:, 2], reach_mm + 1e-9)
    # Lenses stretch distances by some percent, and pixels are squares: a pixel and a tenth of room.
    room = 1.1 * reach_px + 1.0 if reach_mm else 0.0
    return np.asarray(inside & (beside_px[at[:, 1], at[:, 0]] > room))


def _from_base(centres: Array, voxel_mm: float, base_mm: Array) -> tuple[Index, Array]:
    """Which voxels (N,) are connected to the one nearest to the base, and their geodesic distances (N,)."""
    cells = np.floor(centres / voxel_mm).astype(np.int64)
    cells -= cells.min(0) - 1
    shape = cells.max(0) + 2
    key = np.ravel_multi_index(tuple(cells.T), tuple(shape))
    order = np.argsort(key)
    cells, key = cells[order], key[order]
    pairs = [_paired(cells, key, tuple(shape), step) for step in _NEIGHBOURS]
    rows, columns = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    length = voxel_mm * np.concatenate(
        [np.full(len(pair[0]), np.linalg.norm(step)) for pair, step in zip(pairs, _NEIGHBOURS, strict=True)]
    )
    # Declared for fewer kinds of sparse matrices than it takes.
    graph: Any = coo_matrix((length, (rows, columns)), shape=(len(key), len(key))).tocsr()
    first = int(np.linalg.norm(centres[order] - base_mm, axis=1).argmin())
    distance = np.asarray(dijkstra(graph, directed=False, indices=np.array([first]))[0])
    reached = np.isfinite(distance)
    return order[reached], distance[reached]


def _paired(cells: Index, key: Index, shape: tuple[int, ...], step: Index) -> tuple[Index, Index]:
    """Pairs of voxels (by index) that lie one step from each other."""
    there = np.ravel_multi_index(tuple((cells + step).T), shape)
    found = np.minimum(np.searchsorted(key, there), len(key) - 1)
    both = np.flatnonzero(key[found] == there)
    return both, found[both]


def _mean_by_step(points: Array, distance: Array, diameter_mm: float) -> Array:
    """Mean voxel (K, 3) of each step of geodesic distance."""
    step = (distance / (_STEP * diameter_mm)).astype(np.int64)
    count = np.bincount(step)
    sums = np.stack([np.bincount(step, points[:, k]) for k in range(3)], -1)
    return np.asarray(sums[count > 0] / count[count > 0][:, None])


def _tip(points: Array, way: Array, voxel_mm: float, diameter_mm: float, radius_mm: float) -> Array:
    """Place (3,) of the tip: where the voxels that are in all silhouettes end along the last way, less its radius.

    The middle of a ball is that of its voxels.
    """
    behind = np.linalg.norm(way - way[-1], axis=1)
    last = way[(behind > radius_mm) & (behind < radius_mm + _LAST * diameter_mm)]
    if len(last) < 2:
        last = way[-3:]
    tangent = last[-1] - last[0]
    tangent /= np.linalg.norm(tangent)
    middle = np.mean(last, axis=0)
    along = (points - middle) @ tangent
    aside = np.linalg.norm(points - middle - along[:, None] * tangent, axis=1)
    # The hull has corners where silhouettes meet askew: its end is that of what lies around the axis.
    near = (along > 0) & (along < _AHEAD * (radius_mm + diameter_mm)) & (aside < _CORE * diameter_mm)
    end = (float(along[near].max()) if near.any() else 0.0) + voxel_mm / 2
    tip = np.asarray(middle + (end - radius_mm) * tangent)
    return _centred(points, tip, radius_mm) if radius_mm > _BALL * diameter_mm / 2 else tip


def _centred(points: Array, tip: Array, radius_mm: float) -> Array:
    """Centre (3,) of a ball, from a place in it: the mean of the voxels (N, 3) within its radius, where that stays.

    What lies within the radius of the right place is ball on all sides, the tube's end included.
    """
    for _ in range(_MEANS):
        near = points[np.linalg.norm(points - tip, axis=1) < radius_mm]
        if not len(near):
            break
        tip = near.mean(0)
    return np.asarray(tip)


def _joined(base: Array | None, way: Array, tip: Array, voxel_mm: float, end_mm: float) -> Curve3D:
    """Smoothing spline from the base through the mean voxels to the tip."""
    start = way[0] if base is None else base
    diameter = voxel_mm * _VOXELS
    away = (np.linalg.norm(way - start, axis=1) > _START * diameter) & (np.linalg.norm(way - tip, axis=1) > end_mm)
    nodes = np.vstack([start, way[away], tip])
    place = lengths_along(nodes)
    if len(nodes) < _STEPS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(nodes)} steps along the hull")
    return smoothing(nodes, place, np.full(len(nodes), _SD_VOXELS * voxel_mm))
