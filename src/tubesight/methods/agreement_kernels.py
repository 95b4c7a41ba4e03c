"""Compiled twins of `tubesight.methods.agreement`: how far a reprojected curve is from what a view shows."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import compiled, part
from tubesight.geometry.rig import PARALLEL
from tubesight.methods.ray_kernels import solve_three

# Segments of a polyline that are passed over together: of 99 segments in 11 pieces, a point of them judges about 15.
PIECE = 9


@compiled
def off_squares(
    points: Array, rotation: Array, translation: Array, matrix: Array, k: Array, centreline_px: Array, tip_px: Array
) -> float:
    """Twin of `tubesight.methods.agreement.off_squares`, for the lenses of `tubesight.methods.rays.lens`."""
    px = np.empty((len(points), 2))
    for i in range(len(points)):
        if not projected(points[i], rotation, translation, matrix, k, px[i]):
            return np.inf
    segments, circles = pieces(px)
    total, near = 0.0, 0
    for j in range(len(centreline_px) + 1):
        q = centreline_px[j] if j < len(centreline_px) else tip_px
        square, near = nearest(segments, circles, q[0], q[1], near)
        total += square
    return total


@compiled
def projected(point: Array, rotation: Array, translation: Array, matrix: Array, k: Array, px: Array) -> bool:
    """Project a point of the base frame into `px`; whether that is in front of the camera, and finite."""
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    if not z > 0:
        return False
    x = (rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]) / z
    y = (rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]) / z
    r2 = x * x + y * y
    radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    u = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    v = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    px[0] = matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2]
    px[1] = matrix[1, 1] * v + matrix[1, 2]
    return np.isfinite(px[0]) and np.isfinite(px[1])  # type: ignore[no-any-return]


@part
def pieces(px: Array) -> tuple[Array, Array]:
    """Cut a polyline (M, 2) into segments (M - 1, 5) and circles (C, 3) that hold `PIECE` of them each.

    Segments: start, step, inverse square of its length. Circles: centre, radius.
    """
    last = len(px) - 1
    segments, circles = np.empty((last, 5)), np.empty(((last + PIECE - 1) // PIECE, 3))
    for i in range(last):
        dx, dy = px[i + 1, 0] - px[i, 0], px[i + 1, 1] - px[i, 1]
        square = dx * dx + dy * dy
        segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3] = px[i, 0], px[i, 1], dx, dy
        segments[i, 4] = 1 / square if square > 0 else 0.0
    for c in range(len(circles)):
        low, high = c * PIECE, min((c + 1) * PIECE, last)
        x, y = px[(low + high) // 2, 0], px[(low + high) // 2, 1]
        largest = 0.0
        for i in range(low, high + 1):
            largest = max(largest, (px[i, 0] - x) ** 2 + (px[i, 1] - y) ** 2)
        circles[c, 0], circles[c, 1], circles[c, 2] = x, y, np.sqrt(largest)
    return segments, circles


@part
def nearest(segments: Array, circles: Array, x: float, y: float, guess: int) -> tuple[float, int]:
    """Square of the distance of a point from a polyline cut by `pieces`, and its nearest segment.

    Pieces whose circle is farther than the nearest segment so far are passed over.
    """
    best, found = from_segment(segments, x, y, guess), guess
    root = np.sqrt(best)
    for c in range(len(circles)):
        u, v, reach = x - circles[c, 0], y - circles[c, 1], circles[c, 2] + root
        if u * u + v * v > reach * reach:
            continue
        for i in range(c * PIECE, min((c + 1) * PIECE, len(segments))):
            square = from_segment(segments, x, y, i)
            if square < best:
                best, found = square, i
        root = np.sqrt(best)
    return best, found


@part
def from_segment(segments: Array, x: float, y: float, i: int) -> float:
    """Square of the distance of a point from a segment."""
    u, v, dx, dy = x - segments[i, 0], y - segments[i, 1], segments[i, 2], segments[i, 3]
    share = min(max((u * dx + v * dy) * segments[i, 4], 0.0), 1.0)
    u, v = u - share * dx, v - share * dy
    return u * u + v * v  # type: ignore[no-any-return]


@compiled
def triangulated(rays: Array, rotations: Array, translations: Array, focal_px: Array) -> Array:
    """Twin of `tubesight.geometry.Rig.triangulate` for one point that all V cameras see: rays (V, 3) ``(x, y, 1)``."""
    views, point = len(rays), np.zeros(3)
    normal, right, direction, centre = np.zeros((3, 3)), np.zeros(3), np.empty(3), np.empty(3)
    for k in range(views):
        size = np.sqrt(rays[k, 0] * rays[k, 0] + rays[k, 1] * rays[k, 1] + rays[k, 2] * rays[k, 2])
        for i in range(3):
            direction[i], centre[i] = 0.0, 0.0
            for j in range(3):
                direction[i] += rotations[k, j, i] * rays[k, j] / size
                centre[i] -= rotations[k, j, i] * translations[k, j]
        for i in range(3):
            for j in range(3):
                across = (1.0 if i == j else 0.0) - direction[i] * direction[j]
                normal[i, j] += across
                right[i] += across * centre[j]
    if not (views >= 2 and solve_three(normal, right, point) > PARALLEL):
        return np.full(3, np.nan)
    row, step = np.empty(3), np.empty(3)
    for _ in range(3):
        normal[:], right[:] = 0.0, 0.0
        for k in range(views):
            turn, move = rotations[k], translations[k]
            x = turn[0, 0] * point[0] + turn[0, 1] * point[1] + turn[0, 2] * point[2] + move[0]
            y = turn[1, 0] * point[0] + turn[1, 1] * point[1] + turn[1, 2] * point[2] + move[1]
            z = turn[2, 0] * point[0] + turn[2, 1] * point[1] + turn[2, 2] * point[2] + move[2]
            if not z > 0:
                return np.full(3, np.nan)
            for side in range(2):
                image = (x if side == 0 else y) / z
                off = (image - rays[k, side]) * focal_px[k]
                for i in range(3):
                    row[i] = (turn[side, i] - image * turn[2, i]) / z * focal_px[k]
                for i in range(3):
                    right[i] += row[i] * off
                    for j in range(3):
                        normal[i, j] += row[i] * row[j]
        least = solve_three(normal, right, step)
        if not least > PARALLEL * (normal[0, 0] + normal[1, 1] + normal[2, 2]):
            return np.full(3, np.nan)
        for i in range(3):
            point[i] -= step[i]
    return point
