"""Compiled twin of the cubic Hermite spline of `tubesight.geometry.curve.NodeCurve`."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import compiled


@compiled
def hermite(s: Array, points: Array, tangents: Array, at: Array) -> tuple[Array, Array]:
    """Points (N, 3) at arc lengths (N,) and their derivatives, past both ends by the last piece."""
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
