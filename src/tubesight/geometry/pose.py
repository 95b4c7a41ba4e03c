"""Rigid transforms, named ``a_from_b``, and the rigid registration of point sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tubesight.core import Array, readonly

# Rows written to a file with 6 decimals are orthonormal to about 2e-6; a reflection or a scale is off by far more.
_ROTATION_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Rigid transform ``a_from_b``: ``p_a = rotation @ p_b + translation_mm``.

    Attributes
    ----------
    rotation
        (3, 3), orthonormal, determinant +1. A matrix that is a rotation up to rounding is projected onto SO(3).
    translation_mm
        (3,)

    Raises
    ------
    ValueError
        If the matrix is not a rotation (mirrored, scaled, NaN).
    """

    rotation: Array
    translation_mm: Array

    def __post_init__(self) -> None:
        rotation = readonly(self.rotation, (3, 3), "rotation")
        translation = readonly(self.translation_mm, (3,), "translation_mm")
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            raise ValueError("a pose holds a number that is not finite")
        if np.linalg.det(rotation) < 0:
            raise ValueError("rotation is mirrored (determinant -1); one axis has the wrong sign")
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if off > _ROTATION_TOLERANCE:
            raise ValueError(f"rotation is not orthonormal (off by {off:.2g})")
        u, _, vt = np.linalg.svd(rotation)
        object.__setattr__(self, "rotation", readonly(u @ vt, (3, 3), "rotation"))
        object.__setattr__(self, "translation_mm", translation)

    @classmethod
    def identity(cls) -> Pose:
        """Return the transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """Make a pose from a homogeneous (4, 4) matrix whose last row is (0, 0, 0, 1)."""
        m = readonly(matrix, (4, 4), "pose matrix")
        if not np.allclose(m[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
            raise ValueError(f"pose matrix: expected a last row of (0, 0, 0, 1), got {m[3].tolist()}")
        return cls(m[:3, :3], m[:3, 3])

    @classmethod
    def from_rotvec(cls, rotvec_rad: ArrayLike, translation_mm: ArrayLike) -> Pose:
        """Make a pose from a rotation vector (axis times angle, radians) and a translation."""
        from scipy.spatial.transform import Rotation  # here: importing it takes as long as a first result

        return cls(Rotation.from_rotvec(np.asarray(rotvec_rad, float).reshape(3)).as_matrix(), np.ravel(translation_mm))

    @property
    def matrix(self) -> Array:
        """Homogeneous (4, 4) matrix."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.translation_mm
        return m

    @property
    def rotvec_rad(self) -> Array:
        """Rotation vector (3,), axis times angle."""
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec(), dtype=np.float64)

    def inverse(self) -> Pose:
        """Return ``b_from_a``."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_mm)

    def __matmul__(self, other: Pose) -> Pose:
        """Compose: ``a_from_b @ b_from_c`` is ``a_from_c``."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.translation_mm + self.translation_mm)

    def apply(self, points_mm: ArrayLike) -> Array:
        """Map points (..., 3) from frame b to frame a."""
        return np.asarray(np.asarray(points_mm, float) @ self.rotation.T + self.translation_mm)

    def rotate(self, vectors: ArrayLike) -> Array:
        """Map directions (..., 3) from frame b to frame a."""
        return np.asarray(np.asarray(vectors, float) @ self.rotation.T)


def turn_onto(direction: Array) -> Array:
    """Rotation (3, 3) by the smallest turn that carries +z onto a direction (3,).

    ``R = I + K + K^2 / (1 + c)`` with the cross product matrix K of ``z x t`` and ``c = z . t`` (Rodrigues' formula for
    unit t); straight back is a half turn about x.
    """
    t = direction / np.linalg.norm(direction)
    if not t[2] > -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, 0, t[0]], [0, 0, t[1]], [-t[0], -t[1], 0]])
    return np.asarray(np.eye(3) + k + k @ k / (1 + t[2]))


def register_rigid(points_a_mm: ArrayLike, points_b_mm: ArrayLike) -> Pose:
    """Least-squares rigid transform between paired points.

    Solves ``min sum |a_i - (R b_i + t)|^2`` over rotations R (Kabsch 1976; Umeyama 1991 for the determinant).

    Parameters
    ----------
    points_a_mm, points_b_mm
        (N, 3), N >= 3, not collinear.

    Returns
    -------
    Pose
        ``a_from_b``.

    Raises
    ------
    ValueError
        If fewer than three pairs are given, a point is not finite, or the points lie on a line.
    """
    a, b = readonly(points_a_mm, (None, 3), "points_a_mm"), readonly(points_b_mm, (None, 3), "points_b_mm")
    if len(a) != len(b) or len(a) < 3:
        raise ValueError(f"rigid registration needs at least 3 pairs, got {len(a)} and {len(b)} points")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("rigid registration: a point is not finite")
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((a - mean_a).T @ (b - mean_b))
    if s[1] <= 1e-9 * s[0]:
        raise ValueError("rigid registration: the points lie on a line; spread them out")
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return Pose(rotation, mean_a - rotation @ mean_b)
