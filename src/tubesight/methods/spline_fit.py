"""One cubic B-spline in space, fitted to the centrelines of all views.

Nothing is known of the shape but that it is smooth: control points are moved until the projected spline lies on the
centrelines (Gauss-Newton on distances across the projected curve) and ends in the tips. What the views leave open,
where the tube runs along an epipolar plane, a small penalty on third differences of the control points decides
(P-splines: Eilers & Marx 1996).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D, NodeCurve
from tubesight.geometry.matching import monotone_way
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import by_arc_length
from tubesight.methods.agreement import base_of, reprojection_rms_px
from tubesight.methods.centreline import way_of
from tubesight.vision.view import View

# Pieces of the spline that are tried; the fewest whose rms is within the factor of the best are taken, as residuals on
# photographs are systematic. Below the floor numbers of pieces are not compared: centrelines are not known better.
_PIECES = (2, 3, 5, 8, 12, 18)
_FEWEST_WITHIN, _RMS_FLOOR_PX = 1.35, 0.1
# No spline with a larger rms is an answer: right ones leave 0.05 to 0.3 px on photographs.
_RMS_MAX_PX = 1.0
# Deviations of a place of a centreline across it, and of a tip in a picture.
_ACROSS_PX, _TIP_PX = 0.1, 0.1
# What a clamp is trusted to, and how well the start of a free tube is seen along it.
_CLAMP_MM, _CLAMP_RAD, _FREE_MM = 0.05, np.radians(0.05), 2.0
# Third differences of control points 10 mm apart on a curve of 25 mm radius whose curvature comes and goes within 50 mm
# are near 5 mm: a tenth of the information of one place on them bends no spline that two views see.
_ROUGH_MM = 5.0
# Samples of the projected curve by which places are matched to it, and steps of the fit.
_SAMPLES, _STEPS = 161, 8
# Places farther off than this draw no more than at this distance (Huber 1964): something crosses the tube there.
_HUBER_PX = 1.0
_DEGREE = 3

Starter = Callable[[Mapping[str, View], Rig, Tube], Curve3D]


@dataclass(frozen=True, slots=True)
class SplineFit:
    """Spline fit as a method.

    Attributes
    ----------
    starter
        Method that gives the first curve.
    """

    starter: Starter

    def __call__(self, views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
        """Fit splines of growing freedom and return the one of fewest pieces that explains the centrelines.

        Raises
        ------
        Unmeasurable
            If the starter finds no curve, or no spline agrees with all views.
        """
        curve = self.starter(views, rig, tube)
        fits: list[tuple[float, NodeCurve]] = []
        for pieces in _PIECES:
            control = _start(curve, pieces)
            for _ in range(_STEPS):
                control = _stepped(control, curve, views, rig, tube)
            fitted = _curve(control)
            fits.append((reprojection_rms_px(fitted, views, rig), fitted))
            if fits[-1][0] <= _RMS_FLOOR_PX:
                break
        best = min(rms for rms, _ in fits)
        if not best <= _RMS_MAX_PX:
            raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"rms {best:.1f} px")
        limit = max(_FEWEST_WITHIN * best, _RMS_FLOOR_PX)
        return next(fitted for rms, fitted in fits if rms <= limit)


def _knots(pieces: int) -> Array:
    return np.concatenate([np.zeros(_DEGREE), np.linspace(0.0, 1.0, pieces + 1), np.ones(_DEGREE)])


def _start(curve: Curve3D, pieces: int) -> Array:
    """Control points (pieces + 3, 3) of the spline nearest to a curve."""
    u = np.linspace(0.0, 1.0, _SAMPLES)
    return np.asarray(make_lsq_spline(u, curve.at(u * curve.length_mm), _knots(pieces), _DEGREE).c)


def _curve(control: Array) -> NodeCurve:
    spline = BSpline(_knots(len(control) - _DEGREE), control, _DEGREE)
    return by_arc_length("spline", spline, spline.derivative())


def _stepped(control: Array, start: Curve3D, views: Mapping[str, View], rig: Rig, tube: Tube) -> Array:
    """One Gauss-Newton step of the control points."""
    rows = [_view_rows(control, view, rig) for view in views.values()]
    rows += [_base_rows(control, start, views, rig, tube), _rough_rows(control)]
    residual = np.concatenate([r for r, _ in rows])
    jacobian = np.concatenate([j for _, j in rows])
    step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
    return np.asarray(control + step.reshape(control.shape))


def _view_rows(control: Array, view: View, rig: Rig) -> tuple[Array, Array]:
    """Weighted residuals of a view and their derivatives: places across the projected curve, and the tip."""
    knots = _knots(len(control) - _DEGREE)
    spline = BSpline(knots, control, _DEGREE)
    focal = rig.cameras[view.camera].focal_px
    seen = focal * way_of(view)[1:, :2]
    u = _places(spline, seen, view.camera, rig)
    pose = rig.camera_from_base[view.camera]
    local = pose.apply(spline(u))
    px = focal * local[:, :2] / local[:, 2:]
    # Derivatives (n, 2, 3) of the ideal pixel by the point in space.
    by_point = (
        focal
        / local[:, 2, None, None]
        * (pose.rotation[None, :2] - (local[:, :2] / local[:, 2:])[..., None] * pose.rotation[None, 2:])
    )
    tangent = np.einsum("nij,nj->ni", by_point, spline(u, 1))
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1) / np.maximum(np.linalg.norm(tangent, axis=1), 1e-12)[:, None]
    basis = BSpline.design_matrix(u, knots, _DEGREE).toarray()
    off = ((px - seen)[:-1] * normal[:-1]).sum(1)
    weight = np.sqrt(np.minimum(1.0, _HUBER_PX / np.maximum(np.abs(off), 1e-12))) / _ACROSS_PX
    across = np.einsum("n,ni,nij,nk->nkj", weight, normal[:-1], by_point[:-1], basis[:-1])
    at_tip = np.einsum("ij,k->ikj", by_point[-1], basis[-1]) / _TIP_PX
    return (
        np.concatenate([weight * off, (px - seen)[-1] / _TIP_PX]),
        np.concatenate([across, at_tip]).reshape(len(seen) + 1, -1),
    )


def _places(spline: BSpline, seen: Array, camera: str, rig: Rig) -> Array:
    """Parameters (N,) of the projected curve nearest to places (N, 2) of a centreline, in its order; the last is 1."""
    u = np.linspace(0.0, 1.0, _SAMPLES)
    local = rig.camera_from_base[camera].apply(spline(u))
    px = rig.cameras[camera].focal_px * local[:, :2] / local[:, 2:]
    squared = ((seen[:, None] - px[None]) ** 2).sum(-1)
    nearest = np.zeros(len(seen), np.intp)
    for i, j in monotone_way(squared, 0.0):
        if nearest[i] == 0 or squared[i, j] < squared[i, nearest[i]]:
            nearest[i] = j
    # Between samples: the foot on the chord of the neighbours.
    low, high = np.maximum(nearest - 1, 0), np.minimum(nearest + 1, _SAMPLES - 1)
    chord = px[high] - px[low]
    share = ((seen - px[low]) * chord).sum(1) / np.maximum((chord**2).sum(1), 1e-12)
    places = u[low] + np.clip(share, 0.0, 1.0) * (u[high] - u[low])
    places[-1] = 1.0
    return np.asarray(places)


def _base_rows(control: Array, start: Curve3D, views: Mapping[str, View], rig: Rig, tube: Tube) -> tuple[Array, Array]:
    """Residuals at the base: place and way of the clamp, or where a free tube's start is seen."""
    size = control.size
    place = np.eye(3, size)
    if not tube.clamped:
        seen = base_of(views, rig)
        base = start.at([0.0])[0] if seen is None else seen
        return (control[0] - base) / _FREE_MM, place / _FREE_MM
    length = float(np.linalg.norm(control[1] - control[0]))
    way = (np.eye(2, size, 3) - np.eye(2, size)) / (_CLAMP_RAD * length)
    residual = np.concatenate([control[0] / _CLAMP_MM, (control[1] - control[0])[:2] / (_CLAMP_RAD * length)])
    return residual, np.concatenate([place / _CLAMP_MM, way])


def _rough_rows(control: Array) -> tuple[Array, Array]:
    """Third differences of the control points over what is expected of them."""
    n = len(control)
    design = np.kron(np.diff(np.eye(n), 3, axis=0), np.eye(3)) / _ROUGH_MM
    return np.asarray(design @ control.ravel()), np.asarray(design)
