"""Marked section ends in one picture of a planar robot, after Hannan & Walker (2005).

Each section is one arc. From the chord c between its ends and the angle alpha between the tangent at its start and that
chord, ``kappa = 2 sin(alpha) / |c|`` and its length is ``2 alpha / kappa``; the next section starts at its end, with
the tangent turned by ``2 alpha``.

The original looks squarely at the plane in which its robot bends. Reconstructed here: the picture is rectified to that
plane by the calibration. Which plane it is one picture cannot tell; where there are two, the bands are triangulated for
nothing but this plane, and the picture that shows it most squarely is measured. A clamped tube in a single picture is
taken to bend across the line of sight.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tubesight.core import Array, Status, Tube, Unmeasurable
from tubesight.geometry.arcs import bending_plane, free_plane, joined, tangent_arc
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods.bands import banded, base_point, triangulate_bands
from tubesight.vision.view import View

# Bands farther from their plane than this share of the tube's length, or of its diameter, are not planar.
_OFF_PLANE, _OFF_DIAMETERS = 0.02, 0.1
# Sine of the angle between plane and line of sight below which its picture is too flat to be measured.
_SQUARE_MIN = 0.25
# The tangent at the base of a free tube is that of this share of its centreline.
_FIRST_SHARE = 0.08


class _Plane(NamedTuple):
    """Plane of bending: where the tube starts in it, and unit axes (2, 3), the first one along a clamped tube."""

    origin_mm: Array
    axes: Array

    @property
    def normal(self) -> Array:
        return np.asarray(np.cross(self.axes[0], self.axes[1]))


def solve(views: Mapping[str, View], rig: Rig, tube: Tube) -> Curve3D:
    """Measure one arc a section in the view that shows their plane most squarely.

    Raises
    ------
    Unmeasurable
        If the bands do not lie in a plane, no view shows it squarely enough, or where the tube starts is not known.
    """
    seen = banded(views)
    plane = _given_plane(views, rig, tube)
    square = {n: abs(float(plane.normal @ rig.directions(n, v.rays[len(v.rays) // 2]))) for n, v in seen.items()}
    name = max(square, key=lambda n: square[n])
    if square[name] < _SQUARE_MIN:
        raise Unmeasurable(Status.NEAR_DEGENERATE, name, "the plane of bending is seen edge-on")
    view = seen[name]
    ends = _rectified(rig.cameras[name].unproject(view.bands_px), name, plane, rig)
    tangent = np.array([1.0, 0.0])
    if not tube.clamped:
        count = max(int(_FIRST_SHARE * len(view.rays)), 2)
        first = _rectified(view.rays[:count], name, plane, rig)
        tangent = first[-1] - first[0]
    return joined([tangent_arc(*section) for section in _sections(ends, tangent, plane)])


def _given_plane(views: Mapping[str, View], rig: Rig, tube: Tube) -> _Plane:
    """Plane in which the tube bends: of the triangulated bands, or across the line of sight of a single view."""
    if len(views) == 1:
        if not tube.clamped:
            raise Unmeasurable(Status.TOO_FEW_POINTS, detail="one view of a free tube does not tell its plane")
        across = np.cross(rig.camera_from_base[next(iter(views))].rotation[2], [0.0, 0.0, 1.0])
        if not np.linalg.norm(across) > _SQUARE_MIN:
            raise Unmeasurable(Status.NEAR_DEGENERATE, detail="the view looks along the clamp's axis")
        return _Plane(np.zeros(3), np.stack([[0.0, 0.0, 1.0], across / np.linalg.norm(across)]))
    base = base_point(views, rig, tube)
    if base is None:
        raise Unmeasurable(Status.BASE_HIDDEN, detail="the views do not tell where the tube starts")
    points = np.vstack([base, triangulate_bands(views, rig)])
    if tube.clamped:
        side = bending_plane(points, np.ones(len(points)))
        plane = _Plane(base, np.array([[0.0, 0.0, 1.0], [*side, 0.0]]))
    else:
        plane = _Plane(base, free_plane(points, np.ones(len(points)))[1])
    off = np.abs((points - plane.origin_mm) @ plane.normal).max()
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    if not off <= _OFF_PLANE * length + _OFF_DIAMETERS * (tube.diameter_mm or 0.0):
        raise Unmeasurable(Status.NOT_QUADRATIC, detail=f"the bands lie up to {off:.1f} mm off their plane")
    return plane


def _rectified(rays: Array, name: str, plane: _Plane, rig: Rig) -> Array:
    """Plane coordinates (N, 2) of where the rays (N, 3) of a camera meet the plane."""
    directions, centre = rig.directions(name, rays), rig.centre_mm(name)
    depth = ((plane.origin_mm - centre) @ plane.normal) / (directions @ plane.normal)
    return np.asarray((centre + depth[:, None] * directions - plane.origin_mm) @ plane.axes.T)


def _sections(ends: Array, tangent: Array, plane: _Plane) -> list[tuple[Pose, Array]]:
    """Start frame of each section, +z along the tube and +x in the plane, with its chord (3,) in that frame."""
    sections = []
    start, along = np.zeros(2), tangent / np.linalg.norm(tangent)
    for end in ends:
        side = np.array([-along[1], along[0]])
        chord = end - start
        alpha = float(np.arctan2(chord @ side, chord @ along))
        axes = np.stack([side @ plane.axes, plane.normal, along @ plane.axes], -1)
        axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
        sections.append(
            (Pose(axes, plane.origin_mm + start @ plane.axes), np.array([chord @ side, 0.0, chord @ along]))
        )
        cos, sin = np.cos(2 * alpha), np.sin(2 * alpha)
        start, along = end, cos * along + sin * side
    return sections
