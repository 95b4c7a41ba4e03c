"""The axis of a straight rod in space, from its edges in all pictures.

A ray through an edge touches the rod: its distance from the axis is the rod's radius. The axis (four numbers) and the
radius minimise the deviations from that, in pixels, over the edges of all pictures; no edge is paired with another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tubesight.calibration.errors import CalibrationError
from tubesight.core import Array
from tubesight.geometry.rig import Rig
from tubesight.vision.rod import RodView

# A row of edges may lie this far off as a whole, and tilt by as much from end to end (limb shading, blur): 0.04 px are
# what calibrated renders and photographs show.
_ROW_PX = 0.04
# Edges farther off than this many robust deviations carry no weight (Tukey's biweight).
_TUKEY, _SCALE_FLOOR_PX = 4.7, 0.03
_ITERATIONS = 15
# Passes of the reweighting once the axis is known.
_REWEIGHTED = 4
# Planes through two cameras that are nearer to each other than this (rad) do not fix a line in space.
_PLANES_APART = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """Axis of a rod in the base frame of the rig.

    Attributes
    ----------
    point_mm, direction
        (3,) the point of the axis nearest to the middle of what was seen, and its unit direction.
    radius_mm
        Of the rod.
    rms_px
        Root mean square of the edges about the model.
    bend_rad, sagitta_mm
        How far each instant's rod turns from its one end to the other, and lies off a straight line; (number of
        instants,).
    covariance
        (4, 4) of a shift of the point along `side[0]` and `side[1]` (mm) and of the direction (rad) along them, from
        the pictures.
    side
        (2, 3) unit vectors across the axis.
    """

    point_mm: Array
    direction: Array
    radius_mm: float
    rms_px: float
    bend_rad: Array
    sagitta_mm: Array
    covariance: Array
    side: Array

    def place(self, points_mm: Array) -> Array:
        """Distance (...) along the axis from its point of the feet of points (..., 3)."""
        return np.asarray((points_mm - self.point_mm) @ self.direction)


@dataclass(frozen=True, slots=True, eq=False)
class _Rays:
    """Edge rays of all pictures: origins, unit directions (N, 3); focal length, row, instant, place in the row (N,)."""

    origin: Array
    direction: Array
    focal_px: Array
    row: Array
    instant: Array
    share: Array
    row_sd_px: Array


def fit_axis(views: Sequence[Sequence[RodView]], rig: Rig) -> Axis:
    """Fit the axis of a rod to what all pictures show of it.

    Parameters
    ----------
    views
        By instant: the rod as two or more cameras saw it.

    Raises
    ------
    CalibrationError
        If the cameras do not fix a line: all of them lie in one plane with the rod.
    """
    rays = _collect(views, rig)
    point, direction = _first_line(views, rig)
    radius = float(np.median(_distance(rays, point, direction)[0]))
    weight = np.ones(len(rays.row))
    for _ in range(_ITERATIONS):
        residual, jacobian = _linearise(rays, point, direction, radius)
        step = _solve(rays, residual, jacobian, weight)[0]
        side = _sides(direction)
        point = point + step[:2] @ side
        direction = direction + step[2:4] @ side
        direction /= np.linalg.norm(direction)
        radius += step[4]
        weight = _weights(rays.row, residual)
        if np.abs(step[:5]).max() < 1e-9:
            break
    residual, jacobian = _linearise(rays, point, direction, radius)
    _, covariance = _solve(rays, residual, jacobian, weight)
    rms = float(np.sqrt((weight * residual**2).sum() / weight.sum()))
    bend, sagitta = _bends(rays, point, direction, radius)
    return Axis(point, direction, radius, rms, bend, sagitta, covariance[:4, :4], _sides(direction))


def _collect(views: Sequence[Sequence[RodView]], rig: Rig) -> _Rays:
    parts: list[tuple[Array, ...]] = []
    row_sd: list[float] = []
    for number, own in enumerate(views):
        for view in own:
            n = len(view.edges_px)
            for k in (0, 1):
                parts.append(
                    (
                        np.broadcast_to(rig.centre_mm(view.camera), (n, 3)),
                        rig.directions(view.camera, view.edge_rays[:, k]),
                        np.full(n, rig.cameras[view.camera].focal_px),
                        np.full(n, float(len(row_sd))),
                        np.full(n, float(number)),
                        np.linspace(-1, 1, n),
                    )
                )
                row_sd.append(float(np.hypot(_ROW_PX, view.row_sd_px[k])))
    origin, direction, focal, row, instant, share = (np.concatenate(p) for p in zip(*parts, strict=True))
    return _Rays(origin, direction, focal, row, instant, share, np.array(row_sd))


def _first_line(views: Sequence[Sequence[RodView]], rig: Rig) -> tuple[Array, Array]:
    """Line nearest to the planes through each camera and the middle of the rod in its picture."""
    normals, levels = [], []
    for view in (v for own in views for v in own):
        rays = rig.directions(view.camera, view.edge_rays.sum(1))
        normal = np.linalg.svd(rays, full_matrices=False)[2][-1]
        normals.append(normal)
        levels.append(normal @ rig.centre_mm(view.camera))
    spread = np.linalg.svd(np.array(normals))
    if spread[1][1] < _PLANES_APART * np.sqrt(len(normals)):
        raise CalibrationError(
            "the cameras lie in one plane with the rod, so their pictures do not fix it; turn the rod or a camera"
        )
    direction = spread[2][-1]
    point = np.linalg.lstsq(np.array(normals), np.array(levels), rcond=None)[0]
    middle = np.mean([_nearest(rig.centre_mm(v.camera), rig.directions(v.camera, v.edge_rays.sum(1)), point, direction)
                      for own in views for v in own])  # fmt: skip
    return point + middle * direction, direction


def _nearest(origin: Array, directions: Array, point: Array, direction: Array) -> float:
    """Mean place along a line of its points nearest to rays (N, 3)."""
    return float(np.mean(_place(np.broadcast_to(origin, directions.shape), directions, point, direction)))


def _place(origin: Array, directions: Array, point: Array, direction: Array) -> Array:
    """Place (N,) along a line of its points nearest to rays."""
    along = directions @ direction
    offset = origin - point
    bottom = 1 - along**2
    return np.asarray((offset @ direction - along * (offset * directions).sum(1)) / bottom)


def _distance(rays: _Rays, point: Array, direction: Array) -> tuple[Array, Array, Array, Array]:
    """Distances (N,) of rays from a line, unit normals (N, 3) from line to ray, places on both (N,)."""
    place = _place(rays.origin, rays.direction, point, direction)
    nearest = point + place[:, None] * direction
    reach = ((nearest - rays.origin) * rays.direction).sum(1)
    off = rays.origin + reach[:, None] * rays.direction - nearest
    distance = np.linalg.norm(off, axis=1)
    return distance, off / distance[:, None], place, reach


def _sides(direction: Array) -> Array:
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _linearise(rays: _Rays, point: Array, direction: Array, radius: float) -> tuple[Array, Array]:
    """Residuals (N,) and derivatives (N, 5) by shifts, turns and radius, pixels."""
    distance, normal, place, reach = _distance(rays, point, direction)
    to_px = rays.focal_px / reach
    across = -(normal @ _sides(direction).T) * to_px[:, None]
    return (distance - radius) * to_px, np.concatenate([across, across * place[:, None], -to_px[:, None]], axis=1)


def _solve(rays: _Rays, residual: Array, jacobian: Array, weight: Array) -> tuple[Array, Array]:
    """Step of axis and radius with shift and tilt of every row free within what is expected of them.

    Returns
    -------
    step, covariance
        (5,) and (5, 5).
    """
    rows = len(rays.row_sd_px)
    index = rays.row.astype(int)
    lobes = np.zeros((len(residual), 2 * rows))
    lobes[np.arange(len(index)), 2 * index] = 1.0
    lobes[np.arange(len(index)), 2 * index + 1] = rays.share
    full = np.concatenate([jacobian, lobes], axis=1)
    scale = max(1.4826 * float(np.median(np.abs(residual))), _SCALE_FLOOR_PX)
    normal = full.T @ (full * weight[:, None]) / scale**2
    normal[np.arange(5, 5 + 2 * rows), np.arange(5, 5 + 2 * rows)] += np.repeat(rays.row_sd_px, 2) ** -2
    gradient = full.T @ (weight * residual) / scale**2
    inverse = np.linalg.inv(normal)
    step = -inverse @ gradient
    return step[:5], np.asarray(inverse[:5, :5])


def _weights(rows: Array, residual: Array) -> Array:
    """Tukey's biweight by rows."""
    weight = np.ones(len(residual))
    for row in np.unique(rows):
        mask = rows == row
        r = residual[mask] - np.median(residual[mask])
        scale = max(1.4826 * float(np.median(np.abs(r))), _SCALE_FLOOR_PX)
        weight[mask] = np.clip(1 - (r / (_TUKEY * scale)) ** 2, 0, None) ** 2
    return weight


def _bends(rays: _Rays, point: Array, direction: Array, radius: float) -> tuple[Array, Array]:
    """Bend (rad) and sagitta (mm) of each instant: an axis and a curvature of its own, reweighted least squares."""
    residual, jacobian = _linearise(rays, point, direction, radius)
    place = _distance(rays, point, direction)[2]
    bends, sagittas = [], []
    for instant in np.unique(rays.instant):
        mask = rays.instant == instant
        s = place[mask]
        middle, length = (s.max() + s.min()) / 2, float(np.ptp(s))
        curved = jacobian[mask][:, :2] * ((s - middle)[:, None] ** 2 / 2)
        columns = np.concatenate([jacobian[mask], curved], axis=1)
        weight, solution = np.ones(len(s)), np.zeros(7)
        for _ in range(_REWEIGHTED):
            root = np.sqrt(weight)[:, None]
            solution = np.linalg.lstsq(columns * root, -residual[mask] * root[:, 0], rcond=None)[0]
            weight = _weights(rays.row[mask], residual[mask] + columns @ solution)
        curvature = float(np.linalg.norm(solution[5:]))
        bends.append(curvature * length)
        sagittas.append(curvature * length**2 / 8)
    return np.array(bends), np.array(sagittas)
