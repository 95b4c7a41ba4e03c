"""A tube whose diameter changes along it, made even: each pair of edges is moved to the distance of one radius."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tubesight.core import Array
from tubesight.geometry.polyline import lengths_along, place_along
from tubesight.geometry.rig import Rig
from tubesight.vision.view import View


def evened(views: Mapping[str, View], rig: Rig, curve_mm: Array, radius_mm: float) -> dict[str, View]:
    """Show the tube as if it were of one radius: both edges of a scan stay about their bisector.

    An edge of a tube of radius R at range r from the camera is seen at the angle ``asin(R / r)`` from the middle of the
    tube. The range is that of a curve near the tube; where it is wrong, both edges of a scan are moved alike, so that
    the middle stays where it is.

    Parameters
    ----------
    curve_mm
        (K, 3) points of a curve near the tube, from base to tip.
    """
    return {name: _evened(view, rig, curve_mm, radius_mm) for name, view in views.items()}


def _evened(view: View, rig: Rig, curve_mm: Array, radius_mm: float) -> View:
    camera = rig.cameras[view.camera]
    points = rig.project(view.camera, curve_mm)
    chord = lengths_along(points)
    place, _ = place_along(points, view.centreline_px)
    distance = np.linalg.norm(curve_mm - rig.centre_mm(view.camera), axis=1)
    angle = np.arcsin(np.clip(radius_mm / np.interp(place, chord, distance), 0.0, 1.0))[:, None]
    middle = view.rays / np.linalg.norm(view.rays, axis=1, keepdims=True)
    across = view.edge_rays[:, 0] - view.edge_rays[:, 1]
    across -= (across * middle).sum(1, keepdims=True) * middle
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rays = np.stack([np.cos(angle) * middle + side * np.sin(angle) * across for side in (1, -1)], 1)
    return replace(view, edge_rays=rays, edges_px=camera.project(rays / rays[..., 2:]))
