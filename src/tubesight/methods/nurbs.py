"""A spline in space pulled onto the edges of posed pictures, after Martinsson, Gaspard, Bartoli & Lavest (2007).

A coarse control polygon is projected into every picture; from samples of the curve the edges are searched along the
normals; Gauss-Newton steps move the control points until the samples lie where the edges say, held by a small tension;
a knot is inserted where the error is largest, as long as Schwarz's criterion (BIC) finds the smaller error worth the
control point.

Reconstructed here: the spline is a cubic B-spline of unit weights, since the known cameras leave nothing for rational
weights to absorb; a tube has two edges, whose bisector is the image of its centreline; the polygon that a user would
click is triangulated from equal shares of two centrelines. Samples move across the curve only, so that its ends stay
where that polygon has them: the method has no tip of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import by_arc_length
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.methods.regions import regions, rough_way
from tubesight.vision.edges import CHROMA, metric
from tubesight.vision.region import RegionView
from tubesight.vision.signal import sample
from tubesight.vision.view import View

_DEGREE = 3
# Control points of the polygon to begin with, and at most.
_COARSE, _FINEST = 4, 14
# Samples of the curve, and of each normal: half a pixel apart while it is near.
_SAMPLES, _SPACING_PX = 61, 0.5
# The search reaches this share of the curve's image while the polygon is coarse, less as it gets finer, and never less
# than so many widths.
_FAR_SHARE, _NEAR_WIDTHS = 0.2, 1.2
# A stretch of normal inside of the tube is the tube's where it is so many widths long.
_WIDE = (0.5, 2.5)
# In samples of half a pixel: how far the strongest edge lies from where the share passes a half, and where the levels
# of background and tube are taken, before and after it.
_NEAR, _BEFORE, _AFTER = 4, (5, 8), (2, 4)
# How much shading of the tube counts beside noise, both squared: with this a tube 7 px wide is measured to 0.06 mm, and
# one in JPEG pictures, whose colours are blurred, to 0.02 mm; without regard to shading to 0.2 and 0.06 mm, and without
# regard to noise to 0.01 and 0.2 mm.
_SHADING = 20.0
# Weight of the control polygon's second differences (px per mm): a thousandth of what an edge weighs.
_TENSION = 0.03
# Weights (px per mm) of a step along the curve and of leaving its ends: a millimetre across it is two pixels and more
# in each view.
_HOLD, _HOLD_ENDS = 0.3, 3.0
# Gauss-Newton steps between insertions of knots, and the movement (mm) that ends them.
_STEPS, _CONVERGED_MM = 8, 0.02
# Residuals above this many deviations count less (Huber); no deviation is below this many pixels.
_HUBER, _SD_MIN_PX = 1.5, 0.02
# Fewest edges found, as a share of the samples in all views, and largest rms.
_SEEN_MIN, _RMS_MAX_PX = 0.5, 2.0
# A curve that leaves the centrelines by more than this share of the tube's width has lost it somewhere.
_OFF_WIDTHS = 0.25


class _Spline(NamedTuple):
    """Cubic B-spline: full knot vector, and control points (P, 3)."""

    knots: Array
    control: Array

    def basis(self, u: Array) -> Array:
        return np.asarray(BSpline.design_matrix(u, self.knots, _DEGREE).toarray())


class _Normals(NamedTuple):
    """What one view's normals found: offsets (N,) in pixels, NaN where no edge was; derivatives (N, 3) by place."""

    offset_px: Array
    by_place: Array


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Fit the spline, inserting knots while they are worth it.

    Raises
    ------
    Unmeasurable
        If there are not two views, or the edges do not lie where a curve would have them.
    """
    seen = regions(views)
    coarse = _coarse(seen, rig)
    ends = coarse.control[[0, -1]]
    best = _converged(coarse, ends, seen, rig)
    while len(best[0].control) < _FINEST:
        finer = _converged(_with_knot(best[0], *_worst_span(best[0], seen, rig)), ends, seen, rig)
        if not finer[1] < best[1]:
            break
        best = finer
    spline = best[0]
    u = _samples()
    offsets = np.concatenate([n.offset_px for n in _look(spline, u, seen, rig)])
    found = np.isfinite(offsets)
    rms = float(np.sqrt(np.mean(offsets[found] ** 2))) if found.any() else float("inf")
    if found.mean() < _SEEN_MIN or not rms <= _RMS_MAX_PX:
        raise Unmeasurable(
            Status.RESIDUAL_TOO_LARGE, detail=f"edges at {found.mean():.0%} of the samples, rms {rms:.1f} px"
        )
    polynomial = BSpline(spline.knots, spline.control, _DEGREE)
    curve = by_arc_length("spline", polynomial, polynomial.derivative())
    off = reprojection_rms_px(curve, seen, rig)
    if not off <= _OFF_WIDTHS * min(float(np.median(view.widths_px)) for view in seen.values()):
        raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"the curve leaves the tube, rms {off:.1f} px")
    return curve


def _samples() -> Array:
    return np.linspace(0.0, 1.0, _SAMPLES)


def _coarse(views: Mapping[str, RegionView], rig: Rig) -> _Spline:
    """Spline whose control polygon is triangulated from equal shares of the two most different centrelines."""
    return _Spline(np.repeat([0.0, 1.0], _DEGREE + 1), rough_way(views, rig, _COARSE))


def _look(spline: _Spline, u: Array, views: Mapping[str, RegionView], rig: Rig) -> list[_Normals]:
    points = spline.basis(u) @ spline.control
    far = _FAR_SHARE * _COARSE / len(spline.control)
    return [_search(points, name, view, rig, far) for name, view in views.items()]


def _search(points: Array, name: str, view: RegionView, rig: Rig, far_share: float) -> _Normals:
    """Search the tube's edges along the image normals of samples (N, 3) of the curve."""
    camera, pose = rig.cameras[name], rig.camera_from_base[name]
    px = camera.project(pose.apply(points))
    way = np.gradient(px, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    normal = np.stack([way[:, 1], -way[:, 0]], -1)
    by_place = np.stack(
        [((camera.project(pose.apply(points + step)) - px) * normal).sum(1) for step in 1e-3 * np.eye(3)], -1
    )
    width = float(np.median(view.widths_px))
    length = float(np.linalg.norm(np.diff(px, axis=0), axis=1).sum())
    reach = max(_NEAR_WIDTHS * width, far_share * length)
    along = np.arange(-reach, reach + _SPACING_PX, _SPACING_PX)
    places = px[:, None] + along[:, None] * normal[:, None]
    share = np.nan_to_num(view.signal(places))
    # The strongest edge is one of light, from the background's colour to the tube's.
    light = np.nan_to_num(sample(view.signal.image, places)) @ _edge_of(view.signal.tube, view.signal.cloth)
    offset = np.array([_edges(*rows, along, width) for rows in zip(share, light, strict=True)])
    edges = camera.unproject(px[:, None] + offset[..., None] * normal[:, None])
    axis = (edges / np.linalg.norm(edges, axis=-1, keepdims=True)).sum(1)
    found = np.isfinite(offset).all(1)
    middle = np.full(len(px), np.nan)
    middle[found] = ((camera.project(axis[found]) - px[found]) * normal[found]).sum(1)
    return _Normals(middle, by_place / 1e-3)


def _edge_of(tube: Array, cloth: Array) -> Array:
    """Weights (C,) of a colour that rise where background (C,) gives way to tube (C,), however well this is lit.

    They are ``(N + s^2 t t^T)^-1 (t - c)`` with the noise N of colours that are recorded less sharply than brightness,
    and shading of the tube's colour t (Sherman and Morrison). Gray pictures are left with the difference of both.
    """
    noise = metric(len(tube), CHROMA[0])
    shading = noise @ tube
    difference = noise @ (tube - cloth)
    return np.asarray(difference - shading * (tube @ difference) * _SHADING / (1 + _SHADING * (tube @ shading)))


def _edges(share: Array, light: Array, along: Array, width_px: float) -> tuple[float, float]:
    """Places of both edges of the tube nearest to the middle of a normal; NaN where there is none."""
    inside = np.concatenate([[False], share > 0.5, [False]])
    first, last = np.flatnonzero(inside[1:] & ~inside[:-1]), np.flatnonzero(inside[:-1] & ~inside[1:]) - 1
    span = (last - first) * _SPACING_PX
    usable = (span > _WIDE[0] * width_px) & (span < _WIDE[1] * width_px) & (first > 0) & (last < len(share) - 1)
    if not usable.any():
        return float("nan"), float("nan")
    nearest = np.flatnonzero(usable)[np.abs(along[first] + along[last])[usable].argmin()]
    rising = _half_level(light, along, int(first[nearest]))
    falling = _half_level(light[::-1], along[::-1], len(light) - 1 - int(last[nearest]))
    return rising, falling


def _half_level(light: Array, along: Array, near: int) -> float:
    """Place where the light passes half way from background (before) to tube (after), at the strongest edge near by.

    Both levels are taken close to the edge: a tube is shaded towards its limb, which the edge's slope is not free of.
    """
    first = max(near - _NEAR, 1)
    k = first + int(np.gradient(light)[first : near + _NEAR + 1].argmax())
    before, after = light[max(k - _BEFORE[1], 0) : max(k - _BEFORE[0], 1)], light[k + _AFTER[0] : k + _AFTER[1]]
    if not len(after):
        return float("nan")
    off = light[max(k - _NEAR, 0) : k + _NEAR + 1] - (before.mean() + after.mean()) / 2
    crossed = np.flatnonzero((off[:-1] < 0) & (off[1:] >= 0))
    if not len(crossed):
        return float("nan")
    c = crossed[np.abs(crossed - min(k, _NEAR)).argmin()]
    return float(along[max(k - _NEAR, 0) + c] + (along[1] - along[0]) * off[c] / (off[c] - off[c + 1]))


def _converged(spline: _Spline, ends_mm: Array, views: Mapping[str, RegionView], rig: Rig) -> tuple[_Spline, float]:
    """Gauss-Newton steps; the spline, and its BIC."""
    u = _samples()
    basis = spline.basis(u)
    control = spline.control
    second = np.diff(np.eye(len(control)), 2, axis=0)
    stiffness = np.kron(_TENSION**2 * second.T @ second, np.eye(3))
    for _ in range(_STEPS):
        normals = _look(_Spline(spline.knots, control), u, views, rig)
        held, pull = _held(basis, control, ends_mm)
        hessian, gradient = stiffness + held, stiffness @ control.ravel() + pull
        for residual, by_place in normals:
            found = np.isfinite(residual)
            design = (basis[found][:, :, None] * by_place[found][:, None, :]).reshape(found.sum(), control.size)
            weight = _weights(residual[found])
            hessian += design.T @ (design * weight[:, None])
            gradient -= design.T @ (weight * residual[found])
        move = -np.linalg.solve(hessian, gradient).reshape(-1, 3)
        control = control + move
        if np.abs(move).max() < _CONVERGED_MM:
            break
    offsets = np.concatenate([n.offset_px for n in _look(_Spline(spline.knots, control), u, views, rig)])
    return _Spline(spline.knots, control), _bic(offsets[np.isfinite(offsets)], control.size)


def _held(basis: Array, control: Array, ends_mm: Array) -> tuple[Array, Array]:
    """Hessian (3 P, 3 P) and gradient (3 P,) of what holds samples along the curve, of which the edges say nothing.

    Samples are held against each step, both ends against leaving the plane across the curve that they began in.
    """
    points = basis @ control
    tangent = np.gradient(points, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    design = (basis[:, :, None] * tangent[:, None, :]).reshape(len(basis), -1)
    ends = design[[0, -1]]
    off = ((points[[0, -1]] - ends_mm) * tangent[[0, -1]]).sum(1)
    return (
        np.asarray(_HOLD**2 * design.T @ design + _HOLD_ENDS**2 * ends.T @ ends),
        np.asarray(_HOLD_ENDS**2 * ends.T @ off),
    )


def _weights(residual: Array) -> Array:
    scale = max(1.4826 * float(np.median(np.abs(residual))), _SD_MIN_PX) if len(residual) else _SD_MIN_PX
    return np.asarray(np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residual), 1e-12)))


