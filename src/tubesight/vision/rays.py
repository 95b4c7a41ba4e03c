"""From edges and contours in the picture to rays of the camera."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.geometry.camera import Camera
from tubesight.vision.fitting import solve

# Contour rays are trimmed this often, at this many pixels or 3 robust deviations off the cone.
TRIMS, OFF_PX, SIGMAS = 4, 0.2, 3 * 1.4826
# Roughness of an edge under which no row is believed to be.
ROUGH_MIN_PX = 0.02
# A third difference of independent deviations (a second one still has the bend) has sqrt(20) times their deviation; the
# median absolute one is 1 / 1.4826 of that.
THIRD_TO_SD = 1.4826 / float(np.sqrt(20))


def tangent_cone(camera: Camera, contour_px: Array) -> tuple[Array, Array, Array, float, float]:
    """Fit the circular cone of unit rays u that touch a ball: ``u . a = 1``, the axis is ``a / |a|``.

    Returns
    -------
    axis, px, contour_px, angle_rad, rms_px
        (3,) unit axis, its pixel (2,), the points (K, 2) kept, half the angle of the cone and the points' root mean
        square distance from it; all NaN (and no points) where no such cone exists.
    """
    rays = camera.unproject(contour_px)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    keep = np.isfinite(unit).all(1)
    nothing = np.full(3, np.nan), np.full(2, np.nan), np.empty((0, 2)), float("nan"), float("nan")
    a = np.zeros(3)
    for _ in range(TRIMS):
        if keep.sum() < 3:
            return nothing
        used = unit[keep]
        # The equations of a narrow cone are ill-conditioned: each round corrects the digits that the last one lost.
        a = a + solve(used, 1 - used @ a)
        size = float(np.linalg.norm(a))
        if not size > 1:
            return nothing
        angle = float(np.arccos(1 / size))
        off_px = (np.arccos(np.clip(unit @ a / size, -1, 1)) - angle) * camera.focal_px
        keep = np.abs(off_px) <= max(OFF_PX, SIGMAS * float(np.median(np.abs(off_px[keep]))))
    rms = float(np.sqrt(np.mean(off_px[keep] ** 2)))
    return a / size, camera.project(a), contour_px[keep], angle, rms


def tube_rays(
    camera: Camera, edges_px: Array, heading: Array, tip_px: Array, near_px: float, room_px: float, base_px: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Rays of the tube's edges and of its base.

    Parameters
    ----------
    edges_px
        (N, 2, 2); scans on the tip or past it are left out, since near it only the tube itself has parallel edges.
    heading
        (2,) unit way of the tube before the tip.
    near_px, room_px
        Scans within `near_px` of the tip are left out unless they lie at least `room_px` before it.

    Returns
    -------
    edges_px, edge_rays, rays, centreline_px, base, edge_sd_px
        As in `tubesight.vision.view.View`.
    """
    middle = edges_px.mean(1)
    near = np.linalg.norm(middle - tip_px, axis=1) < near_px
    edges_px = edges_px[~near | ((tip_px - middle) @ heading > room_px)]
    rays = camera.unproject(edges_px)
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    bisector = unit.sum(1)
    centre = bisector / bisector[:, 2:]
    return edges_px, unit, centre, camera.project(centre), camera.unproject(base_px), roughness(edges_px)


def roughness(edges_px: Array) -> Array:
    """Robust deviation (2,) of each row of edges (N, 2, 2) from the line of its neighbours, across the tube.

    NaN for fewer than four scans.
    """
    if len(edges_px) < 4:
        return np.full(2, np.nan)
    across = edges_px[:, 0] - edges_px[:, 1]
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    third = np.diff(edges_px, 3, axis=0)
    off = np.abs(np.einsum("nsk,nk->ns", third, (across[1:-2] + across[2:-1]) / 2))
    return np.asarray(np.maximum(THIRD_TO_SD * np.median(off, axis=0), ROUGH_MIN_PX))
