"""The scene in 3-D: cameras, tube, its uncertainty, the way of the tip."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import viser

from tubesight.core import Array
from tubesight.geometry.curve import Arc, Curve3D
from tubesight.geometry.rig import Rig
from tubesight.outputs.rows import deviation_mm
from tubesight.sensor import Reconstruction

# One unit of the scene: viser's grid, near plane and frusta are made for scenes of a few units.
MM = 0.01
# Points along the tube and around it.
ALONG, AROUND = 48, 16
# The tip's last places, shown as a way.
WAY = 600
_TUBE, _HULL, _WAY = (64, 156, 255), (255, 170, 60), (235, 90, 130)
# Radius that is drawn where the diameter of the tube is not known.
_RADIUS_MM = 2.0


def tube_mesh(curve: Curve3D, radius_mm: Array | float) -> tuple[Array, Any]:
    """Surface of a tube around a curve.

    Parameters
    ----------
    radius_mm
        Scalar or (ALONG,) radius from base to tip.

    Returns
    -------
    vertices_mm, faces
        (ALONG * AROUND + 2, 3), the last two in the middle of both ends, and triangles (F, 3). Rings are turned along
        the curve without a twist: each frame is the last one, with the part along the new tangent taken off.
    """
    s = np.linspace(0.0, curve.length_mm, ALONG)
    points, tangents = curve.at(s), curve.tangent(s)
    across = np.zeros_like(points)
    side = np.eye(3)[int(np.abs(tangents[0]).argmin())]
    for ring, t in zip(across, tangents, strict=True):
        side = side - (side @ t) * t
        side = side / np.linalg.norm(side)
        ring[:] = side
    other = np.cross(tangents, across)
    angle = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    rings = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * other[:, None]
    vertices = points[:, None] + np.broadcast_to(radius_mm, ALONG)[:, None, None] * rings
    k, j = np.meshgrid(np.arange(ALONG - 1), np.arange(AROUND), indexing="ij")
    a, b = k * AROUND + j, k * AROUND + (j + 1) % AROUND
    faces = np.concatenate([np.stack([a, b, a + AROUND], -1), np.stack([b, b + AROUND, a + AROUND], -1)])
    first, last = np.arange(AROUND), (ALONG - 1) * AROUND + np.arange(AROUND)
    start, end = np.full(AROUND, ALONG * AROUND), np.full(AROUND, ALONG * AROUND + 1)
    caps = np.concatenate(
        [np.stack([np.roll(first, -1), first, start], 1), np.stack([last, np.roll(last, -1), end], 1)]
    )
    return np.concatenate([vertices.reshape(-1, 3), points[[0, -1]]]), np.concatenate([faces.reshape(-1, 3), caps])


class Scene3D:
    """Draws results into a viser scene.

    Parameters
    ----------
    server, rig
        Where, and the cameras around it.
    diameter_mm
        Of the tube; None where it is not known.
    """

    def __init__(self, server: viser.ViserServer, rig: Rig, diameter_mm: float | None) -> None:
        self._scene = server.scene
        self._radius_mm = diameter_mm / 2 if diameter_mm is not None else _RADIUS_MM
        self._way: deque[Array] = deque(maxlen=WAY)
        first = rig.camera_from_base[rig.names[0]].inverse()
        self._scene.set_up_direction(tuple(-first.rotation[:, 1]))
        server.scene.add_frame("/base", axes_length=0.4, axes_radius=0.012)
        vertices, faces = tube_mesh(Arc(np.zeros(2), 1.0), 1.0)
        self._tube = server.scene.add_mesh_simple("/tube", vertices * MM, faces, color=_TUBE, visible=False)
        self._hull = server.scene.add_mesh_simple(
            "/uncertainty", vertices * MM, faces, color=_HULL, opacity=0.35, visible=False
        )
        self._look(server, rig)

    def _look(self, server: viser.ViserServer, rig: Rig) -> None:
        """Start with a view of the base from between the first two cameras, from farther away."""
        centres = np.array([rig.centre_mm(name) for name in rig.names[:2]]) * MM
        towards = rig.camera_from_base[rig.names[0]].inverse().rotation[:, 2]
        target = np.zeros(3) if rig.registered else centres[0] + towards * np.linalg.norm(centres[0] - centres[1])
        server.initial_camera.position = tuple(target + 2.0 * (centres.mean(0) - target) + 1e-3)
        server.initial_camera.look_at = tuple(target)

    def show(self, result: Reconstruction, enlarge: float | None) -> None:
        """Show a result; nothing of an old one stays where the new one failed, but for the way of the tip.

        Parameters
        ----------
        enlarge
            How many times two deviations are drawn beyond the tube's surface; None leaves them out.
        """
        curve = result.curve
        shown = curve is not None and result.shape is not None
        self._tube.visible = shown
        self._hull.visible = shown and enlarge is not None
        if curve is None or result.shape is None:
            return
        vertices, _ = tube_mesh(curve, self._radius_mm)
        self._tube.vertices = (vertices * MM).astype(np.float32)
        self._way.append(result.shape.tip_mm * MM)
        if enlarge is not None:
            sd = np.nan_to_num(deviation_mm(curve, np.linspace(0.0, 1.0, ALONG)))
            vertices, _ = tube_mesh(curve, self._radius_mm + 2 * enlarge * sd)
            self._hull.vertices = (vertices * MM).astype(np.float32)

    def forget(self) -> None:
        """Begin the way of the tip anew."""
        self._way.clear()

    def show_way(self) -> None:
        """Show the last places of the tip."""
        if len(self._way) > 1:
            way = np.array(self._way)
            segments = np.stack([way[:-1], way[1:]], 1)
            self._scene.add_line_segments("/way", segments, _WAY, thickness=2.0, thickness_units="screen")
