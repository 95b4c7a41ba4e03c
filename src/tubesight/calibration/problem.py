"""Residuals of a bundle adjustment and their analytic Jacobian over a flat vector of increments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.spatial.transform import Rotation

from tubesight.calibration.scene import POSE, Free, Observation, Prior, Scene, with_lens
from tubesight.core import Array
from tubesight.geometry.camera import Camera
from tubesight.geometry.lens import LENSES
from tubesight.geometry.pose import Pose

# Angle, radians, below which sin and cos of the left Jacobian lose digits; its series is exact there to 1e-13.
_SMALL_ANGLE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """All observations of one camera, stacked: M points, their pixels, deviations and numbers of views."""

    camera: str
    points_mm: Array
    px: Array
    sd_px: Array
    view: NDArray[np.intp]


class Problem:
    """Residuals and Jacobian over a flat vector of increments around a scene.

    The vector holds, per camera, its free lens parameters and pose, then the poses of the free views. Poses move by
    small rotations from the left: ``R = exp([r]) R0``.
    """

    def __init__(
        self, scene: Scene, observations: tuple[Observation, ...], free: Free, priors: tuple[Prior, ...] = ()
    ) -> None:
        self.scene, self.observations, self.free, self.priors = scene, observations, free, priors
        self._columns: dict[tuple[str, str], int] = {}
        for i, name in enumerate(free.rig_names):
            camera, _, parameter = name.rpartition(".")
            self._columns.setdefault((camera, "pose" if parameter in POSE else "lens"), i)
        self._views = list(scene.base_from_view)
        number = {view: i for i, view in enumerate(self._views)}
        first = len(free.rig_names)
        # Column at which the pose of each view of the scene starts; -1 for one that is fixed.
        self._view_column = np.full(len(self._views), -1)
        self._view_column[[number[v] for v in free.views]] = first + 6 * np.arange(len(free.views))
        self._groups: list[_Group] = []
        self._rows: dict[int, slice] = {}
        start = 0
        for camera in dict.fromkeys(o.camera for o in observations):
            own = [(i, o) for i, o in enumerate(observations) if o.camera == camera]
            for i, o in own:
                self._rows[i] = slice(start, start + 2 * len(o.px))
                start += 2 * len(o.px)
            sizes = [len(o.px) for _, o in own]
            self._groups.append(
                _Group(
                    camera,
                    np.concatenate([o.points_mm for _, o in own]),
                    np.concatenate([o.px for _, o in own]),
                    np.repeat([o.sd_px for _, o in own], sizes),
                    np.repeat([number[o.view] for _, o in own], sizes),
                )
            )

    def rows(self, i: int) -> slice:
        """Rows of the residuals that belong to one observation."""
        return self._rows[i]

    def columns(self, i: int) -> tuple[slice, slice]:
        """Columns of the lens parameters and of the view's pose that an observation depends on."""
        o = self.observations[i]
        lens = self._columns.get((o.camera, "lens"), 0)
        view = int(self._view_column[self._views.index(o.view)])
        return slice(lens, lens + len(self.free.lens.get(o.camera, ()))), slice(view, view + 6)

    def split(self, residuals: Array) -> tuple[Array, ...]:
        """Unweighted residuals (N, 2) by observation."""
        return tuple(residuals[self._rows[i]].reshape(-1, 2) * o.sd_px for i, o in enumerate(self.observations))

    def moved(self, x: Array) -> Scene:
        """Return the scene with increments applied."""
        cameras = {name: self._camera(name, x) for name in self.scene.cameras}
        poses = {n: Pose(*self._camera_pose(n, x)) for n in self.scene.camera_from_base}
        rotations, shifts = self._view_poses(x)
        return Scene(cameras, poses, {n: Pose(rotations[i], shifts[i]) for i, n in enumerate(self._views)})

    def residuals(self, x: Array) -> Array:
        """Weighted, flat: measured minus predicted pixel."""
        rotations, shifts = self._view_poses(x)
        parts = []
        for g in self._groups:
            turn, shift = self._camera_pose(g.camera, x)
            base = _turned(rotations[g.view], g.points_mm) + shifts[g.view]
            parts.append(((g.px - self._camera(g.camera, x).project(base @ turn.T + shift)) / g.sd_px[:, None]).ravel())
        for prior in self.priors:
            i = self._views.index(prior.view)
            turn_rad = Rotation.from_matrix(rotations[i]).as_rotvec()
            moved = rotations[i] @ prior.pivot_mm + shifts[i] - prior.pivot_mm
            parts.append(np.concatenate([turn_rad / prior.sd_rad, moved / prior.sd_mm]))
        return np.concatenate(parts)

    def jacobian(self, x: Array) -> csr_array:
        """Differentiate `residuals`: sparse, one block of columns per lens, camera pose and view pose."""
        rotations, shifts = self._view_poses(x)
        turns = _left_jacobian(self._view_increments(x)[:, :3])
        data, rows, columns = [], [], []
        start = 0
        for g in self._groups:
            for place, block in self._blocks(g, rotations, shifts, turns, x):
                at = np.broadcast_to(place[:, None, :], block.shape)
                row = start + np.arange(2 * len(g.px)).reshape(-1, 2, 1)
                free = at >= 0
                data.append((block / -g.sd_px[:, None, None])[free])
                rows.append(np.broadcast_to(row, block.shape)[free])
                columns.append(at[free])
            start += 2 * len(g.px)
        for prior in self.priors:
            block, column = self._by_prior(prior, rotations, turns)
            data.append(block.ravel())
            rows.append(np.repeat(start + np.arange(6), 6))
            columns.append(np.tile(column + np.arange(6), 6))
            start += 6
        entries = (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns)))
        return csr_array(coo_array(entries, shape=(start, self.free.count)))

    def _blocks(
        self, g: _Group, rotations: Array, shifts: Array, turns: Array, x: Array
    ) -> list[tuple[NDArray[np.intp], Array]]:
        """Columns (M, P), -1 where fixed, and derivatives (M, 2, P) of the predicted pixels of one camera."""
        camera = self._camera(g.camera, x)
        turn, shift = self._camera_pose(g.camera, x)
        turned = _turned(rotations[g.view], g.points_mm)
        turned_camera = (turned + shifts[g.view]) @ turn.T
        p = turned_camera + shift
        xy = p[:, :2] / p[:, 2:]
        along = np.zeros((len(p), 2, 3))
        along[:, 0, 0] = along[:, 1, 1] = 1 / p[:, 2]
        along[:, :, 2] = -xy / p[:, 2:]
        by_point = camera.matrix[:2, :2] @ LENSES[camera.lens].jacobian(xy, camera.distortion) @ along
        blocks = []
        names = self.free.lens.get(g.camera, ())
        if names:
            place = self._columns[g.camera, "lens"] + np.arange(len(names))
            blocks.append((np.broadcast_to(place, (len(p), len(names))), _by_lens(camera, xy, names)))
        if (g.camera, "pose") in self._columns:
            first = self._columns[g.camera, "pose"]
            by_turn = by_point @ -_cross(turned_camera) @ _left_jacobian(x[first : first + 3])
            place = np.broadcast_to(first + np.arange(6), (len(p), 6))
            blocks.append((place, np.concatenate([by_turn, by_point], -1)))
        by_base = by_point @ turn
        by_turn = by_base @ -_cross(turned) @ turns[g.view]
        column = self._view_column[g.view][:, None]
        blocks.append((np.where(column >= 0, column + np.arange(6), -1), np.concatenate([by_turn, by_base], -1)))
        return blocks

    def _by_prior(self, prior: Prior, rotations: Array, turns: Array) -> tuple[Array, int]:
        """Differentiate a prior's residuals by its view's increments, (6, 6); also the first of their columns."""
        i = self._views.index(prior.view)
        found = Rotation.from_matrix(rotations[i]).as_rotvec()
        block = np.zeros((6, 6))
        block[:3, :3] = np.linalg.solve(_left_jacobian(found), turns[i]) / prior.sd_rad
        block[3:, :3] = -_cross(rotations[i] @ prior.pivot_mm) @ turns[i] / prior.sd_mm
        block[3:, 3:] = np.eye(3) / prior.sd_mm
        return block, int(self._view_column[i])

    def _view_increments(self, x: Array) -> Array:
        """Increments (V, 6) of all views, 0 for those that are fixed."""
        increments = np.zeros((len(self._views), 6))
        free = self._view_column >= 0
        increments[free] = x[self._view_column[free][:, None] + np.arange(6)]
        return increments

    def _view_poses(self, x: Array) -> tuple[Array, Array]:
        """Rotations (V, 3, 3) and translations (V, 3) of all views."""
        d = self._view_increments(x)
        poses = self.scene.base_from_view.values()
        rotations = Rotation.from_rotvec(d[:, :3]).as_matrix() @ np.stack([p.rotation for p in poses])
        return rotations, np.stack([p.translation_mm for p in poses]) + d[:, 3:]

    def _camera_pose(self, name: str, x: Array) -> tuple[Array, Array]:
        pose = self.scene.camera_from_base[name]
        if (name, "pose") not in self._columns:
            return pose.rotation, pose.translation_mm
        d = x[self._columns[name, "pose"] :][:6]
        return Rotation.from_rotvec(d[:3]).as_matrix() @ pose.rotation, pose.translation_mm + d[3:]

    def _camera(self, name: str, x: Array) -> Camera:
        camera, names = self.scene.cameras[name], self.free.lens.get(name, ())
        if not names:
            return camera
        start = self._columns[name, "lens"]
        change: Mapping[str, float] = dict(zip(names, x[start : start + len(names)].tolist(), strict=True))
        return with_lens(camera, change)


