"""Bands painted on the tube."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from tubesight.core import Array
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.simulate.scene import Scene, light_from_srgb
from tubesight.simulate.sweep import Body, Surface

# Spacing of the places that a surface point is compared with: the foot on the nearest one's tangent is then off by
# kappa spacing^2 / 8, a micrometre at a bend of 10 mm radius.
_SPACING_MM = 0.25


def paint_of(surface: Surface, body: Body, scene: Scene, camera: Camera, camera_from_base: Pose) -> Array:
    """Linear colour of a body's surface: (3,), or (rows, columns, 3) where it has bands."""
    tube, band = light_from_srgb(scene.tube_bgr), light_from_srgb(scene.band_bgr)
    if not scene.bands_mm:
        return tube
    # Beside the silhouette pixels are covered in part; their points are the nearest ones of their rays.
    drawn = np.isfinite(surface.distance_mm)
    place = arc_lengths(body, camera_from_base.inverse().apply(surface.points_mm[drawn]))
    pixel_mm = surface.distance_mm[drawn] / camera.focal_px
    share = np.zeros(drawn.shape)
    for start, end in scene.bands_mm:
        inside = place - start if end >= body.phantom.length_mm else np.minimum(place - start, end - place)
        share[drawn] = np.maximum(share[drawn], np.clip(inside / pixel_mm + 0.5, 0.0, 1.0))
    return np.asarray(tube + share[..., None] * (band - tube))


def arc_lengths(body: Body, points_mm: Array) -> Array:
    """Arc length (N,) at which each point (N, 3) of a body's surface lies; that of the tip all over its ball."""
    length = body.phantom.length_mm
    s = np.linspace(0.0, length, max(int(np.ceil(length / _SPACING_MM)), 1) + 1)
    centres, tangents = body.phantom.at(s), body.phantom.tangent(s)
    _, near = cKDTree(centres).query(points_mm)
    place = s[near] + ((points_mm - centres[near]) * tangents[near]).sum(-1)
    if body.ball_radius_mm is not None:
        off_wall = np.abs(np.linalg.norm(points_mm - centres[near], axis=-1) - body.radius_mm)
        off_ball = np.abs(np.linalg.norm(points_mm - centres[-1], axis=-1) - body.ball_radius_mm)
        place = np.where(off_ball < off_wall, length, place)
    return np.asarray(place)
