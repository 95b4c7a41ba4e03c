"""How good a calibration is: figures, a verdict in words and the next step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from tubesight.calibration.bundle import Adjusted
from tubesight.calibration.scene import POSE, Observation, rms
from tubesight.core import Array
from tubesight.geometry.rig import Rig

# Cells of the picture, columns and rows, that count as covered when a corner lies in them.
CELLS = (8, 6)
# RMS in pixels: measured corners on sharp pictures give 0.02 to 0.2; above 0.5 something is wrong (board not flat,
# pictures not of one instant, lens model too simple), above 1.5 the rig is of no use.
_GOOD_PX, _USABLE_PX = 0.5, 1.5
# The same for the deviation the rig adds to points, as a share of their distance: 0.1 mm at 300 mm, and 3 mm.
_GOOD_SHARE, _USABLE_SHARE = 3e-4, 1e-2
# Views per camera that are recommended, and below which a good fit says little.
_MANY_VIEWS, _FEW_VIEWS = 10, 6
# Share of the cells covered below which the lens is guessed in a large part of the picture.
_LITTLE_COVERED = 0.3
# Angle between the rays of two cameras, degrees, below which (or its supplement) depth is poorly fixed.
_SMALL_ANGLE_DEG = 15.0
# Largest angle between two boards, degrees, below which focal length and distance trade off against each other.
_SMALL_TILT_DEG = 15.0
_REGIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)
# Points at which the precision is predicted.
_POINTS = 60


@dataclass(frozen=True, slots=True, eq=False)
class CameraQuality:
    """One camera.

    Attributes
    ----------
    views
        Number of pictures used.
    coverage
        (rows, columns): corners in each cell of the picture.
    sd
        Standard deviation of each free lens parameter.
    tilt_deg
        Largest angle between the planes of two boards.
    """

    views: int
    rms_px: float
    coverage: Array
    sd: Mapping[str, float]
    tilt_deg: float = float("nan")

    @property
    def covered(self) -> float:
        """Share of the cells that hold a corner."""
        return float(np.mean(self.coverage > 0))

    @property
    def coverage_words(self) -> str:
        """Coverage in words: the share of the picture and the regions without a corner."""
        rows, columns = self.coverage.shape
        thirds = [np.array_split(np.arange(n), 3) for n in (rows, columns)]
        empty = [
            _REGIONS[i][j]
            for i in range(3)
            for j in range(3)
            if not self.coverage[np.ix_(thirds[0][i], thirds[1][j])].any()
        ]
        return f"{100 * self.covered:.0f} % of the picture" + (f", none {', '.join(empty)}" if empty else "")


@dataclass(frozen=True, slots=True, eq=False)
class PairQuality:
    """Two cameras.

    Attributes
    ----------
    shared
        Number of views both see.
    angle_deg, ray_angle_deg
        Angle between the optical axes; between the rays to the same corners (median; NaN without shared views).
    epipolar_px
        RMS distance of corners from the epipolar lines of the same corners in the other camera; NaN without shared
        views.
    board_mm
        RMS distance of triangulated corners from the board laid over them; NaN likewise.
    """

    cameras: tuple[str, str]
    shared: int
    baseline_mm: float
    angle_deg: float
    ray_angle_deg: float
    epipolar_px: float
    board_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """A calibrated rig.

    Attributes
    ----------
    point_sd_mm
        Predicted standard deviation of points triangulated where the boards were, as far as the rig causes it, in the
        base frame, or before registration as deviation of their shape; NaN for one camera.
    distance_mm
        Median distance of the boards from the cameras.
    """

    cameras: Mapping[str, CameraQuality]
    pairs: tuple[PairQuality, ...]
    rms_px: float
    point_sd_mm: float
    distance_mm: float


def assess(rig: Rig, adjusted: Adjusted) -> Quality:
    """Work out the figures of an adjusted rig, from all observations that were not loosened."""
    pairs_of = zip(adjusted.observations, adjusted.residuals_px, strict=True)
    firm = [(o, r) for o, r in pairs_of if o.sd_px == 1]
    adjusted = replace(adjusted, observations=tuple(o for o, _ in firm), residuals_px=tuple(r for _, r in firm))
    cameras = {name: _camera_quality(rig, adjusted, name) for name in rig.names}
    pairs = tuple(_pair_quality(rig, adjusted, a, b) for a, b in combinations(rig.names, 2))
    scene = adjusted.scene
    poses = [scene.camera_from_base[o.camera] @ scene.base_from_view[o.view] for o in adjusted.observations]
    places = [p.apply(o.points_mm.mean(0)) for p, o in zip(poses, adjusted.observations, strict=True)]
    distance = float(np.median(np.linalg.norm(places, axis=1)))
    return Quality(cameras, pairs, adjusted.rms_px, _point_sd_mm(rig, adjusted), distance)


def _camera_quality(rig: Rig, adjusted: Adjusted, name: str) -> CameraQuality:
    own = [(o, r) for o, r in zip(adjusted.observations, adjusted.residuals_px, strict=True) if o.camera == name]
    width, height = rig.cameras[name].size_px
    px = np.concatenate([o.px for o, _ in own])
    counts, _, _ = np.histogram2d(px[:, 1], px[:, 0], bins=(CELLS[1], CELLS[0]), range=((0, height), (0, width)))
    covariance = rig.covariance
    sd = {}
    if covariance is not None:
        for full, variance in zip(covariance.names, covariance.matrix.diagonal(), strict=True):
            camera, _, parameter = full.rpartition(".")
            if camera == name and parameter not in POSE:
                sd[parameter] = float(np.sqrt(max(variance, 0.0)))
    normals = np.stack([adjusted.scene.base_from_view[o.view].rotation[:, 2] for o, _ in own])
    tilt = float(_angle_deg(normals @ normals.T).max())
    return CameraQuality(len(own), rms([r for _, r in own]), counts, sd, tilt)


def _shared(adjusted: Adjusted, a: str, b: str) -> list[tuple[Observation, Observation]]:
    """Observations of the same view by two cameras, cut to the points both see."""
    seen = {name: _by_view(adjusted, name) for name in (a, b)}
    pairs = []
    for view, first in seen[a].items():
        if (second := seen[b].get(view)) is not None:
            index = {tuple(p): i for i, p in enumerate(second.points_mm)}
            both = [(i, index[tuple(p)]) for i, p in enumerate(first.points_mm) if tuple(p) in index]
            if both:
                i, j = np.array(both).T
                pairs.append(
                    (
                        Observation(a, view, first.points_mm[i], first.px[i]),
                        Observation(b, view, second.points_mm[j], second.px[j]),
                    )
                )
    return pairs


def _by_view(adjusted: Adjusted, camera: str) -> dict[str, Observation]:
    """One observation a view: the base frame of a registration may have several."""
    views: dict[str, list[Observation]] = {}
    for o in adjusted.observations:
        if o.camera == camera:
            views.setdefault(o.view, []).append(o)
    return {
        view: Observation(camera, view, np.concatenate([o.points_mm for o in own]), np.concatenate([o.px for o in own]))
        for view, own in views.items()
    }


def _pair_quality(rig: Rig, adjusted: Adjusted, a: str, b: str) -> PairQuality:
    pairs = _shared(adjusted, a, b)
    essential = rig.essential(a, b)
    epipolar, board, angles = [], [], []
    for first, second in pairs:
        rays_a, rays_b = rig.cameras[a].unproject(first.px), rig.cameras[b].unproject(second.px)
        lines_b, lines_a = rays_a @ essential, rays_b @ essential.T
        product = (rays_a * lines_a).sum(1)
        epipolar.append(product / np.linalg.norm(lines_a[:, :2], axis=1) * rig.cameras[a].focal_px)
        epipolar.append(product / np.linalg.norm(lines_b[:, :2], axis=1) * rig.cameras[b].focal_px)
        points = rig.triangulate({a: rays_a, b: rays_b})
        off = points - adjusted.scene.base_from_view[first.view].apply(first.points_mm)
        board.append(np.linalg.norm(off, axis=1))
        angles.append(_angle_deg((rig.directions(a, rays_a) * rig.directions(b, rays_b)).sum(1)))
    axes = [rig.camera_from_base[n].rotation[2] for n in (a, b)]
    return PairQuality(
        (a, b),
        len(pairs),
        float(np.linalg.norm(rig.centre_mm(a) - rig.centre_mm(b))),
        float(_angle_deg(axes[0] @ axes[1])),
        float(np.median(np.concatenate(angles))) if angles else float("nan"),
        _rms(epipolar),
        _rms(board),
    )


def _angle_deg(cosine: ArrayLike) -> Array:
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _rms(values: Sequence[Array]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(values) ** 2))) if values else float("nan")


def _point_sd_mm(rig: Rig, adjusted: Adjusted) -> float:
    """Predict the deviation of triangulated points from the covariance of the rig (median over the boards' corners)."""
    covariance = rig.covariance
    if covariance is None or len(rig.names) < 2:
        return float("nan")
    scene = adjusted.scene
    points = np.concatenate([scene.base_from_view[o.view].apply(o.points_mm) for o in adjusted.observations])
    points = points[:: max(1, len(points) // _POINTS)]
    seen = {n: rig.cameras[n].unproject(rig.project(n, points)) for n in rig.names}
    px = {n: rig.project(n, points) for n in rig.names}
    good = np.all([np.isfinite(v).all(1) for v in seen.values()], axis=0)
    if not good.any():
        return float("nan")
    slopes = []
    for name, variance in zip(covariance.names, covariance.matrix.diagonal(), strict=True):
        # A tenth of a standard deviation: small against the curvature of the projection, large against rounding.
        step = 0.1 * float(np.sqrt(max(variance, 1e-30)))
        ends = []
        for sign in (1, -1):
            moved = rig.perturbed(name, sign * step)
            ends.append(moved.triangulate({n: moved.cameras[n].unproject(px[n][good]) for n in rig.names}))
        slopes.append((ends[0] - ends[1]) / (2 * step))
    by_parameter = np.stack(slopes, -1)
    known = np.isfinite(by_parameter).all((1, 2))
    if not known.any():
        return float("nan")
    by_parameter, points = by_parameter[known], points[good][known]
    if not rig.registered:
        by_parameter = _without_rigid_motion(by_parameter, points)
    variances = np.einsum("nip,pq,niq->n", by_parameter, covariance.matrix, by_parameter)
    return float(np.sqrt(np.median(variances)))


def _without_rigid_motion(by_parameter: Array, points_mm: Array) -> Array:
    """Take rigid motions of all points together out of their derivatives (N, 3, P)."""
    centred = points_mm - points_mm.mean(0)
    turns = np.cross(np.eye(3)[:, None], centred[None])
    shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
    motions, _ = np.linalg.qr(np.concatenate([turns, shifts]).reshape(6, -1).T)
    flat = by_parameter.reshape(-1, by_parameter.shape[-1])
    return np.asarray((flat - motions @ (motions.T @ flat)).reshape(by_parameter.shape))


@dataclass(frozen=True, slots=True)
class Verdict:
    """A judgement in words: its level (``good``, ``usable``, ``poor``), a sentence, remarks, and the next step."""

    level: str
    sentence: str
    remarks: tuple[str, ...]
    next_step: str


def judge(quality: Quality, registered: bool) -> Verdict:
    """Judge a calibration in words."""
    cameras = quality.cameras.values()
    worst_px = max(c.rms_px for c in cameras)
    few = min(c.views for c in cameras) < _FEW_VIEWS or min(c.tilt_deg for c in cameras) < _SMALL_TILT_DEG
    share = np.nan_to_num(quality.point_sd_mm / quality.distance_mm, nan=0.0)
    if worst_px > _USABLE_PX or share > _USABLE_SHARE:
        level = "poor"
    else:
        level = "usable" if worst_px > _GOOD_PX or share > _GOOD_SHARE or few else "good"
    sentence = f"{level}: corners fit within {quality.rms_px:.2g} px RMS"
    if np.isfinite(quality.point_sd_mm):
        # A board's squares are true to no better than a micrometre.
        adds = max(quality.point_sd_mm, 1e-3)
        amount = f"{adds:.1g}" if adds < 1 else f"{adds:.0f}"
        sentence += f"; the rig itself adds about {amount} mm to points where the boards were"
    if level == "poor":
        step = "calibrate again: more tilts, board flat and still, focus locked, all pictures of an instant together"
    else:
        step = "measure with `tubesight run`" if registered else "place the base frame with `tubesight register`"
    return Verdict(level, sentence, tuple(_remarks(quality)), step)


def _remarks(quality: Quality) -> list[str]:
    remarks = []
    for name, camera in quality.cameras.items():
        if camera.views < _MANY_VIEWS:
            remarks.append(f"{name}: only {camera.views} views; {_MANY_VIEWS} or more tilts are better")
        if camera.tilt_deg < _SMALL_TILT_DEG:
            remarks.append(
                f"{name}: all boards are within {camera.tilt_deg:.0f} degrees of each other, which leaves the focal "
                "length open; tilt them by 20 to 45 degrees about different axes"
            )
        if camera.covered < _LITTLE_COVERED:
            remarks.append(
                f"{name}: corners cover {camera.coverage_words}; the lens is guessed elsewhere, "
                "so keep the tube where the boards were"
            )
    for pair in quality.pairs:
        if pair.shared and min(pair.ray_angle_deg, 180 - pair.ray_angle_deg) < _SMALL_ANGLE_DEG:
            remarks.append(
                f"{' and '.join(pair.cameras)} see the boards {pair.ray_angle_deg:.0f} degrees apart, "
                "which fixes depth poorly; 60 to 120 are better"
            )
    return remarks
