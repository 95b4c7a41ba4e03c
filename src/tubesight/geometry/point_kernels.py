"""Compiled twins of the points and tangents of `tubesight.geometry.curve`."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import compiled


@compiled
def hermite(s: Array, points: Array, tangents: Array, at: Array) -> tuple[Array, Array]:
    """Twin of `tubesight.geometry.curve.hermite`."""
    places, slopes = np.empty((len(at), 3)), np.empty((len(at), 3))
    last, i = len(s) - 2, 0
    for k in range(len(at)):
        while i < last and at[k] >= s[i + 1]:
            i += 1
        while i > 0 and at[k] < s[i]:
            i -= 1
        h = s[i + 1] - s[i]
        x = at[k] - s[i]
        for c in range(3):
            slope = (points[i + 1, c] - points[i, c]) / h
            bend = (tangents[i, c] + tangents[i + 1, c] - 2 * slope) / h
            lean = (slope - tangents[i, c]) / h - bend
            places[k, c] = points[i, c] + x * (tangents[i, c] + x * (lean + x * bend / h))
            slopes[k, c] = tangents[i, c] + x * (2 * lean + 3 * x * bend / h)
    return places, slopes


@compiled
def arc(curvature: Array, rotation: Array, translation: Array, at: Array) -> tuple[Array, Array]:
    """Twin of `tubesight.geometry.curve.arc`."""
    points, tangents = np.empty((len(at), 3)), np.empty((len(at), 3))
    kx, ky = curvature[0], curvature[1]
    bend = np.sqrt(kx * kx + ky * ky)
    for i in range(len(at)):
        s = at[i]
        half = s * bend / 2
        ratio = np.sin(half) / half if half != 0 else 1.0
        side, slope = s * s / 2 * ratio * ratio, s * ratio * np.cos(half)
        for c in range(3):
            x, y, z = rotation[c, 0], rotation[c, 1], rotation[c, 2]
            points[i, c] = x * kx * side + y * ky * side + z * slope + translation[c]
            tangents[i, c] = x * kx * slope + y * ky * slope + z * np.cos(2 * half)
    return points, tangents
