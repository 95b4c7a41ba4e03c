"""The silhouette as rays: edges of the tube and contours of its tip, from all views, in the base frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Indices, Status, Tube, Unmeasurable, sealed
from tubesight.core.kernels import COMPILED
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods import ray_kernels
from tubesight.vision.view import View

# Rows of edges of a view: left, right, tip.
ROWS = 3
# Edges may all lie this far outwards or inwards in one view (blur, gamma), and each row of them this far by itself
# (limb shading), plus a share of its roughness: what roughens an edge also moves it.
BIAS_PX = 0.2
_ROW_PX, _ROW_SHARE = 0.04, 0.7
# A row whose measurements agree to less than `_AGREE_PX` is charged with less, down to `_STILL_PX`, unless it is
# rougher than `_SMOOTH_PX`. On 76 pairs of rendered photographs with known truth 48 of 304 rows of sides agreed so
# well: they were tilted by 0.015 px, and by 0.006 px off what both sides of their view were off by (rms). Tips rougher
# than 0.1 px were off by 0.24 px and more. 0.008 px: what the mean of 24 edges of 0.04 px is known to.
_AGREE_PX, _SMOOTH_PX, _STILL_PX = 0.01, 0.1, 0.008
# However smooth a row, no edge is known better than this: compression and shading move edges smoothly.
_EDGE_PX = 0.06
# Edges of a row that are used, evenly spread. The errors of a photograph's edges hang together along the tube: with all
# 90 of them the errors of tip and angles on 75 photographs with known truth were the same or larger.
_ROW_MAX, _TIP_MAX = 24, 16
# How well the end of a curve is known along it, until more is known: the first fit of a flat end, and open ends.
_END_SD_MM = 0.02
# End of a curve whose end nobody knows.
_NOWHERE = sealed(np.full(3, np.nan))


class Problem(NamedTuple):
    """Silhouette rays of V views and what is known of the tube: everything a fit needs but the family.

    A tuple of arrays and numbers, since that is what compiled code takes. Rays are sorted by rows, `ROWS` of them in
    each view.

    Attributes
    ----------
    direction
        (N, 3) unit direction of each ray in the base frame.
    place
        (N,) share of the way from base to tip in its view; 1 for rays of the tip.
    lobes
        (N, 2) the two ways in which shading moves a row: sides shift and tilt along the tube; a tip's contour shifts
        as a whole in the picture, along both axes.
    row_start
        (3 V + 1,) first ray of each row.
    row_sd_px, lobe_sd_px
        (3 V,) deviation of the edges of each row, and how far the whole row may be moved by shading.
    centre_mm, focal_px
        (V, 3) and (V,) centre of projection in the base frame, and what turns angles into pixels.
    tip_axis
        (V, 3) unit direction of the tip's axis: a ray of its contour passes the tip on its own side of it.
    start_rotation, start_mm
        (3, 3), (3,) ``base_from_start``: where the curve starts; the identity for a clamp.
    radius_mm
        Radius of the tube, or a first guess of it where `radius_open`.
    tip_radius_mm
        Radius of a ball; NaN where the tip has the tube's own radius.
    radius_open
        Whether `radius_mm` is a guess to be improved.
    clamped
        Whether the start is known or free.
    end_mm, end_sd_mm
        (3,) the middle of a flat end face, or the last point seen of an open end; else NaN; and how well that is known
        along the tube.
    """

    direction: Array
    place: Array
    lobes: Array
    row_start: Indices
    row_sd_px: Array
    lobe_sd_px: Array
    centre_mm: Array
    focal_px: Array
    tip_axis: Array
    start_rotation: Array
    start_mm: Array
    radius_mm: float
    tip_radius_mm: float
    radius_open: bool
    clamped: bool
    end_mm: Array
    end_sd_mm: float

    @property
    def start(self) -> Pose:
        """``base_from_start``."""
        return Pose(self.start_rotation, self.start_mm)


def collect(
    views: Mapping[str, View],
    rig: Rig,
    tube: Tube,
    start: Pose,
    radius_mm: float,
    tip_radius_mm: float | None,
    end_mm: Array | None,
) -> Problem:
    """Gather the edge rays of all views and the rays of ball and rounded tips.

    Raises
    ------
    Unmeasurable
        If a view holds a number that is not finite.
    """
    sight = optics(rig, tuple(views))
    seen = _gathered(views, rig, tube, sight)
    if seen is None:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="an edge of a view is not a finite number")
    return Problem(
        *seen,
        sight.centre_mm,
        sight.focal_px,
        tip_axes(views, sight.rotation),
        start.rotation,
        start.translation_mm,
        radius_mm,
        np.nan if tip_radius_mm is None else tip_radius_mm,
        tube.diameter_mm is None,
        tube.clamped,
        _NOWHERE if end_mm is None else sealed(np.array(end_mm)),
        _END_SD_MM,
    )


def _gathered(
    views: Mapping[str, View], rig: Rig, tube: Tube, sight: Optics
) -> tuple[Array, Array, Array, Indices, Array, Array] | None:
    """Rows of all views: the first fields of `Problem`; None where a number is not finite."""
    row_sd, lobe_sd = list[float](), list[float]()
    for view in views.values():
        sd, whole = deviations(view.edge_sd_px, view.tip.rms_px, view.edge_doubt_px, view.tip.doubt_px)
        row_sd += sd
        lobe_sd += whole
    if not math.isfinite(sum(row_sd) + sum(lobe_sd)):
        return None
    known = lenses(rig, tuple(views)) if COMPILED else None
    if known is not None:
        direction, place, lobes, row_start, finite = ray_kernels.gather(
            *flat(views), *known, sight.rotation, _ROW_MAX, _tip_most(tube)
        )
        if finite:
            return direction, place, lobes, row_start, np.array(row_sd), np.array(lobe_sd)
    counts, parts = [0], []
    for turn, (name, view) in zip(sight.rotation, views.items(), strict=True):
        contour = _used_contour(view, tube)
        rays = rig.cameras[name].unproject(contour)
        parts.append(rows_of_view(view.edge_rays, view.centreline_px, view.tip.px, contour, rays, turn, _ROW_MAX))
        sides = min(len(view.edges_px), _ROW_MAX)
        counts += [sides, sides, len(contour)]
    direction, place, lobes = (np.concatenate(each) for each in zip(*parts, strict=True))
    if not math.isfinite(direction.sum() + place.sum() + lobes.sum()):
        return None
    return direction, place, lobes, np.array(counts).cumsum(), np.array(row_sd), np.array(lobe_sd)


def flat(views: Mapping[str, View]) -> tuple[Array, Array, Array, Indices, Array]:
    """All views in one piece, as compiled code takes them.

    Edge rays (N, 2, 3), centreline (N, 2) and contours (K, 2); how many of them are each view's (V, 2); pixels of the
    tips (V, 2).
    """
    seen = views.values()
    return (
        np.concatenate([view.edge_rays for view in seen]),
        np.concatenate([view.centreline_px for view in seen]),
        np.concatenate([view.tip.contour_px for view in seen]),
        np.array([(len(view.edge_rays), len(view.tip.contour_px)) for view in seen]),
        np.array([view.tip.px.tolist() for view in seen]),
    )


def deviations(
    edge_sd_px: Array, tip_rms_px: float, edge_doubt_px: Array, tip_doubt_px: float
) -> tuple[list[float], list[float]]:
    """Deviation of the edges of each row of a view (3,), and of the whole row (3,), in pixels."""
    left, right = edge_sd_px.tolist()
    rough, doubt = (left, right, tip_rms_px), (*edge_doubt_px.tolist(), tip_doubt_px)
    row_sd = [math.hypot(_EDGE_PX, r) for r in (left, right, max(tip_rms_px, (left + right) / 2))]
    return row_sd, [_lobe_sd(d, r) for d, r in zip(doubt, rough, strict=True)]


def _lobe_sd(doubt_px: float, rough_px: float) -> float:
    """How far a whole row may be moved: fully charged from where its measurements disagree or it is rough."""
    share = min(1.0, max(doubt_px, rough_px - _SMOOTH_PX) / _AGREE_PX)
    return math.hypot(_STILL_PX, share * math.hypot(_ROW_PX, doubt_px + _ROW_SHARE * rough_px))


class Optics(NamedTuple):
    """What does not change from frame to frame: centres (V, 3) and focal lengths (V,); poses ``camera_from_base``."""

    centre_mm: Array
    focal_px: Array
    rotation: Array
    translation_mm: Array


@lru_cache(maxsize=8)
def optics(rig: Rig, names: tuple[str, ...]) -> Optics:
    """Gather the optics of the cameras of some views."""
    poses = [rig.camera_from_base[name] for name in names]
    return Optics(
        np.stack([rig.centre_mm(name) for name in names]),
        np.array([rig.cameras[name].focal_px for name in names]),
        np.stack([pose.rotation for pose in poses]),
        np.stack([pose.translation_mm for pose in poses]),
    )


def tip_axes(views: Mapping[str, View], rotation: Array) -> Array:
    """Directions (V, 3) of the tips' axes in the base frame; rotations (V, 3, 3) are ``camera_from_base``."""
    return np.array([view.tip.axis @ turn for view, turn in zip(views.values(), rotation, strict=True)])


