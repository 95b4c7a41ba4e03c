"""Compiled twins of `tubesight.geometry.shape` and of the checks of `tubesight.geometry.deviations`."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import compiled, part


@compiled
def measured(
    points: Array, tangents: Array, s: Array, d_points: Array, d_turn: Array, d_s: Array
) -> tuple[Array, Array]:
    """Twin of `tubesight.geometry.shape.measured`."""
    last, size = len(s) - 1, d_s.shape[1]
    rows = np.zeros((8, size))
    axis, length = np.empty(3), s[last]
    turned = 0.0
    for i in range(last):
        turn = turning(tangents, i, i + 1, axis)
        turned += turn
        for q in range(size):
            for c in range(3):
                rows[6, q] += axis[c] * (d_turn[i + 1, c, q] - d_turn[i, c, q])
    bending = turning(tangents, 0, last, axis)
    side = np.empty(3)
    for c in range(3):
        one, two = (c + 1) % 3, (c + 2) % 3
        side[c] = tangents[last, one] * axis[two] - tangents[last, two] * axis[one]
    x, y, z = points[last, 0], points[last, 1], points[last, 2]
    square, curvature = x * x + y * y, turned / length
    for q in range(size):
        for c in range(3):
            rows[c, q] = d_points[last, c, q]
            turn = d_turn[last, c, q] - d_turn[0, c, q]
            rows[3, q] += axis[c] * turn
            rows[7, q] += side[c] * turn
        rows[4, q] = (x * rows[1, q] - y * rows[0, q]) / square if square > 0 else 0.0
        rows[5, q] = d_s[last, q]
        rows[6, q] = (rows[6, q] - curvature * rows[5, q]) / length
    return np.array([x, y, z, bending, np.arctan2(y, x), length, curvature]), rows


@part
def turning(tangents: Array, i: int, j: int, axis: Array) -> float:
    """Angle between two tangents; writes the unit axis they turn about, any across the first where they do not."""
    a, b = tangents[i], tangents[j]
    sine, cosine = 0.0, 0.0
    for c in range(3):
        one, two = (c + 1) % 3, (c + 2) % 3
        axis[c] = a[one] * b[two] - a[two] * b[one]
        sine += axis[c] * axis[c]
        cosine += a[c] * b[c]
    sine = np.sqrt(sine)
    size = sine
    if sine == 0.0:
        if abs(a[2]) < 0.9:
            axis[0], axis[1], axis[2] = a[1], -a[0], 0.0
        else:
            axis[0], axis[1], axis[2] = 0.0, a[2], -a[1]
        size = np.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    for c in range(3):
        axis[c] /= size
    return np.arctan2(sine, cosine)  # type: ignore[no-any-return]


@compiled
def spread(rows: Array, covariance: Array) -> Array:
    """Twin of `tubesight.geometry.shape.spread`."""
    out = np.empty(len(rows))
    for k in range(len(rows)):
        out[k] = np.sqrt(max(form(rows, k, covariance), 0.0))
    return out


@part
def form(rows: Array, k: int, matrix: Array) -> float:
    """Quadratic form of a row and a symmetric matrix."""
    total = 0.0
    for q in range(len(matrix)):
        line = 0.0
        for r in range(len(matrix)):
            line += matrix[q, r] * rows[k, r]
        total += line * rows[k, q]
    return total


@compiled
def bounded(s: Array, d_s: Array, covariance: Array) -> bool:
    """Twin of `tubesight.geometry.deviations.bounded`."""
    grown = np.empty((1, d_s.shape[1]))
    for i in range(len(s) - 1):
        for q in range(d_s.shape[1]):
            grown[0, q] = d_s[i + 1, q] - d_s[i, q]
        length = s[i + 1] - s[i]
        if not form(grown, 0, covariance) < length * length:
            return False
    return True
