"""Corresponding places of several uncalibrated pictures of one curve, after Berthilsson & Astrom (1997).

Samples ``x_ij = (x, y, 1)`` of the curve in picture i show one point j in space, if there are depths l_ij with which
the matrix of all ``l_ij x_ij`` has rank four. Neither depths nor samples are known. They are found in turn: the row
space V of the best matrix of rank four; the depths of each picture that bring its rows nearest to V, a linear problem;
and samples that slide along their image curves towards what rank four predicts. So far no camera is known. The known
cameras then give the points in space, each as near to the tangents of its image curves as to nothing else, and a spline
smooths them.

Reconstructed here: the depths change little from turn to turn (a proximal step), starting from those of an affine
camera, since the pictures of a planar curve, as most of our tubes are, have rank three and leave them open; both ends
correspond; lenses are undistorted.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import smoothing
from tubesight.methods.agreement import reprojection_rms_px, resampled, way_of
from tubesight.vision.view import View

# Two pictures match in any way that maps ends to ends: the third one decides.
_VIEWS_MIN = 3
# Samples of the curve, places that its image splines are made of, and turns.
_SAMPLES, _PLACES, _TURNS = 41, 161, 80
_RANK = 4
# How much of the step that rank four proposes a sample slides, and the most, as a share of the curve.
_SLIDE, _SLIDE_MAX = 0.7, 0.02
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

    Those on the first curve are equally spaced; the first and last of all are its ends.
    """
    normal = [_normalisation(curve) for curve in curves]
    u = np.tile(np.linspace(0.0, 1.0, _SAMPLES), (len(curves), 1))
    depth = np.ones_like(u)
    for _ in range(_TURNS):
        x = np.stack(
            [
                np.column_stack([(c.at(v) - middle) / size, np.ones(_SAMPLES)])
                for c, v, (middle, size) in zip(curves, u, normal, strict=True)
            ]
        )
        weighted = depth[..., None] * x
        rows = weighted.transpose(0, 2, 1).reshape(-1, _SAMPLES)
        space = np.linalg.svd(rows, full_matrices=False)[2][:_RANK]
        depth = np.stack([_depths(own, before, space) for own, before in zip(x, depth, strict=True)])
        predicted = (rows @ space.T @ space).reshape(len(curves), 3, _SAMPLES)
        for i in range(1, len(curves)):
            off = predicted[i, :2].T / predicted[i, 2][:, None] - x[i, :, :2]
            u[i] = _slid(u[i], off, curves[i].way(u[i]) / normal[i][1])
    return u


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


def _slid(u: Array, off: Array, way: Array) -> Array:
    """Places (N,) slid along their curve towards predicted points; the ends stay, and so does the order."""
    by = (off * way).sum(1) / np.maximum((way * way).sum(1), 1e-12)
    moved = u + _SLIDE * np.clip(by, -_SLIDE_MAX, _SLIDE_MAX)
    moved[[0, -1]] = 0.0, 1.0
    return np.asarray(np.maximum.accumulate(np.clip(moved, 0.0, 1.0)))


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
