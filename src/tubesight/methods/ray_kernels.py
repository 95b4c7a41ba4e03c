"""Compiled geometry of rays: undistorting few pixels, and the point where the tips' axes meet."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Indices
from tubesight.core.kernels import compiled, part

# Steps of Newton's method, and residual on the image plane at which it ends, as in `tubesight.geometry.lens`.
_STEPS, _TOLERANCE = 20, 1e-14
# Residual up to which a pixel counts as undistorted; others are left to the careful way.
_INVERTED = 1e-12


@compiled
def undistorted(pixels: Array, matrix: Array, k: Array) -> Array:
    """Camera rays (N, 3) ``(x, y, 1)`` of pixels (N, 2), by Newton's method from the distorted point.

    `k` (8,) are the coefficients of OpenCV's rational lens. NaN where that does not converge: the whole plane is
    searched by `tubesight.geometry.Camera.unproject`.
    """
    rays = np.ones((len(pixels), 3))
    for i in range(len(pixels)):
        v = (pixels[i, 1] - matrix[1, 2]) / matrix[1, 1]
        u = (pixels[i, 0] - matrix[0, 2] - matrix[0, 1] * v) / matrix[0, 0]
        x, y, error = u, v, np.inf
        for _ in range(_STEPS):
            r2 = x * x + y * y
            top = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
            bottom = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
            radial = top / bottom
            slope = (k[0] + r2 * (2 * k[1] + 3 * k[4] * r2)) / bottom
            slope -= radial * (k[5] + r2 * (2 * k[6] + 3 * k[7] * r2)) / bottom
            off_x = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) - u
            off_y = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y - v
            error = abs(off_x) + abs(off_y)
            if error < _TOLERANCE:
                break
            xx = radial + 2 * x * x * slope + 2 * k[2] * y + 6 * k[3] * x
            yy = radial + 2 * y * y * slope + 6 * k[2] * y + 2 * k[3] * x
            xy = 2 * x * y * slope + 2 * k[2] * x + 2 * k[3] * y
            determinant = xx * yy - xy * xy
            if not (determinant > 0 and xx + yy > 0):
                error = np.inf
                break
            x -= (yy * off_x - xy * off_y) / determinant
            y -= (xx * off_y - xy * off_x) / determinant
        inside = error < _INVERTED
        rays[i, 0], rays[i, 1] = (x, y) if inside else (np.nan, np.nan)
    return rays


@compiled
def meeting_point(directions: Array, centres: Array, focal_px: Array) -> tuple[Array, float]:
    """Point (3,) nearest to unit rays (V, 3) in pixels, and by how many pixels the farthest one misses it.

    Each ray counts by its focal length over its range, in a second pass.
    """
    point, weight = np.zeros(3), np.ones(len(directions))
    worst = 0.0
    for _ in range(3):
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for k in range(len(directions)):
            for i in range(3):
                for j in range(3):
                    across = weight[k] * ((1.0 if i == j else 0.0) - directions[k, i] * directions[k, j])
                    normal[i, j] += across
                    right[i] += across * centres[k, j]
        solve_three(normal, right, point)
        worst = 0.0
        for k in range(len(directions)):
            along, square = 0.0, 0.0
            for i in range(3):
                off = point[i] - centres[k, i]
                along += off * directions[k, i]
                square += off * off
            if not along > 0:
                point[:] = np.nan
                return point, np.inf
            off = np.sqrt(max(square - along * along, 0.0)) / along * focal_px[k]
            worst = off if off > worst else worst
            weight[k] = (focal_px[k] / along) ** 2
    return point, worst


@part
def solve_three(a: Array, b: Array, x: Array) -> float:
    """Solve a symmetric system of three equations by Cramer's rule into `x`.

    Returns the determinant over the sum of its second-order minors: the least eigenvalue, where that is far below the
    others, and never more than it.
    """
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c01 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c02 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    determinant = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    c11, c22 = a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0], a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    c12 = a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1]
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
    x[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant
    x[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant
    return determinant / (c00 + c11 + c22)  # type: ignore[no-any-return]


@compiled
def gather(
    edge_rays: Array,
    centreline_px: Array,
    contour_px: Array,
    counts: Indices,
    tip_px: Array,
    matrix: Array,
    k: Array,
    rotation: Array,
    most: int,
    tip_most: int,
) -> tuple[Array, Array, Array, Indices, bool]:
    """Twin of `tubesight.methods.rays.rows_of_view`, with the choice of contour points, for all views one by one.

    The arrays are those of `tubesight.methods.rays.flat`, of `lenses` and of `Optics`. Returns direction, place, lobes
    and the first ray of each of the three rows of a view, as in a `Problem`, and whether all numbers are finite: not
    where a point of a contour cannot be undistorted here.
    """
    views = len(counts)
    row_start = np.zeros(3 * views + 1, dtype=np.int64)
    for view in range(views):
        sides, at = min(counts[view, 0], most), row_start[3 * view]
        row_start[3 * view + 1], row_start[3 * view + 2] = at + sides, at + 2 * sides
        row_start[3 * view + 3] = at + 2 * sides + min(counts[view, 1], tip_most)
    rays = row_start[3 * views]
    direction, place, lobes = np.empty((rays, 3)), np.empty(rays), np.empty((rays, 2))
    scan, point, total = 0, 0, 0.0
    for view in range(views):
        scans, points, first = counts[view, 0], counts[view, 1], row_start[3 * view]
        gather_edges(
            edge_rays, centreline_px, scan, scans, tip_px[view], rotation[view], most, first, direction, place, lobes
        )
        first = row_start[3 * view + 2]
        gather_contour(
            contour_px, point, points, tip_px[view], matrix[view], k[view], rotation[view], tip_most, first, direction,
            place, lobes,
        )  # fmt: skip
        scan, point = scan + scans, point + points
    for at in range(rays):
        total += place[at] + lobes[at, 0] + lobes[at, 1] + direction[at, 0] + direction[at, 1] + direction[at, 2]
    return direction, place, lobes, row_start, np.isfinite(total)


@part
def gather_edges(
    edge_rays: Array,
    centreline_px: Array,
    scan: int,
    scans: int,
    tip_px: Array,
    rotation: Array,
    most: int,
    first: int,
    direction: Array,
    place: Array,
    lobes: Array,
) -> None:
    """Write the rows of both sides of a view, whose scans begin with `scan`, from the place `first` on."""
    chord = np.empty(scans + 1)
    chord[0] = 0.0
    for i in range(scans):
        there = centreline_px[scan + i + 1] if i + 1 < scans else tip_px
        x, y = there[0] - centreline_px[scan + i, 0], there[1] - centreline_px[scan + i, 1]
        chord[i + 1] = chord[i] + np.sqrt(x * x + y * y)
    count = min(scans, most)
    for j in range(count):
        i = evenly(j, scans, most)
        share = chord[i] / chord[scans]
        for side in range(2):
            at, ray = first + side * count + j, edge_rays[scan + i, side]
            place[at], lobes[at, 0], lobes[at, 1] = share, 1.0, 2 * share - 1
            turn_back(ray[0], ray[1], ray[2], rotation, direction[at])


@part
def gather_contour(
    contour_px: Array,
    point: int,
    points: int,
    tip_px: Array,
    matrix: Array,
    k: Array,
    rotation: Array,
    most: int,
    first: int,
    direction: Array,
    place: Array,
    lobes: Array,
) -> None:
    """Write the row of a view's tip, whose contour begins with `point`, from the place `first` on."""
    count = min(points, most)
    used = np.empty((count, 2))
    for j in range(count):
        used[j] = contour_px[point + evenly(j, points, most)]
    rays = undistorted(used, matrix, k)
    for j in range(count):
        at = first + j
        place[at] = 1.0
        x, y = used[j, 0] - tip_px[0], used[j, 1] - tip_px[1]
        size = np.sqrt(x * x + y * y)
        lobes[at, 0], lobes[at, 1] = x / size, y / size
        size = np.sqrt(rays[j, 0] * rays[j, 0] + rays[j, 1] * rays[j, 1] + 1.0)
        turn_back(rays[j, 0] / size, rays[j, 1] / size, 1.0 / size, rotation, direction[at])


@part
def evenly(j: int, count: int, most: int) -> int:
    """Place j of those chosen by `tubesight.methods.rays.spread`."""
    if count <= most:
        return j
    return int(j * ((count - 1) / (most - 1)) + 0.5)


@part
def turn_back(x: float, y: float, z: float, rotation: Array, direction: Array) -> None:
    """Write the direction in the base frame of a camera's ray; the rotation is ``camera_from_base``."""
    for c in range(3):
        direction[c] = x * rotation[0, c] + y * rotation[1, c] + z * rotation[2, c]
