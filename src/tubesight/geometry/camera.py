"""One camera: pinhole with skew, and a lens."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from tubesight.core import Array, readonly
from tubesight.geometry.lens import LENSES, undistort


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Pinhole camera with skew and lens distortion; x right, y down, z forwards, pixel centres at integers.

    ``pixel = matrix @ (lens(X / Z, Y / Z), 1)`` (equation 1 of Dalvand et al. 2016 for an ideal lens; the paper's
    skew coefficient is ``matrix[0, 1]``).

    Attributes
    ----------
    matrix
        (3, 3): rows (fx, skew, cx), (0, fy, cy), (0, 0, 1), pixels.
    size_px
        (width, height).
    distortion
        Coefficients in the order of ``LENSES[lens].coefficients``; none means an ideal lens.
    lens
        ``brown`` (k1, k2, p1, p2, k3), ``rational`` or ``equidistant``.
    """

    matrix: Array
    size_px: tuple[int, int]
    distortion: Array = field(default_factory=lambda: np.zeros(5))
    lens: str = "brown"

    def __post_init__(self) -> None:
        matrix = readonly(self.matrix, (3, 3), "camera matrix")
        if self.lens not in LENSES:
            raise ValueError(f"lens: expected one of {', '.join(LENSES)}, got {self.lens!r}")
        count = len(LENSES[self.lens].coefficients)
        distortion = readonly(self.distortion, (count,), f"distortion of a {self.lens} lens")
        if not (np.isfinite(matrix).all() and np.isfinite(distortion).all()):
            raise ValueError("a camera holds a number that is not finite")
        if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
            raise ValueError(f"focal lengths have to be positive, got {matrix[0, 0]} and {matrix[1, 1]}")
        if np.abs(matrix[[1, 2, 2, 2], [0, 0, 1, 2]] - (0, 0, 0, 1)).max() > 1e-9:
            raise ValueError("camera matrix: expected rows (fx, skew, cx), (0, fy, cy), (0, 0, 1)")
        width, height = (int(n) for n in self.size_px)
        if width < 1 or height < 1:
            raise ValueError(f"size_px: expected a positive width and height, got {self.size_px}")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "size_px", (width, height))

    @property
    def focal_px(self) -> float:
        """Geometric mean of the two focal lengths, for turning angles into pixels."""
        return float(np.sqrt(self.matrix[0, 0] * self.matrix[1, 1]))

    def project(self, points_cam_mm: ArrayLike) -> Array:
        """Project points (..., 3) of the camera frame to pixels (..., 2); NaN where the depth is not positive."""
        p = np.asarray(points_cam_mm, float)
        depth = p[..., 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = np.where(depth > 0, p[..., :2] / depth, np.nan)
        return self.pixel_from_plane(LENSES[self.lens].distort(xy, self.distortion))

    def unproject(self, points_px: ArrayLike) -> Array:
        """Undistort pixels (..., 2) to ``v = (x, y, 1)`` (..., 3); NaN where the lens cannot be inverted."""
        q = np.asarray(points_px, float)
        m = self.matrix
        y = (q[..., 1] - m[1, 2]) / m[1, 1]
        x = (q[..., 0] - m[0, 2] - m[0, 1] * y) / m[0, 0]
        xy = undistort(LENSES[self.lens], np.stack([x, y], -1), self.distortion)
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1)

    def pixel_from_plane(self, xy: Array) -> Array:
        """Map the (distorted) image plane (..., 2) to pixels (..., 2)."""
        return np.asarray(xy @ self.matrix[:2, :2].T + self.matrix[:2, 2])

    def contains(self, points_px: ArrayLike, margin_px: float = 0.0) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Tell which pixels (..., 2) lie inside the picture, at least `margin_px` from its border."""
        q = np.asarray(points_px, float)
        high = np.array(self.size_px) - 1 - margin_px
        return np.asarray(((q >= margin_px) & (q <= high)).all(-1))
