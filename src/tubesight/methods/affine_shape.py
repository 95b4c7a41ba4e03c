"""Corresponding places of several uncalibrated pictures of one curve, after Berthilsson & Astrom (1997).

Samples ``x_ij = (x, y, 1)`` of the curve in picture i show one point j in space, if there are depths l_ij with which
the matrix of all ``l_ij x_ij`` has rank four. Neither depths nor samples are known. They are found in turn: the row
space V of the best matrix of rank four; samples that slide along their image curves until they leave it least; the
depths of each picture that bring its rows nearest to V, a linear problem. So far no camera is known. The known
cameras then give the points in space, each as near to the tangents of its image curves as to nothing else, and a spline
smooths them.

Reconstructed here: samples slide by a few sines, all at once (Gauss-Newton with the row space eliminated), since one by
one they hardly move; a planar curve, as most of our tubes are, has rank three and is tried with that; the depths
change little from turn to turn, starting from those of an affine camera; both ends correspond; lenses are undistorted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import smoothing
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.methods.centreline import resampled, way_of
from tubesight.vision.view import View

# Two pictures match in any way that maps ends to ends: the third one decides.
_VIEWS_MIN = 3
# Samples of the curve, places that its image splines are made of, and turns.
_SAMPLES, _PLACES, _TURNS = 41, 161, 3
# Samples slide by so many sines along each curve, at most so many steps a turn, and no farther than rank four asks for:
# a slide by a tenth of the curve costs as much as a sample off by a thousandth of its size.
_MODES, _NFEV, _STILL = 5, 12, 0.01
# A curve is planar where rank three leaves this part of its size, which is what centrelines are known to, or no more
# than so many times what rank four leaves.
_FLAT, _FLATTER = 0.002, 2.0
# How far a sample slides in one step towards its point in space, as a share of the curve.
_SLIDE_MAX = 0.02
# Depths are held to the last ones by this, relative to the scatter of the samples.
_PROXIMAL = 0.05
# Deviations of a point in a picture across its curve, and along it, where it is only as good as the correspondence.
_ACROSS_PX, _ALONG_PX = 0.15, 5.0
# Gauss-Newton steps of the points in space.
_STEPS = 6
# Largest rms: curves that belong together leave 0.1 to 0.5 px.
_RMS_MAX_PX = 3.0


class _ImageCurve(NamedTuple):
    """Centreline on the ideal image plane as a spline over its share of length, 0 to 1."""

    spline: CubicSpline

    def at(self, u: Array) -> Array:
        return np.asarray(self.spline(u)[:, :2])

    def way(self, u: Array) -> Array:
        return np.asarray(self.spline(u, 1)[:, :2])


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Find corresponding samples without the cameras and their points in space with them.

    Raises
    ------
    Unmeasurable
        If there are fewer than three views, or they are not of one curve.
    """
    if len(views) < _VIEWS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail="three views are needed")
    share = np.linspace(0.0, 1.0, _PLACES)
    curves = {name: _ImageCurve(CubicSpline(share, resampled(way_of(view), share))) for name, view in views.items()}
    places = dict(zip(curves, correspond(list(curves.values())), strict=True))
    points = _in_space(curves, places, rig)
    if not np.isfinite(points).all():
        raise Unmeasurable(Status.VIEWS_DISAGREE, detail="corresponding places do not meet in front of the cameras")
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    depth = np.mean([rig.camera_from_base[n].apply(points)[:, 2].mean() / rig.cameras[n].focal_px for n in views])
    place = np.concatenate([[0.0], np.cumsum(step)])
    curve = smoothing(points, place, np.full(len(points), _ACROSS_PX * float(depth)))
    rms = reprojection_rms_px(curve, views, rig)
    if not rms <= _RMS_MAX_PX:
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {rms:.1f} px")
    return curve


def correspond(curves: list[_ImageCurve]) -> Array:
    """Places (I, N) of the same N points on I image curves, from the curves alone.

    Those on the first curve are equally spaced; the first and last of all are its ends. A planar curve has rank three,
    and only then that rank is enough.
    """
    (flat_misfit, flat), (misfit, places) = (_of_rank(curves, rank) for rank in (3, 4))
    return flat if flat_misfit < max(_FLAT, _FLATTER * misfit) else places


