"""Compiled twins of `tubesight.methods.agreement`: how far a reprojected curve is from what a view shows."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import compiled


@compiled
def off_squares(
    points: Array, rotation: Array, translation: Array, matrix: Array, k: Array, centreline_px: Array, tip_px: Array
) -> float:
    """Twin of `tubesight.methods.agreement.off_squares`, for the lenses of `tubesight.methods.rays.lens`."""
    px, along = np.empty((len(points), 2)), np.empty(len(points))
    for i in range(len(points)):
        if not projected(points[i], rotation, translation, matrix, k, px[i]):
            return np.inf
        x, y = px[i, 0] - px[i - 1, 0], px[i, 1] - px[i - 1, 1]
        along[i] = along[i - 1] + np.sqrt(x * x + y * y) if i > 0 else 0.0
    total, near = 0.0, 0
    for j in range(len(centreline_px) + 1):
        q = centreline_px[j] if j < len(centreline_px) else tip_px
        square, near = nearest(px, along, q[0], q[1], near)
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


@compiled
def nearest(px: Array, along: Array, x: float, y: float, guess: int) -> tuple[float, int]:
    """Square of the distance of a point from a polyline (M, 2) with lengths `along` (M,), and its nearest segment.

    All segments are judged: no point of the line is nearer than a segment's distance less the way from it, so that
    most of them are passed over.
    """
    best, found = from_segment(px, x, y, guess), guess
    limit = 0.0
    for i in range(len(px) - 1):
        if along[i + 1] < limit:
            continue
        square = from_segment(px, x, y, i)
        if square < best:
            best, found = square, i
        limit = along[i + 1] + np.sqrt(square) - np.sqrt(best)
    return best, found


@compiled
def from_segment(px: Array, x: float, y: float, i: int) -> float:
    """Square of the distance of a point from segment i of a polyline."""
    dx, dy = px[i + 1, 0] - px[i, 0], px[i + 1, 1] - px[i, 1]
    u, v = x - px[i, 0], y - px[i, 1]
    square = dx * dx + dy * dy
    share = (u * dx + v * dy) / square if square > 0 else 0.0
    share = min(max(share, 0.0), 1.0)
    u, v = u - share * dx, v - share * dy
    return u * u + v * v
