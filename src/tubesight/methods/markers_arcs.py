"""Bands on the sections of a robot, and one arc through those of each, after Webster, Romano & Cowan (2009).

The bands are triangulated; those of one section give a plane (singular values) and in it a circle (algebraic least
squares) that continues the tangent at the end of the section before; the last band is the tip. The original found its
cameras' poses from a printed grid beside the robot; here the rig is calibrated, and the grid is only what the robot is
seen against. Reconstructed here: where the first section starts with the clamp's tangent or, of a free tube, with that
of the circle through its own bands.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.arcs import bending_plane, end_of, free_arc, free_line, joined
from tubesight.geometry.curve import Arc, Curve3D
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import reprojection_rms_px
from tubesight.methods.bands import base_point, triangulate_bands
from tubesight.vision.view import View

# Curves that leave the centrelines by more than this share of the tube's width are not made of such sections.
_OFF_WIDTHS = 0.25
# Turns below this are straight to a nanometre on any tube.
_STRAIGHT_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class MarkersArcs:
    """One arc a section, as a method.

    Attributes
    ----------
    marks
        Bands on each section, the last one at its end.
    """

    marks: int = 3

    def __call__(self, views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
        """Join the arcs of all sections.

        Raises
        ------
        Unmeasurable
            If the views show different bands, not so many to a section, or sections that are no arcs.
        """
        points = triangulate_bands(views, rig)
        if len(points) % self.marks:
            raise Unmeasurable(
                Status.VIEWS_DISAGREE, detail=f"{len(points)} bands are not {self.marks} to each section"
            )
        base = base_point(views, rig, tube)
        if base is None:
            raise Unmeasurable(Status.BASE_HIDDEN, detail="the views do not tell where the tube starts")
        sections = points.reshape(-1, self.marks, 3)
        arcs: list[Arc] = [] if tube.clamped else [_first_of_free(np.vstack([base, sections[0]]))]
        for section in sections[len(arcs) :]:
            start = end_of(arcs[-1]) if arcs else Pose(np.eye(3), base)
            arcs.append(continued_arc(start, section))
        curve = joined(arcs)
        rms = reprojection_rms_px(curve, views, rig)
        if not rms <= _OFF_WIDTHS * min(float(np.median(view.widths_px)) for view in views.values()):
            raise Unmeasurable(Status.RESIDUAL_TOO_LARGE, detail=f"one arc a section leaves an rms of {rms:.1f} px")
        return curve


def _first_of_free(points: Array) -> Arc:
    weights = np.ones(len(points))
    try:
        return free_arc(points, weights, points[-1])
    except ValueError:
        return free_line(points, weights, points[-1])


def continued_arc(start: Pose, points_mm: Array) -> Arc:
    """Arc that leaves a frame along its +z and passes points (N, 3) best; it ends at the foot of the last one.

    In the plane through +z that fits the points best, with (x, y) across and along, the circles that touch +z at the
    origin are ``kappa / 2 (x^2 + y^2) = x``; kappa is its least squares solution.
    """
    local = start.inverse().apply(points_mm)
    direction = bending_plane(local, np.ones(len(local)))
    across, along = local[:, :2] @ direction, local[:, 2]
    square = across**2 + along**2
    curvature = 2 * float(across @ square) / float(square @ square)
    turn = float(np.arctan2(curvature * along[-1], 1 - curvature * across[-1]))
    if abs(turn) < _STRAIGHT_RAD:
        return Arc(direction * curvature, max(float(along[-1]), 0.0), start)
    turn = turn % (2 * np.pi) if curvature > 0 else -(-turn % (2 * np.pi))
    return Arc(direction * curvature, turn / curvature, start)
