"""Splines through points in space as curves by arc length."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, CubicSpline, splprep

from tubesight.core import Array
from tubesight.geometry.curve import NodeCurve
from tubesight.geometry.polyline import lengths_along

# Nodes of a curve: at 49 of them a cubic Hermite piece of a tube that turns by 360 degrees is 1e-6 of its length off.
_NODES = 97
# Steps of the arc length's quadrature: the chord of one on that tube is 4e-7 of itself too short.
_STEPS = 1921


def by_arc_length(model: str, at: Callable[[Array], Array], velocity: Callable[[Array], Array]) -> NodeCurve:
    """Turn a parametric curve over [0, 1] into one by arc length.

    Parameters
    ----------
    at, velocity
        Points (N, 3) and their derivatives (N, 3) at parameters (N,); the derivative must not vanish.
    """
    u = np.linspace(0.0, 1.0, _STEPS)
    s = lengths_along(at(u))
    places = np.linspace(0.0, s[-1], _NODES)
    nodes = np.interp(places, s, u)
    tangent = velocity(nodes)
    return NodeCurve(model, places, at(nodes), tangent / np.linalg.norm(tangent, axis=1, keepdims=True))


def interpolating(points_mm: Array) -> NodeCurve:
    """Cubic spline (not a knot) through points (N, 3), N > 1, by chord length; no two neighbours may coincide."""
    chord = lengths_along(points_mm)
    spline = CubicSpline(chord / chord[-1], points_mm)
    return by_arc_length("spline", spline, spline.derivative())


def smoothing(points_mm: Array, place: Array, sd_mm: Array) -> NodeCurve:
    """Cubic spline of fewest knots that passes points within their deviations (Dierckx 1975).

    Parameters
    ----------
    points_mm
        (N, 3), N > 3.
    place
        (N,) parameters, increasing.
    sd_mm
        (N,) deviation of each point across the curve; the sum of squared distances over them is N.
    """
    u = (place - place[0]) / (place[-1] - place[0])
    # Its declared type covers all it can be asked for.
    fitted: Any = splprep(points_mm.T, w=1 / sd_mm, u=u, s=len(points_mm))[0]
    knots, control, degree = fitted
    spline = BSpline(knots, np.stack(control, -1), degree)
    return by_arc_length("spline", spline, spline.derivative())
