"""The cameras in the scene: a pyramid with the live picture, on which a place can be clicked."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import viser
from viser.transforms import SO3

from tubesight.apps.viewer.scene import MM
from tubesight.core import Array, Image
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# Pictures in the scene are this wide, and as far before their cameras as this share of the distance to the base.
_PICTURE_PX, _DEPTH_SHARE = 480, 0.25
# Depth where the base is not known, mm.
_DEPTH_MM = 60.0
_COLOUR = (120, 120, 130)

Click = Callable[[str, Array], None]


class Cameras:
    """Pyramids and pictures of a rig's cameras.

    Parameters
    ----------
    server, rig
        Where, and which.
    on_click
        Called with the camera's name and the pixel (2,) that was clicked.
    """

    def __init__(self, server: viser.ViserServer, rig: Rig, on_click: Click) -> None:
        self._pictures = {name: _Plane(server, rig, name, on_click) for name in rig.names}

    def show(self, name: str, picture: Image) -> None:
        """Show a camera's picture (BGR or gray)."""
        self._pictures[name].show(shrunk(picture, _PICTURE_PX))


class _Plane:
    """A camera's picture on a plane before it: pixel (u, v) lies at ``depth K^-1 (u, v, 1)`` of the camera's frame."""

    def __init__(self, server: viser.ViserServer, rig: Rig, name: str, on_click: Click) -> None:
        self._scene, self._name, self._on_click = server.scene, name, on_click
        self._camera, self._base_from_camera = rig.cameras[name], rig.camera_from_base[name].inverse()
        distance = float(np.linalg.norm(rig.centre_mm(name))) if rig.registered else 0.0
        self._depth = _DEPTH_SHARE * distance or _DEPTH_MM
        self._corners = plane_corners(self._camera) * self._depth
        self._picture: viser.ImageHandle | None = None
        self._add_pyramid()

    def _add_pyramid(self) -> None:
        corners, path = self._corners, f"/cameras/{self._name}"
        pose = self._base_from_camera
        wxyz = tuple(SO3.from_matrix(pose.rotation).wxyz.tolist())
        edges, rays = np.stack([corners, np.roll(corners, -1, axis=0)], 1), np.stack([np.zeros((4, 3)), corners], 1)
        self._scene.add_frame(path, wxyz=wxyz, position=tuple(pose.translation_mm * MM), show_axes=False)
        lines = np.concatenate([edges, rays]) * MM
        self._scene.add_line_segments(f"{path}/lines", lines, _COLOUR, thickness=1.5, thickness_units="screen")
        self._scene.add_label(f"{path}/name", self._name)

    def show(self, picture: Image) -> None:
        """Show a picture (RGB)."""
        if self._picture is not None:
            self._picture.image = picture
            return
        width, height, _ = (self._corners[2] - self._corners[0]) * MM
        middle = self._corners.mean(0) * MM
        self._picture = self._scene.add_image(
            f"/cameras/{self._name}/picture", picture, width, height, format="jpeg", jpeg_quality=80, position=middle
        )
        self._picture.on_click(self._clicked)

    def _clicked(self, event: viser.SceneNodePointerEvent[viser.ImageHandle]) -> None:
        origin_mm, direction = np.array(event.ray_origin) / MM, np.array(event.ray_direction)
        px = clicked_px(self._camera, self._base_from_camera, self._depth, origin_mm, direction)
        if px is not None:
            self._on_click(self._name, px)


def plane_corners(camera: Camera) -> Array:
    """Corners (4, 3) of a camera's picture at depth 1, clockwise from the upper left."""
    width, height = camera.size_px
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1.0]]) - [0.5, 0.5, 0]
    rays = np.linalg.solve(camera.matrix, pixels.T).T
    return np.asarray(rays / rays[:, 2:])


def clicked_px(
    camera: Camera, base_from_camera: Pose, depth: float, origin_mm: Array, direction: Array
) -> Array | None:
    """Pixel (2,) where a ray of the scene meets a camera's picture; None where it does not.

    Parameters
    ----------
    depth
        Of the picture's plane before the camera, mm.
    origin_mm, direction
        (3,) of the ray, in the base frame.
    """
    pose = base_from_camera.inverse()
    start, way = pose.apply(origin_mm), pose.rotate(direction)
    if not abs(way[2]) > 0:
        return None
    point = start + way * (depth - start[2]) / way[2]
    pixel = camera.matrix @ (point / depth)
    width, height = camera.size_px
    inside = -0.5 <= pixel[0] <= width - 0.5 and -0.5 <= pixel[1] <= height - 0.5
    return pixel[:2] if inside else None


def shrunk(picture: Image, width_px: int) -> Image:
    """Shrink a picture (BGR or gray) to a width and turn it into RGB."""
    height = max(round(picture.shape[0] * width_px / picture.shape[1]), 1)
    small = cv2.resize(picture, (width_px, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2RGB if small.ndim == 2 else cv2.COLOR_BGR2RGB), np.uint8)
