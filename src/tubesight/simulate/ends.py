"""Flat ends of tubes: the outline of the end disc, and where the wall behind it stops in the picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from tubesight.core import Array
from tubesight.geometry.camera import Camera
from tubesight.simulate.rays import dot

# Corners of the polygon that stands for a disc: an inscribed polygon of 256 corners misses 0.002 px of a disc of
# 25 px radius.
_RIM_CORNERS = 256
# Longest side of the outline: far shorter than its radius of curvature.
_SIDE_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class FlatEnd:
    """A tube's flat cut, in the camera frame.

    Attributes
    ----------
    centre_mm, axis
        (3,) middle of the cut and its outward normal.
    radius_mm
        Of the tube.
    depth_mm
        The last stretch of tube that the outline covers; several pixels, so that the seam between outline and wall lies
        wholly inside the tube.
    """

    centre_mm: Array
    axis: Array
    radius_mm: float
    depth_mm: float

    def cut_wall(self, wall: Array, camera: Camera, pixels: Array) -> Array:
        """Replace the round end of a wall by the flat one.

        Parameters
        ----------
        wall
            (rows, columns, 3) edge field of the balls near the end.
        pixels
            (rows, columns, 2) pixel coordinates.
        """
        half_plane = self._behind(camera, pixels)
        cut = np.where(wall[..., :1] > half_plane[..., :1], wall, half_plane)
        outline = self._outline(camera, pixels)
        return np.where(cut[..., :1] < outline[..., :1], cut, outline)

    def _contacts(self) -> Array | None:
        """Two points (2, 3) where the wall's limb crosses the middle of the stretch; None where seen from within.

        The wall's normal n there is across the axis, and ``n . (centre + radius n) = 0``.
        """
        centre = self.centre_mm - self.depth_mm / 2 * self.axis
        across = centre - (centre @ self.axis) * self.axis
        size = np.linalg.norm(across)
        if size <= self.radius_mm:
            return None
        toward = across / size
        sideways = np.cross(self.axis, toward)
        cosine = -self.radius_mm / size
        sine = np.sqrt(1 - cosine**2)
        normals = np.stack([cosine * toward - sine * sideways, cosine * toward + sine * sideways])
        return np.asarray(centre + self.radius_mm * normals)

    def _behind(self, camera: Camera, pixels: Array) -> Array:
        """Edge field of the half plane behind the contacts; of the whole picture where there are none."""
        contacts = self._contacts()
        if contacts is None:
            return np.broadcast_to(np.array([-np.inf, 1.0, 0.0]), (*pixels.shape[:2], 3))
        a, b = camera.project(contacts)
        normal = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        tubeward = camera.project(self.centre_mm - (self.depth_mm / 2 + self.radius_mm) * self.axis)
        if (tubeward - a) @ normal > 0:
            normal = -normal
        return np.concatenate([((pixels - a) @ normal)[..., None], np.broadcast_to(normal, pixels.shape)], -1)

    def _outline(self, camera: Camera, pixels: Array) -> Array:
        """Edge field of the convex outline of the last stretch of tube."""
        turn = np.linspace(0, 2 * np.pi, _RIM_CORNERS, endpoint=False)[:, None]
        u = np.cross(self.axis, np.eye(3)[np.argmin(np.abs(self.axis))])
        u /= np.linalg.norm(u)
        rim = self.centre_mm + self.radius_mm * (np.cos(turn) * u + np.sin(turn) * np.cross(self.axis, u))
        rims = camera.project(np.concatenate([rim, rim - self.depth_mm * self.axis]))
        return _polygon_field(cv2.convexHull(rims.astype(np.float32))[:, 0].astype(float), pixels)


def _polygon_field(corners: Array, pixels: Array) -> Array:
    """Edge field (rows, columns, 3) of a convex polygon (N, 2)."""
    start = _split_sides(corners)
    side = np.roll(start, -1, 0) - start
    length = np.linalg.norm(side, axis=1, keepdims=True)
    outward = np.stack([side[:, 1], -side[:, 0]], -1) / length
    # One turning sense for the whole polygon: the sum is positive where the normals point away from the middle.
    outward *= np.sign(((start - start.mean(0)) * outward).sum())
    flat = pixels.reshape(-1, 2)
    after = cKDTree(start).query(flat)[1]
    fields = []
    for near in (after, after - 1):
        from_start = flat - start[near]
        share = np.clip(dot(from_start, side[near]) / length[near, 0] ** 2, 0, 1)
        offset = from_start - share[:, None] * side[near]
        distance = np.sqrt(dot(offset, offset)) * np.where(dot(from_start, outward[near]) > 0, 1, -1)
        fields.append(np.concatenate([distance[:, None], outward[near]], -1))
    nearer = np.abs(fields[0][:, :1]) <= np.abs(fields[1][:, :1])
    return np.where(nearer, *fields).reshape(*pixels.shape[:2], 3)


def _split_sides(corners: Array) -> Array:
    """Insert points into long sides, so that the side nearest to a pixel begins or ends at the nearest point."""
    side = np.roll(corners, -1, 0) - corners
    length = np.linalg.norm(side, axis=1)
    parts = [
        corner + np.linspace(0, 1, int(np.ceil(n / _SIDE_PX)), endpoint=False)[:, None] * along
        for corner, along, n in zip(corners, side, length, strict=True)
    ]
    return np.concatenate(parts)