def unprojected(camera: Camera, pixels: Array) -> Array:
    """Camera rays (N, 3) of pixels (N, 2): compiled for the usual lenses, `Camera.unproject` where that fails."""
    known = lens(camera) if COMPILED else None
    if known is not None:
        rays = ray_kernels.undistorted(_plain(pixels), *known)
        if math.isfinite(rays.sum()):
            return rays
    return camera.unproject(pixels)


@lru_cache(maxsize=64)
def lens(camera: Camera) -> tuple[Array, Array] | None:
    """Matrix (3, 3) and coefficients (8,) of a camera as compiled code takes them; None of an equidistant lens."""
    if camera.lens not in ("brown", "rational"):
        return None
    k = np.zeros(8)
    k[: len(camera.distortion)] = camera.distortion
    return camera.matrix, sealed(k)


@lru_cache(maxsize=8)
def lenses(rig: Rig, names: tuple[str, ...]) -> tuple[Array, Array] | None:
    """Matrices (V, 3, 3) and coefficients (V, 8) of cameras; None where `lens` has none of one."""
    known = [lens(rig.cameras[name]) for name in names]
    return None if None in known else (np.stack([k[0] for k in known if k]), np.stack([k[1] for k in known if k]))


def _plain(values: Array) -> Array:
    """Copy of an array laid out as compiled code expects all arrays."""
    return np.array(values, order="C")


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.sqrt((vectors * vectors).sum(1, keepdims=True)))