def _turned(rotations: Array, points: Array) -> Array:
    return np.asarray((rotations @ points[..., None])[..., 0])


def _by_lens(camera: Camera, xy: Array, names: tuple[str, ...]) -> Array:
    """Differentiate pixels by parameters of a brown lens, (N, 2, P)."""
    distorted = LENSES["brown"].distort(xy, camera.distortion)
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    one, zero = np.ones_like(x), np.zeros_like(x)
    in_pixels = {
        "f": distorted,
        "fx": distorted * (1, 0),
        "fy": distorted * (0, 1),
        "skew": np.stack([distorted[:, 1], zero], -1),
        "cx": np.stack([one, zero], -1),
        "cy": np.stack([zero, one], -1),
    }
    on_plane = {
        "k1": xy * r2[:, None],
        "k2": xy * r2[:, None] ** 2,
        "k3": xy * r2[:, None] ** 3,
        "p1": np.stack([2 * x * y, r2 + 2 * y * y], -1),
        "p2": np.stack([r2 + 2 * x * x, 2 * x * y], -1),
    }
    to_pixels = camera.matrix[:2, :2].T
    return np.stack([in_pixels[n] if n in in_pixels else on_plane[n] @ to_pixels for n in names], -1)


def _cross(v: Array) -> Array:
    """Matrices (..., 3, 3) with ``_cross(v) @ w = v x w``."""
    m = np.zeros((*v.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return m - np.swapaxes(m, -1, -2)


def _left_jacobian(r: Array) -> Array:
    """Left Jacobian of SO(3), (..., 3, 3): ``exp([r + d]) = exp([J d]) exp([r])`` (Barfoot 2017, eq. 7.77)."""
    angle = np.linalg.norm(r, axis=-1)[..., None, None]
    small = angle < _SMALL_ANGLE
    a = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(a)) / a**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (a - np.sin(a)) / a**3)
    k = _cross(r)
    return np.asarray(np.eye(3) + first * k + second * k @ k)
