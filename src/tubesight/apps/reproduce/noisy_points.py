"""Centreline points with noise in both images, as in the paper's sensitivity analysis, and their reconstruction."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from tubesight.apps.reproduce.batch import (
    Shapes,
    circles,
    clamped_arcs,
    curvatures,
    ellipses,
    elliptic_arcs,
    nearest_depths,
    parabolas,
)
from tubesight.core import Array
from tubesight.geometry.rig import Rig
from tubesight.simulate.phantom import Arc

# Trials done at once: their arrays stay in the cache of a core.
_CHUNK = 250
# Steps of the fit to points, and the nodes on which the nearest point is looked for, as shares of the length: points
# are scattered past both ends.
_FIT_STEPS = 4
_FIT_NODES = np.linspace(-0.15, 1.15, 40)
# Step of the differences of a curve by its curvature (1/mm).
_BEND_STEP = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Noisy points of B tubes in both images.

    Attributes
    ----------
    rays
        Two of (B, N, 3) rays ``v = (x, y, 1)``, from origin to tip.
    ends_known
        Whether origin and tip are exact, and known to be.
    """

    rays: tuple[Array, Array]
    ends_known: bool


def draw_points(
    rig: Rig,
    phantoms: list[Arc],
    count: int,
    noise_mm: Array,
    ends_known: bool,
    rng: np.random.Generator,
    shift_mm: Array | None = None,
) -> Points:
    """Draw points spread evenly along tubes, in both cameras of a rig.

    Parameters
    ----------
    noise_mm
        (B,) deviation along both axes of each image, at the depth of the point.
    ends_known
        Leave origin and tip exact.
    shift_mm
        (N,) systematic error across the curve, in the first camera alone.
    """
    points = np.stack([p.at(np.linspace(0.0, p.length_mm, count)) for p in phantoms])
    rays = []
    for k, name in enumerate(rig.names):
        local = rig.camera_from_base[name].apply(points)
        noise = rng.normal(size=(*local.shape[:2], 2)) * np.asarray(noise_mm)[:, None, None]
        if ends_known:
            noise[:, [0, -1]] = 0.0
        xy = local[..., :2] / local[..., 2:]
        if shift_mm is not None and k == 0:
            along = np.gradient(xy, axis=1)
            along /= np.linalg.norm(along, axis=-1, keepdims=True)
            noise = noise + shift_mm[:, None] * np.stack([along[..., 1], -along[..., 0]], -1)
        xy = xy + noise / local[..., 2:]
        rays.append(np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1))
    return Points((rays[0], rays[1]), ends_known)


def cone_points(points: Points, rig: Rig, fit: Callable[[Array], Array], missed: bool = False) -> Array:
    """Points (B, N, 3) in the base frame by the paper's equations 2 to 11, with a choice of the image fit.

    The view of the higher curvature makes the cone; a ray that misses it is NaN, or where it comes closest (`missed`).
    """
    bends = [curvatures(rays[..., :2]) for rays in points.rays]
    made = np.full(points.rays[0].shape, np.nan)
    for cone, ray in ((0, 1), (1, 0)):
        these = bends[cone] > bends[ray] if cone == 0 else bends[cone] >= bends[ray]
        if not these.any():
            continue
        names = rig.names[cone], rig.names[ray]
        rays = points.rays[ray][these]
        base_depth = float(rig.camera_from_base[names[1]].translation_mm[2])
        depth = nearest_depths(
            fit(points.rays[cone][these][..., :2]), rig.relative_pose(*names), rays, base_depth, missed
        )
        made[these] = rig.camera_from_base[names[1]].inverse().apply(rays * depth[..., None])
    return made


def triangulated_tips(points: Points, rig: Rig) -> Array:
    """Tips (B, 3) from the last points of both images."""
    return rig.triangulate(dict(zip(rig.names, (rays[:, -1] for rays in points.rays), strict=True)))


def reference(points: Points, rig: Rig) -> Shapes:
    """Literally the paper: Halir and Flusser's ellipse in the image, equation 10, free circle."""
    return circles(cone_points(points, rig, ellipses))


def reference_ellipse(points: Points, rig: Rig) -> Shapes:
    """Literally the paper, with the free ellipse."""
    return elliptic_arcs(cone_points(points, rig, ellipses))


def reference_tangent(points: Points, rig: Rig) -> Shapes:
    """Do as `reference`, but let rays that miss the cone touch it."""
    return circles(cone_points(points, rig, ellipses, missed=True))