def _bic(residual: Array, count: int) -> float:
    """Schwarz's criterion ``n log(sum r^2 / n) + P log n`` with P parameters."""
    n = len(residual)
    if n <= count:
        return float("inf")
    return float(n * np.log(max(float(np.mean(residual**2)), _SD_MIN_PX**2)) + count * np.log(n))


def _worst_span(spline: _Spline, views: Mapping[str, RegionView], rig: Rig) -> tuple[float, float]:
    """Find the ends of the knot span with the largest sum of squared offsets."""
    u = _samples()
    square = np.nansum([n.offset_px**2 for n in _look(spline, u, views, rig)], axis=0)
    breaks = np.unique(spline.knots)
    span = np.clip(np.searchsorted(breaks, u, side="right") - 1, 0, len(breaks) - 2)
    worst = int(np.bincount(span, square, minlength=len(breaks) - 1).argmax())
    return float(breaks[worst]), float(breaks[worst + 1])


def _with_knot(spline: _Spline, low: float, high: float) -> _Spline:
    """Give the same curve a knot more, in the middle of a span: the finer space holds the coarser one."""
    knots = np.sort(np.append(spline.knots, (low + high) / 2))
    u = np.linspace(0.0, 1.0, 4 * len(knots))
    finer = BSpline.design_matrix(u, knots, _DEGREE).toarray()
    return _Spline(knots, np.asarray(np.linalg.lstsq(finer, spline.basis(u) @ spline.control, rcond=None)[0], float))