def used_pixels(view: View, tube: Tube) -> Array:
    """Pixels (n, 2) of the rays of one view, in the order of `collect`."""
    edges = view.edges_px[spread(len(view.edges_px), _ROW_MAX)]
    return np.concatenate([edges[:, 0], edges[:, 1], _used_contour(view, tube)])


def _used_contour(view: View, tube: Tube) -> Array:
    """Pixels (K, 2) of the tip's contour that are used; none of a flat end."""
    contour = view.tip.contour_px
    return contour[spread(len(contour), _tip_most(tube))]


def _tip_most(tube: Tube) -> int:
    return _TIP_MAX if tube.tip.shape != "flat" else 0


def spread(count: int, most: int) -> Indices:
    """Choose at most `most` of `count` things, evenly spread, the first and the last among them."""
    if count <= most:
        return np.arange(count)
    if most < 2:
        return np.arange(most)
    return (np.arange(most) * ((count - 1) / (most - 1)) + 0.5).astype(np.int64)


def rows_of_view(
    edge_rays: Array,
    centreline_px: Array,
    tip_px: Array,
    contour_px: Array,
    contour_rays: Array,
    rotation: Array,
    most: int,
) -> tuple[Array, Array, Array]:
    """Rows of one view: directions in the base frame (n, 3), shares of the way (n,) and lobes (n, 2).

    Parameters
    ----------
    edge_rays, centreline_px, tip_px
        (N, 2, 3), (N, 2), (2,) as in a `View`.
    contour_px, contour_rays
        (K, 2), (K, 3) of the tip.
    rotation
        (3, 3) ``camera_from_base``.
    most
        Edges of each side that are used.
    """
    chosen = spread(len(edge_rays), most)
    way = np.vstack([centreline_px, tip_px])
    step = way[1:] - way[:-1]
    chord = np.sqrt((step * step).sum(1)).cumsum()
    share = np.append(0.0, chord[:-1] / chord[-1])[chosen]
    sides = np.stack([np.ones(len(share)), 2 * share - 1], 1)
    edges = edge_rays[chosen]
    direction = np.concatenate([edges[:, 0], edges[:, 1], _unit(contour_rays)]) @ rotation
    place = np.concatenate([share, share, np.ones(len(contour_px))])
    return direction, place, np.concatenate([sides, sides, _unit(contour_px - tip_px)])