def reference_ellipse_tangent(points: Points, rig: Rig) -> Shapes:
    """Do as `reference_ellipse`, but let rays that miss the cone touch it."""
    return elliptic_arcs(cone_points(points, rig, ellipses, missed=True))


def low_order(points: Points, rig: Rig) -> Shapes:
    """Fit a parabola in the image; the arc runs from the clamp to where the tip's ray meets the cone over it."""
    return clamped_arcs(cone_points(points, rig, parabolas)[:, -1])


def cone_ray(points: Points, rig: Rig) -> Shapes:
    """Lay the closed form's circle: the arc from the clamp to the triangulated tip; other points do not enter."""
    return clamped_arcs(triangulated_tips(points, rig))


def least_squares(points: Points, rig: Rig) -> Shapes:
    """Clamped arc of least squared distance from all points in both images, Gauss-Newton, `_FIT_STEPS` steps.

    A point counts with its distance across the projected curve, the tip with both components. Ends that are known to be
    exact outweigh all others.
    """
    start = triangulated_tips(points, rig)
    arc = clamped_arcs(start)
    azimuth = arc.orientation_rad
    bend = (arc.bending_rad / arc.length_mm)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    length = arc.length_mm.copy()
    # The weight of exact ends against noisy points: their share of the error then is a millionth.
    tip_weight = 1e6 if points.ends_known else 1.0
    for _ in range(_FIT_STEPS):
        hessian, gradient = np.zeros((len(bend), 3, 3)), np.zeros((len(bend), 3))
        for name, rays in zip(rig.names, points.rays, strict=True):
            for jacobian, residual, weight in _rows(rig, name, rays, bend, length, tip_weight):
                hessian += weight * np.swapaxes(jacobian, 1, 2) @ jacobian
                gradient += weight * (np.swapaxes(jacobian, 1, 2) @ residual[..., None])[..., 0]
        step = np.linalg.solve(hessian, gradient[..., None])[..., 0]
        bend, length = bend - step[:, :2], length - step[:, 2]
    tip = _arc(bend, length[:, None])[:, 0]
    return Shapes(tip, np.hypot(*bend.T) * length, np.arctan2(tip[:, 1], tip[:, 0]), length)


def _rows(
    rig: Rig, name: str, rays: Array, bend: Array, length: Array, tip_weight: float
) -> list[tuple[Array, Array, float]]:
    """Jacobians by (curvature x, y, length), residuals (mm) and weights of the points of one image, and of its tip."""
    nodes = _seen(rig, name, bend, length[:, None] * _FIT_NODES)
    off = rays[:, 1:-1, None, :2] - nodes[:, None]
    nearest = (off * off).sum(-1).argmin(-1)
    s = length[:, None] * _FIT_NODES[nearest]
    at, way = _with_way(rig, name, bend, s)
    s = s + ((rays[:, 1:-1, :2] - at) * way).sum(-1) / (way * way).sum(-1)
    at, way = _with_way(rig, name, bend, s)
    normal = np.stack([way[..., 1], -way[..., 0]], -1) / np.linalg.norm(way, axis=-1, keepdims=True)
    scale = float(np.linalg.norm(rig.camera_from_base[name].translation_mm))
    by_bend = _by_bend(rig, name, bend, s)
    across = np.einsum("bnkp,bnk->bnp", by_bend, normal) * scale
    jacobian = np.concatenate([across, np.zeros((*across.shape[:2], 1))], -1)
    residual = ((at - rays[:, 1:-1, :2]) * normal).sum(-1) * scale
    end = length[:, None]
    there = _seen(rig, name, bend, end)
    by_length = _seen(rig, name, bend, end + 0.5) - _seen(rig, name, bend, end - 0.5)
    tip = np.concatenate([_by_bend(rig, name, bend, end)[:, 0], by_length[:, 0, :, None]], -1) * scale
    return [(jacobian, residual, 1.0), (tip, (there[:, 0] - rays[:, -1, :2]) * scale, tip_weight)]


def _arc(bend: Array, s_mm: Array) -> Array:
    """Points (B, n, 3) of arcs with curvature vectors (B, 2) at arc lengths (B, n)."""
    angle = s_mm * np.hypot(bend[:, :1], bend[:, 1:])
    side = s_mm * s_mm / 2 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.stack([bend[:, :1] * side, bend[:, 1:] * side, s_mm * np.sinc(angle / np.pi)], -1)


def _seen(rig: Rig, name: str, bend: Array, s_mm: Array) -> Array:
    """Images (B, n, 2) of arcs on the ideal image plane."""
    local = rig.camera_from_base[name].apply(_arc(bend, s_mm))
    return np.asarray(local[..., :2] / local[..., 2:])


