"""Residuals of a bundle adjustment and their analytic Jacobian over a flat vector of increments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from tubesight.calibration.scene import POSE, Free, Observation, Scene, with_lens
from tubesight.core import Array
from tubesight.geometry.camera import Camera
from tubesight.geometry.lens import LENSES
from tubesight.geometry.pose import Pose


class Problem:
    """Residuals and Jacobian over a flat vector of increments around a scene.

    The vector holds, per camera, its free lens parameters and pose, then the poses of the free views. Poses move by
    small rotations from the left: ``R = exp([r]) R0``.
    """

    def __init__(self, scene: Scene, observations: tuple[Observation, ...], free: Free) -> None:
        self.scene, self.observations, self.free = scene, observations, free
        self._columns: dict[tuple[str, str], int] = {}
        for i, name in enumerate(free.rig_names):
            camera, _, parameter = name.rpartition(".")
            self._columns.setdefault((camera, "pose" if parameter in POSE else "lens"), i)
        first = len(free.rig_names)
        self._columns |= {(view, "view"): first + 6 * i for i, view in enumerate(free.views)}
        self._weights = np.repeat([1 / o.sd_px for o in observations], [2 * len(o.px) for o in observations])

    def split(self, residuals: Array) -> tuple[Array, ...]:
        """Unweighted residuals (N, 2) by observation."""
        ends = np.cumsum([2 * len(o.px) for o in self.observations])[:-1]
        return tuple(r.reshape(-1, 2) for r in np.split(residuals / self._weights, ends))

    def moved(self, x: Array) -> Scene:
        """Return the scene with increments applied."""
        cameras = {name: self._camera(name, x) for name in self.scene.cameras}
        poses = {n: self._pose(p, (n, "pose"), x) for n, p in self.scene.camera_from_base.items()}
        views = {n: self._pose(p, (n, "view"), x) for n, p in self.scene.base_from_view.items()}
        return Scene(cameras, poses, views)

    def residuals(self, x: Array) -> Array:
        """Weighted, flat: measured minus predicted pixel."""
        scene = self.moved(x)
        flat = np.concatenate([(o.px - scene.project(o)).ravel() for o in self.observations])
        return np.asarray(flat * self._weights)

    def jacobian(self, x: Array) -> csr_array:
        """Differentiate `residuals`: sparse, one block of columns per lens, camera pose and view pose."""
        scene = self.moved(x)
        data: list[Array] = []
        columns: list[NDArray[np.intp]] = []
        counts: list[NDArray[np.intp]] = []
        for o in self.observations:
            blocks, places = [], []
            for key, block in self.blocks(o, scene, x):
                blocks.append(block)
                places.append(np.arange(block.shape[-1]) + self._columns[key])
            rows = np.concatenate(blocks, -1).reshape(2 * len(o.px), -1) / -o.sd_px
            data.append(rows.ravel())
            columns.append(np.tile(np.concatenate(places), len(rows)))
            counts.append(np.full(len(rows), rows.shape[1]))
        pointers = np.concatenate([[0], np.cumsum(np.concatenate(counts))])
        shape = (len(pointers) - 1, self.free.count)
        return csr_array((np.concatenate(data), np.concatenate(columns), pointers), shape=shape)

    def blocks(self, o: Observation, scene: Scene, x: Array) -> list[tuple[tuple[str, str], Array]]:
        """Differentiate the predicted pixels of one observation by each block that is free, (N, 2, P) each."""
        camera, camera_pose = scene.cameras[o.camera], scene.camera_from_base[o.camera]
        view_pose = scene.base_from_view[o.view]
        turned = view_pose.rotate(o.points_mm)
        turned_camera = camera_pose.rotate(turned + view_pose.translation_mm)
        p = turned_camera + camera_pose.translation_mm
        xy = p[:, :2] / p[:, 2:]
        along = np.zeros((len(p), 2, 3))
        along[:, 0, 0] = along[:, 1, 1] = 1 / p[:, 2]
        along[:, :, 2] = -xy / p[:, 2:]
        model = LENSES[camera.lens]
        by_point = camera.matrix[:2, :2] @ model.jacobian(xy, camera.distortion) @ along
        blocks = []
        if (o.camera, "lens") in self._columns:
            blocks.append(((o.camera, "lens"), _by_lens(camera, xy, self.free.lens[o.camera])))
        for key, turn, by_frame in (
            ((o.camera, "pose"), turned_camera, by_point),
            ((o.view, "view"), turned, by_point @ camera_pose.rotation),
        ):
            if key in self._columns:
                start = self._columns[key]
                by_turn = by_frame @ (-_cross(turn)) @ _left_jacobian(x[start : start + 3])
                blocks.append((key, np.concatenate([by_turn, by_frame], -1)))
        return blocks

    def _pose(self, pose: Pose, key: tuple[str, str], x: Array) -> Pose:
        if key not in self._columns:
            return pose
        d = x[self._columns[key] :][:6]
        turn = Rotation.from_rotvec(d[:3]).as_matrix()
        return Pose(turn @ pose.rotation, pose.translation_mm + d[3:])

    def _camera(self, name: str, x: Array) -> Camera:
        camera, names = self.scene.cameras[name], self.free.lens.get(name, ())
        if not names:
            return camera
        start = self._columns[name, "lens"]
        return with_lens(camera, dict(zip(names, x[start : start + len(names)], strict=True)))


def _by_lens(camera: Camera, xy: Array, names: tuple[str, ...]) -> Array:
    """Differentiate pixels by parameters of a brown lens without skew, (N, 2, P)."""
    distorted = LENSES["brown"].distort(xy, camera.distortion)
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    focal = camera.matrix.diagonal()[:2]
    one, zero = np.ones_like(x), np.zeros_like(x)
    columns = {
        "f": distorted,
        "fx": distorted * (1, 0),
        "fy": distorted * (0, 1),
        "cx": np.stack([one, zero], -1),
        "cy": np.stack([zero, one], -1),
        "k1": xy * r2[:, None] * focal,
        "k2": xy * r2[:, None] ** 2 * focal,
        "k3": xy * r2[:, None] ** 3 * focal,
        "p1": np.stack([2 * x * y, r2 + 2 * y * y], -1) * focal,
        "p2": np.stack([r2 + 2 * x * x, 2 * x * y], -1) * focal,
    }
    return np.stack([columns[name] for name in names], -1)


def _cross(v: Array) -> Array:
    """Matrices (N, 3, 3) with ``_cross(v) @ w = v x w``."""
    m = np.zeros((*v.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return m - np.swapaxes(m, -1, -2)


def _left_jacobian(r: Array) -> Array:
    """Left Jacobian of SO(3), (3, 3): ``exp([r + d]) = exp([J d]) exp([r])`` (Barfoot 2017, eq. 7.77)."""
    angle = float(np.linalg.norm(r))
    k = _cross(r)
    if angle < 1e-6:
        return np.eye(3) + k / 2
    a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * k + b * k @ k)
