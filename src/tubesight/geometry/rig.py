"""Cameras that look at one base frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from tubesight.core import Array, readonly, sealed
from tubesight.geometry.camera import Camera
from tubesight.geometry.lens import LENSES
from tubesight.geometry.pose import Pose

# Least share of information across the rays that there has to be along them: the square of an angle of 1e-6 rad.
PARALLEL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class RigCovariance:
    """Covariance of calibrated parameters.

    Attributes
    ----------
    names
        Ordered names ``camera.parameter``: ``left.f`` (or ``left.fx, left.fy``), ``left.cx``, ``left.cy``,
        ``left.k1`` ..., and ``left.rx, ry, rz`` (radians, a small rotation applied to the left of
        ``camera_from_base``: ``R = exp([r]) R0``) and ``left.tx, ty, tz`` (mm).
    matrix
        (P, P), gauge: the base frame.
    """

    names: tuple[str, ...]
    matrix: Array

    def __post_init__(self) -> None:
        n = len(self.names)
        object.__setattr__(self, "matrix", readonly(self.matrix, (n, n), "rig covariance"))


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Named cameras with their poses in the base frame.

    Attributes
    ----------
    cameras
        By name, in the order of the file.
    camera_from_base
        By name; cameras whose pose is not known yet are absent.
    base_frame
        ``clamp`` once registered; before, the name of the camera whose frame stands in for the base frame.
    covariance
        Covariance of the parameters, where the calibration gave one.
    """

    cameras: Mapping[str, Camera]
    camera_from_base: Mapping[str, Pose]
    base_frame: str = "clamp"
    covariance: RigCovariance | None = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("a rig needs at least one camera")
        unknown = set(self.camera_from_base) - set(self.cameras)
        if unknown:
            raise ValueError(f"poses of cameras that the rig does not have: {', '.join(sorted(unknown))}")
        object.__setattr__(self, "cameras", MappingProxyType(dict(self.cameras)))
        object.__setattr__(self, "camera_from_base", MappingProxyType(dict(self.camera_from_base)))

    @property
    def names(self) -> tuple[str, ...]:
        """Camera names in order."""
        return tuple(self.cameras)

    @property
    def registered(self) -> bool:
        """Whether the base frame is that of the tube's clamp."""
        return self.base_frame == "clamp"

    def centre_mm(self, name: str) -> Array:
        """Centre of projection of a camera in the base frame, (3,)."""
        pose = self.camera_from_base[name]
        return sealed(-pose.translation_mm @ pose.rotation)

    def project(self, name: str, points_mm: ArrayLike) -> Array:
        """Project points (..., 3) of the base frame to pixels (..., 2) of one camera."""
        return self.cameras[name].project(self.camera_from_base[name].apply(points_mm))

    def directions(self, name: str, rays: ArrayLike) -> Array:
        """Turn camera rays (..., 3) into unit directions of the base frame."""
        d = np.asarray(rays, float) @ self.camera_from_base[name].rotation
        return np.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True))

    def relative_pose(self, a: str, b: str) -> Pose:
        """Return ``a_from_b`` between two cameras."""
        return self.camera_from_base[a] @ self.camera_from_base[b].inverse()

    def essential(self, a: str, b: str) -> Array:
        """Essential matrix E (3, 3) with ``v_a^T E v_b = 0`` for images of one point."""
        pose = self.relative_pose(a, b)
        x, y, z = pose.translation_mm
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.asarray(cross @ pose.rotation)

    def perturbed(self, name: str, delta: float) -> Rig:
        """Rig with one parameter of `RigCovariance` moved by `delta` (px, coefficient, rad or mm)."""
        camera_name, parameter = name.rsplit(".", 1)
        camera, pose = self.cameras[camera_name], self.camera_from_base.get(camera_name)
        matrix, distortion = np.array(camera.matrix), np.array(camera.distortion)
        places = {
            "f": ((0, 0), (1, 1)),
            "fx": ((0, 0),),
            "fy": ((1, 1),),
            "cx": ((0, 2),),
            "cy": ((1, 2),),
            "skew": ((0, 1),),
        }
        coefficients = LENSES[camera.lens].coefficients
        if parameter in places:
            scale = matrix[1, 1] / matrix[0, 0]
            for place in places[parameter]:
                matrix[place] += delta * (scale if parameter == "f" and place == (1, 1) else 1.0)
        elif parameter in coefficients:
            distortion[coefficients.index(parameter)] += delta
        elif pose is not None and parameter in ("rx", "ry", "rz", "tx", "ty", "tz"):
            step = np.zeros(6)
            step[("rx", "ry", "rz", "tx", "ty", "tz").index(parameter)] = delta
            turned = Pose.from_rotvec(step[:3], np.zeros(3)).rotation @ pose.rotation
            pose = Pose(turned, pose.translation_mm + step[3:])
        else:
            raise ValueError(f"a rig of cameras {', '.join(self.cameras)} has no parameter {name!r}")
        cameras = {**self.cameras, camera_name: Camera(matrix, camera.size_px, distortion, camera.lens)}
        poses = {**self.camera_from_base, **({camera_name: pose} if pose is not None else {})}
        return Rig(cameras, poses, self.base_frame, self.covariance)

    def triangulate(self, rays: Mapping[str, ArrayLike]) -> Array:
        """Points nearest to corresponding rays of two or more cameras.

        Starts from the point of least squared distance to the rays and refines the reprojection error on the ideal
        image planes, scaled by each focal length, with Gauss-Newton steps.

        Parameters
        ----------
        rays
            By camera name: (N, 3) rays ``v = (x, y, 1)``; a row of NaN where a camera does not see the point.

        Returns
        -------
        Array
            (N, 3) base frame; NaN where fewer than two cameras see the point, or its rays are parallel or do not meet
            in front of the cameras.
        """
        names = list(rays)
        v = np.stack([np.asarray(rays[n], float) for n in names])
        seen = np.isfinite(v).all(-1)
        poses = [self.camera_from_base[n] for n in names]
        rotation = np.stack([p.rotation for p in poses])
        translation = np.stack([p.translation_mm for p in poses])
        weight = np.array([self.cameras[n].focal_px for n in names])[:, None] * seen
        directions = np.stack([self.directions(n, r) for n, r in zip(names, np.nan_to_num(v, nan=1.0), strict=True)])
        centres = np.stack([self.centre_mm(n) for n in names])
        across = (np.eye(3) - directions[..., :, None] * directions[..., None, :]) * seen[..., None, None]
        normal = across.sum(0)
        right = np.einsum("cnij,cj->ni", across, centres)
        usable = (seen.sum(0) >= 2) & (np.linalg.eigvalsh(normal)[:, 0] > PARALLEL)
        points = np.full((v.shape[1], 3), np.nan)
        points[usable] = np.linalg.solve(normal[usable], right[usable][..., None])[..., 0]
        for _ in range(3):
            local = np.einsum("cij,nj->cni", rotation, points) + translation[:, None]
            z = local[..., 2]
            residual = (local[..., :2] / z[..., None] - v[..., :2]) * weight[..., None]
            rows = (
                (rotation[:, None, :2, :] - (local[..., :2] / z[..., None])[..., None] * rotation[:, None, 2:, :])
                / z[..., None, None]
                * weight[..., None, None]
            )
            residual, rows = np.where(seen[..., None], residual, 0.0), np.where(seen[..., None, None], rows, 0.0)
            hessian = np.einsum("cnki,cnkj->nij", rows, rows)
            gradient = np.einsum("cnki,cnk->ni", rows, residual)
            spread = np.linalg.eigvalsh(np.where(usable[:, None, None], hessian, 0.0))
            usable &= ((z > 0) | ~seen).all(0) & (spread[:, 0] > PARALLEL * spread[:, 2])
            points[usable] -= np.linalg.solve(hessian[usable], gradient[usable][..., None])[..., 0]
        return np.where(usable[:, None], points, np.nan)
