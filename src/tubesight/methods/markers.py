"""Bands, triangulated and joined by a spline, after Rucker & Webster (2011).

Bands all along the backbone are thresholded in two pictures; the i-th from the base in one is the i-th in the other;
the triangulated points are joined by a natural cubic spline by chord length, and the last one is the tip. Reconstructed
here: the colour of the bands is unmixed from those of tube and background; a band's middle is corrected for its bow,
which on thick tubes is worth millimetres; a clamped tube starts at its clamp.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.interpolate import CubicSpline

from tubesight.core import Status, Tube, Unmeasurable
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.rig import Rig
from tubesight.geometry.splines import by_arc_length
from tubesight.methods.bands import base_point, triangulate_bands
from tubesight.vision.view import View

# Fewest points that a bend is known from.
_POINTS_MIN = 3
# Neighbours nearer to each other than this share of the median distance are one band seen twice.
_NEAR = 0.1


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Join the triangulated bands by a natural cubic spline; the last band is the tip.

    Raises
    ------
    Unmeasurable
        If the views show different bands, or too few of them.
    """
    points = triangulate_bands(views, rig)
    base = base_point(views, rig, tube)
    if base is not None:
        points = np.vstack([base, points])
    if len(points) < _POINTS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(points)} bands")
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if not step.min() > _NEAR * np.median(step):
        raise Unmeasurable(Status.VIEWS_DISAGREE, detail="two bands lie at one place")
    chord = np.concatenate([[0.0], np.cumsum(step)])
    spline = CubicSpline(chord / chord[-1], points, bc_type="natural")
    return by_arc_length("spline", spline, spline.derivative())