def _with_way(rig: Rig, name: str, bend: Array, s_mm: Array) -> tuple[Array, Array]:
    """Images (B, n, 2) of arcs and their derivatives by arc length."""
    return _seen(rig, name, bend, s_mm), _seen(rig, name, bend, s_mm + 0.5) - _seen(rig, name, bend, s_mm - 0.5)


def _by_bend(rig: Rig, name: str, bend: Array, s_mm: Array) -> Array:
    """Differentiate the images by the curvature vector: (B, n, 2, 2)."""
    columns = [
        (_seen(rig, name, bend + step, s_mm) - _seen(rig, name, bend - step, s_mm)) / (2 * _BEND_STEP)
        for step in np.eye(2) * _BEND_STEP
    ]
    return np.stack(columns, -1)


def bound(rig: Rig, phantom: Arc, count: int) -> Shapes:
    """Cramer-Rao bound: least deviations of an unbiased estimate for noise of 1 mm on all points, ends included.

    Assumes what the best estimate can know: the clamp, a circle, independent Gaussian noise. Where along the tube a
    point was before the noise moved it is not known, so that it tells its distance across the curve alone; the tip
    tells both components.
    """
    bend = np.array([[np.cos(phantom.phi_rad), np.sin(phantom.phi_rad)]]) * phantom.theta_rad / phantom.length_mm
    length = np.array([phantom.length_mm])
    information = np.zeros((3, 3))
    points = phantom.at(np.linspace(0.0, phantom.length_mm, count))[None]
    for name in rig.names:
        local = rig.camera_from_base[name].apply(points)
        rays = local / local[..., 2:]
        reference = float(np.linalg.norm(rig.camera_from_base[name].translation_mm))
        for jacobian, _, _ in _rows(rig, name, rays, bend, length, 1.0):
            # Noise is in millimetres at the point's own depth.
            depth = local[0, 1:-1, 2] if len(jacobian[0]) > 2 else np.repeat(local[0, -1, 2], 2)
            scaled = jacobian[0] * (depth / reference)[:, None]
            information += scaled.T @ scaled
    covariance = np.linalg.inv(information)
    theta, phi = phantom.theta_rad, phantom.phi_rad
    way = np.array([np.cos(phi), np.sin(phi)])
    tip = np.concatenate(
        [
            _differences(bend, length),
            (_arc(bend, length[:, None] + 0.5) - _arc(bend, length[:, None] - 0.5))[0, 0, :, None],
        ],
        1,
    )
    by_theta = np.append(way * phantom.length_mm, theta / phantom.length_mm)
    by_phi = np.append(np.array([-way[1], way[0]]) / np.linalg.norm(bend), 0.0)
    rows = np.vstack([tip, by_theta, by_phi, [0.0, 0.0, 1.0]])
    sd = np.sqrt(np.diag(rows @ covariance @ rows.T))
    return Shapes(sd[None, :3], sd[3:4], sd[4:5], sd[5:])


def _differences(bend: Array, length: Array) -> Array:
    """Differentiate the tip by the curvature vector: (3, 2)."""
    ends = [(_arc(bend + d, length[:, None]) - _arc(bend - d, length[:, None]))[0, 0] for d in np.eye(2) * _BEND_STEP]
    return np.stack(ends, 1) / (2 * _BEND_STEP)


Estimator = Callable[[Points, Rig], Shapes]

ESTIMATORS: Mapping[str, Estimator] = MappingProxyType(
    {
        "reference": reference,
        "reference_ellipse": reference_ellipse,
        "reference_tangent": reference_tangent,
        "reference_ellipse_tangent": reference_ellipse_tangent,
        "low_order": low_order,
        "cone_ray": cone_ray,
        "silhouette": least_squares,
    }
)


def estimate(name: str, points: Points, rig: Rig) -> Shapes:
    """Reconstruct all trials, `_CHUNK` at a time."""
    parts = []
    for start in range(0, len(points.rays[0]), _CHUNK):
        at = slice(start, start + _CHUNK)
        part = Points((points.rays[0][at], points.rays[1][at]), points.ends_known)
        parts.append(ESTIMATORS[name](part, rig))
    return Shapes(
        np.concatenate([p.tip_mm for p in parts]),
        np.concatenate([p.bending_rad for p in parts]),
        np.concatenate([p.orientation_rad for p in parts]),
        np.concatenate([p.length_mm for p in parts]),
    )
