"""Bundle adjustment: lenses, camera poses and board poses from the corners of all pictures at once.

Solves ``min sum rho(|pixel - project(camera, camera_from_base @ base_from_board @ point)|^2)`` with scipy's trust region
method, a soft L1 loss and the analytic Jacobian. Poses move by small rotations from the left: ``R = exp([r]) R0``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import least_squares
from scipy.sparse import csr_array
from scipy.sparse.linalg import aslinearoperator
from scipy.spatial.transform import Rotation

from tubesight.core import Array, readonly
from tubesight.geometry.camera import Camera
from tubesight.geometry.lens import LENSES
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import RigCovariance

POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
# Coefficients of the brown lens that a calibration can free, in the lens's order.
_BROWN = LENSES["brown"].coefficients
# Soft L1 turns linear at this many standard deviations: it costs a normal residual less than 2 % of its weight on
# average and caps the pull of a corner on a glare or a finger.
_ROBUST_SIGMAS = 3.0
# A mean residual below this is rounding: the loss must not turn linear within it (synthetic, noise-free corners).
_MIN_SIGMA_PX = 1e-3
# Relative to the diagonal of the normal equations: lets the whitening pass where a parameter is not fixed by the data.
_RIDGE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Known points seen in one picture.

    Attributes
    ----------
    camera
        Name of the camera.
    view
        Name of the frame the points are given in; views share their pose between cameras.
    points_mm
        (N, 3), frame of the view.
    px
        (N, 2)
    sd_px
        Standard deviation of a coordinate relative to that of the other observations.
    """

    camera: str
    view: str
    points_mm: Array
    px: Array
    sd_px: float = 1.0

    def __post_init__(self) -> None:
        points = readonly(self.points_mm, (None, 3), "points_mm")
        object.__setattr__(self, "points_mm", points)
        object.__setattr__(self, "px", readonly(self.px, (len(points), 2), "px"))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a bundle adjustment moves.

    Attributes
    ----------
    cameras, camera_from_base
        By camera name.
    base_from_view
        By name of the view; a view is a board's or, once registered, the base frame itself.
    """

    cameras: Mapping[str, Camera]
    camera_from_base: Mapping[str, Pose]
    base_from_view: Mapping[str, Pose]

    def __post_init__(self) -> None:
        for name in ("cameras", "camera_from_base", "base_from_view"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def project(self, observation: Observation) -> Array:
        """Pixels (N, 2) at which the points of an observation should appear."""
        pose = self.camera_from_base[observation.camera] @ self.base_from_view[observation.view]
        return self.cameras[observation.camera].project(pose.apply(observation.points_mm))


@dataclass(frozen=True, slots=True)
class Free:
    """What may move: names of lens parameters by camera, cameras whose pose moves, views whose pose moves."""

    lens: Mapping[str, tuple[str, ...]]
    cameras: tuple[str, ...] = ()
    views: tuple[str, ...] = ()

    @property
    def rig_names(self) -> tuple[str, ...]:
        """Names of the rig's free parameters, ``camera.parameter``, in the order of the Jacobian's first columns."""
        names: list[str] = []
        for camera in dict.fromkeys([*self.lens, *self.cameras]):
            names += [f"{camera}.{p}" for p in self.lens.get(camera, ())]
            names += [f"{camera}.{p}" for p in POSE] if camera in self.cameras else []
        return tuple(names)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return len(self.rig_names) + 6 * len(self.views)


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """A solved bundle adjustment.

    Attributes
    ----------
    scene
        The solution.
    residuals_px
        Measured minus predicted pixel (N, 2), one array an observation.
    sigma_px
        Robust standard deviation of a coordinate (for an observation of ``sd_px`` 1).
    covariance
        Of the rig's parameters, scaled by the residual variance; None where nothing of the rig was free.
    """

    scene: Scene
    observations: tuple[Observation, ...]
    residuals_px: tuple[Array, ...]
    sigma_px: float
    covariance: RigCovariance | None

    @property
    def rms_px(self) -> float:
        """Root mean square distance between measured and predicted corner."""
        return rms(self.residuals_px)


def rms(residuals_px: Sequence[Array]) -> float:
    """Root mean square length of residuals (N, 2)."""
    return float(np.sqrt(np.mean(np.concatenate([(r**2).sum(1) for r in residuals_px])))) if residuals_px else 0.0


def adjust(scene: Scene, observations: Sequence[Observation], free: Free, *, robust: bool = True) -> Adjusted:
    """Adjust everything that is free to all observations.

    Parameters
    ----------
    scene
        Start; every camera and view of the observations has a pose in it.
    robust
        Soft L1 loss at three standard deviations of the residuals; else plain least squares.

    Returns
    -------
    Adjusted
        The solution with its residuals and, for what is free of the rig, the covariance.
    """
    problem = _Problem(_constrained(scene, free), tuple(observations), free)
    # The scale of the loss follows the residuals: the first pass starts from a rough guess of it, the second is final.
    for _ in range(2 if robust else 1):
        problem = _Problem(problem.moved(_solve(problem, robust)), problem.observations, free)
    residuals = problem.residuals(np.zeros(free.count))
    sigma = _sigma(residuals)
    return Adjusted(
        problem.scene,
        problem.observations,
        problem.split(residuals),
        sigma,
        _covariance(problem, residuals, sigma if robust else None) if free.rig_names else None,
    )


def _solve(problem: _Problem, robust: bool) -> Array:
    """Increments that minimise the loss.

    The parameters are whitened by the Cholesky factor of the first normal equations: the Jacobian becomes nearly
    orthonormal, so that LSMR needs a few products with the sparse Jacobian where a dense step needs its singular value
    decomposition (measured on 32 pictures of 54 corners: 0.1 s instead of 0.4 to 0.9 s).
    """
    start = np.zeros(problem.free.count)
    residuals, jacobian = problem.residuals(start), problem.jacobian(start)
    normal = (jacobian.T @ jacobian).toarray()
    scale = 1 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    factor = cholesky(normal * scale * scale[:, None] + _RIDGE * np.eye(len(start)), lower=True)
    whiten = scale[:, None] * solve_triangular(factor, np.eye(len(start)), lower=True).T
    # In these units the first step is at most 1 long, which is the size of scipy's first trust region.
    whiten *= max(float(np.linalg.norm(residuals)), 1e-9)
    operator = aslinearoperator(whiten)
    result = least_squares(
        lambda y: problem.residuals(whiten @ y),
        start,
        jac=lambda y: aslinearoperator(problem.jacobian(whiten @ y)) @ operator,
        loss="soft_l1" if robust else "linear",
        f_scale=_ROBUST_SIGMAS * _sigma(residuals) if robust else 1.0,
        # Corners are known to 0.01 px at best: a relative change of the cost below 1e-9 moves nothing by that much.
        ftol=1e-9,
        xtol=1e-9,
        gtol=1e-12,
        max_nfev=60,
        tr_options={"atol": 1e-9, "btol": 1e-9},
    )
    return np.asarray(whiten @ result.x)


def _sigma(residuals: Array) -> float:
    """Robust standard deviation of residuals."""
    # 1.4826 turns the median absolute deviation of a normal distribution into its standard deviation.
    return max(1.4826 * float(np.median(np.abs(residuals))), _MIN_SIGMA_PX)


def _weights(residuals: Array, sigma: float) -> Array:
    """Weights that soft L1 gives to the squares of residuals (its derivative)."""
    return np.asarray((1 + (residuals / (_ROBUST_SIGMAS * sigma)) ** 2) ** -0.5)


def _constrained(scene: Scene, free: Free) -> Scene:
    """Let the start obey the lens model: one focal length where ``f`` is free, no k3 where it is not."""
    cameras = dict(scene.cameras)
    for name, names in free.lens.items():
        camera = cameras[name]
        matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
        if "f" in names:
            matrix[0, 0] = matrix[1, 1] = camera.focal_px
        if names and "k3" not in names:
            distortion[_BROWN.index("k3")] = 0.0
        cameras[name] = Camera(matrix, camera.size_px, distortion, camera.lens)
    return Scene(cameras, scene.camera_from_base, scene.base_from_view)


def _covariance(problem: _Problem, residuals: Array, sigma: float | None) -> RigCovariance:
    """Invert the weighted normal equations, scaled by the residual variance; board poses are marginalised."""
    jacobian = problem.jacobian(np.zeros(problem.free.count))
    weight = np.ones_like(residuals) if sigma is None else _weights(residuals, sigma)
    normal = (jacobian.T @ (jacobian * weight[:, None])).toarray()
    variance = float((weight * residuals**2).sum() / max(weight.sum() - problem.free.count, 1.0))
    scale = 1 / np.sqrt(np.maximum(normal.diagonal(), 1e-300))
    inverse = np.linalg.pinv(normal * scale * scale[:, None], hermitian=True) * scale * scale[:, None]
    count = len(problem.free.rig_names)
    return RigCovariance(problem.free.rig_names, variance * inverse[:count, :count])


def linearised(adjusted: Adjusted, lens: Mapping[str, tuple[str, ...]]) -> list[tuple[Array, Array, Array]]:
    """Derivatives of the predicted pixels at a solution, weighted as the robust loss does.

    Returns
    -------
    list
        Per observation: derivatives by its camera's lens parameters (2 N, P) and by its view's pose (2 N, 6), and the
        residuals (2 N,).
    """
    problem = _Problem(adjusted.scene, adjusted.observations, Free(lens, (), tuple(adjusted.scene.base_from_view)))
    rows = []
    for o, residuals in zip(adjusted.observations, adjusted.residuals_px, strict=True):
        r = residuals.ravel() / o.sd_px
        root = np.sqrt(_weights(r, adjusted.sigma_px))
        blocks = dict(problem.blocks(o, adjusted.scene, np.zeros(problem.free.count)))
        by_lens, by_view = (
            blocks[key].reshape(len(r), -1) / o.sd_px * root[:, None] for key in ((o.camera, "lens"), (o.view, "view"))
        )
        rows.append((by_lens, by_view, r * root))
    return rows


class _Problem:
    """Residuals and Jacobian over a flat vector of increments around a scene."""

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
        return np.concatenate([(o.px - scene.project(o)).ravel() for o in self.observations]) * self._weights

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
        """Derivatives (N, 2, P) of the predicted pixels of one observation by each block that is free."""
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


def with_lens(camera: Camera, change: Mapping[str, float]) -> Camera:
    """Add changes to lens parameters (``f`` moves both focal lengths)."""
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    places = {"fx": [(0, 0)], "fy": [(1, 1)], "f": [(0, 0), (1, 1)], "cx": [(0, 2)], "cy": [(1, 2)]}
    for name, step in change.items():
        for place in places.get(name, ()):
            matrix[place] = max(matrix[place] + step, 1e-6)
        if name in _BROWN:
            distortion[_BROWN.index(name)] += step
    return Camera(matrix, camera.size_px, distortion, camera.lens)


def _by_lens(camera: Camera, xy: Array, names: tuple[str, ...]) -> Array:
    """Derivatives (N, 2, P) of pixels by lens parameters of a brown lens without skew."""
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
    """Left Jacobian of SO(3), (3, 3): ``exp([r + d]) = exp([J d]) exp([r])`` to first order (Barfoot 2017, eq. 7.77)."""
    angle = float(np.linalg.norm(r))
    k = _cross(r)
    if angle < 1e-6:
        return np.eye(3) + k / 2
    a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * k + b * k @ k)