def _of_rank(curves: list[_ImageCurve], rank: int) -> tuple[float, Array]:
    """Slide the samples, then update the depths, in turn; the misfit that is left, and the places (I, N)."""
    t = np.linspace(0.0, 1.0, _SAMPLES)
    modes = np.sin(np.pi * np.outer(np.arange(1, _MODES + 1), t))
    normal = [_normalisation(curve) for curve in curves]
    depth = np.ones((len(curves), _SAMPLES))
    slides = np.zeros((len(curves) - 1) * _MODES)

    def places(slides: Array) -> Array:
        moved = t + slides.reshape(-1, _MODES) @ modes
        return np.asarray(np.clip(np.vstack([t, np.maximum.accumulate(moved, axis=1)]), 0.0, 1.0))

    def samples(slides: Array) -> Array:
        points = [(c.at(u) - m) / size for c, u, (m, size) in zip(curves, places(slides), normal, strict=True)]
        return np.concatenate([points, np.ones((len(curves), _SAMPLES, 1))], -1)

    def outside(slides: Array, depth: Array) -> Array:
        rows, space = _row_space(samples(slides), depth, rank)
        return np.concatenate([(rows - rows @ space.T @ space).ravel(), _STILL * slides])

    for _ in range(_TURNS):
        slides = least_squares(outside, slides, args=(depth,), max_nfev=_NFEV).x
        x = samples(slides)
        _, space = _row_space(x, depth, rank)
        depth = np.stack([_depths(own, before, space) for own, before in zip(x, depth, strict=True)])
    left = outside(slides, depth)[: -len(slides)]
    return float(np.sqrt(np.mean(left**2))), places(slides)


def _row_space(x: Array, depth: Array, rank: int) -> tuple[Array, Array]:
    """Matrix (3 I, N) of the depth-weighted samples (I, N, 3), and the row space (rank, N) that fits it best."""
    rows = (depth[..., None] * x).transpose(0, 2, 1).reshape(-1, x.shape[1])
    return rows, np.linalg.svd(rows, full_matrices=False)[2][:rank]


def _normalisation(curve: _ImageCurve) -> tuple[Array, float]:
    points = curve.at(np.linspace(0.0, 1.0, _SAMPLES))
    return points.mean(0), float(np.sqrt(((points - points.mean(0)) ** 2).mean()))


def _depths(x: Array, before: Array, space: Array) -> Array:
    """Depths (N,) of one picture that bring ``l_j x_j`` (N, 3) nearest to a row space (4, N), near the last ones.

    ``sum_k |(1 - V^T V) diag(x_k) l|^2 + m |l - before|^2`` is least where ``(Q + m) l = m before``.
    """
    outside = np.eye(len(x)) - space.T @ space
    q = np.einsum("ik,ij,jk->ij", x, outside, x)
    weight = _PROXIMAL * np.trace(q) / len(x)
    depth = np.linalg.solve(q + weight * np.eye(len(x)), weight * before)
    return np.asarray(depth / depth.mean())


def _in_space(curves: Mapping[str, _ImageCurve], places: Mapping[str, Array], rig: Rig) -> Array:
    """Points (N, 3) whose images lie on the tangents of their places, and near the places themselves."""
    rays = {name: np.column_stack([c.at(places[name]), np.ones(_SAMPLES)]) for name, c in curves.items()}
    points: Array = rig.triangulate(rays)
    u = dict(places)
    for _ in range(_STEPS):
        hessian, gradient = np.zeros((_SAMPLES, 3, 3)), np.zeros((_SAMPLES, 3))
        for name, curve in curves.items():
            pose, focal = rig.camera_from_base[name], rig.cameras[name].focal_px
            local = pose.apply(points)
            plane = local[:, :2] / local[:, 2:]
            by_point = focal * (pose.rotation[:2] - plane[..., None] * pose.rotation[2]) / local[:, 2, None, None]
            way = curve.way(u[name])
            way /= np.linalg.norm(way, axis=1, keepdims=True)
            across = np.stack([-way[:, 1], way[:, 0]], -1)
            off = focal * (plane - curve.at(u[name]))
            for direction, sd in ((across, _ACROSS_PX), (way, _ALONG_PX)):
                design = np.einsum("ni,nij->nj", direction, by_point) / sd
                hessian += design[:, :, None] * design[:, None, :]
                gradient += design * ((off * direction).sum(1) / sd)[:, None]
            speed = np.linalg.norm(curve.way(u[name]), axis=1) * focal
            slid = u[name] + np.clip((off * way).sum(1) / speed, -_SLIDE_MAX, _SLIDE_MAX)
            u[name] = np.clip(np.where(np.arange(_SAMPLES) % (_SAMPLES - 1) == 0, u[name], slid), 0.0, 1.0)
        points = points - np.linalg.solve(hessian, gradient[..., None])[..., 0]
    return points
