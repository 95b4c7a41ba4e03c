"""Conic fits: three ways to put ``v^T C v = 0`` through points of the ideal image plane, behind one signature.

Every fit works in the frame of the points' principal axes, centred and with both axes scaled to unit spread: without it
the arc of a 1 degree bend, a thousand times longer than deep, loses eight digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from tubesight.core import Array, readonly

# Below this ratio of spreads the points are on a line as far as float64 can tell (noise of undistortion is 1e-13).
_LINE_RATIO = 1e-9
# |det| and discriminant of a unit-norm conic in its principal frame under which it counts as degenerate.
_DEGENERATE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Conic:
    """Conic ``v^T C v = 0`` with ``C = frame^T normal frame``.

    The image of a circular arc can be a hyperbola (when the full circle crosses the camera's focal plane), and the image of a
    straight tube is a double line: every kind is legal.

    Attributes
    ----------
    normal
        (3, 3) symmetric, unit Frobenius norm, in the frame of the points' principal axes.
    frame
        (3, 3) affine map from the image plane to that frame.
    """

    normal: Array
    frame: Array

    def __post_init__(self) -> None:
        normal = readonly(self.normal, (3, 3), "conic")
        object.__setattr__(self, "normal", readonly(normal / np.linalg.norm(normal), (3, 3), "conic"))
        object.__setattr__(self, "frame", readonly(self.frame, (3, 3), "frame"))

    @classmethod
    def from_matrix(cls, matrix: Array) -> Conic:
        """Make a conic from its symmetric (3, 3) matrix on the image plane."""
        return cls(matrix, np.eye(3))

    @property
    def matrix(self) -> Array:
        """C (3, 3) on the image plane (equation 2 of Dalvand et al. 2016), unit Frobenius norm."""
        c = self.frame.T @ self.normal @ self.frame
        return np.asarray(c / np.linalg.norm(c))

    @property
    def kind(self) -> str:
        """``ellipse``, ``parabola``, ``hyperbola``, ``line`` (a double line) or ``degenerate`` (a pair of lines, a point)."""
        values = np.abs(np.linalg.eigvalsh(self.normal))
        if np.sort(values)[1] < _DEGENERATE:
            return "line"
        if abs(np.linalg.det(self.normal)) < _DEGENERATE:
            return "degenerate"
        discriminant = np.linalg.det(self.normal[:2, :2])
        if abs(discriminant) < _DEGENERATE:
            return "parabola"
        return "ellipse" if discriminant > 0 else "hyperbola"

    def sampson(self, xy: Array) -> Array:
        """First-order distance of points (N, 2) to the conic, signed, in units of the image plane.

        ``v^T C v / |2 (C v)_xy|`` (Sampson 1982); for a double line the exact distance.
        """
        v = np.column_stack([xy, np.ones(len(xy))]) @ self.frame.T
        cv = v @ self.normal
        gradient = 2 * cv @ self.frame[:, :2]
        value = (v * cv).sum(-1)
        size = np.linalg.norm(gradient, axis=-1)
        if self.kind == "line":
            return np.asarray(np.divide(2 * value, size, out=np.zeros_like(value), where=size > 0))
        return np.asarray(np.divide(value, size, out=np.full_like(value, np.inf), where=size > 0))


ConicFit = Callable[[Array], Conic]


def _principal_frame(xy: Array) -> tuple[Array, bool]:
    """Return the affine frame (3, 3) in which the points have unit spread both ways, and whether they lie on a line."""
    points = readonly(xy, (None, 2), "points")
    if len(points) < 2 or not np.isfinite(points).all():
        raise ValueError(f"a conic fit needs finite points, at least two, got {len(points)}")
    mean = points.mean(0)
    _, spread, axes = np.linalg.svd(points - mean, full_matrices=False)
    if spread[0] == 0:
        raise ValueError("a conic fit needs points that differ")
    line = bool(len(points) < 5 or spread[1] <= _LINE_RATIO * spread[0])
    scale = np.sqrt(len(points)) / np.array([spread[0], spread[0] if line else spread[1]])
    linear = axes * scale[:, None]
    frame = np.eye(3)
    frame[:2, :2] = linear
    frame[:2, 2] = -linear @ mean
    return frame, line


def _to_frame(xy: Array, frame: Array) -> tuple[Array, Array]:
    q = xy @ frame[:2, :2].T + frame[:2, 2]
    return q[:, 0], q[:, 1]


def _symmetric(a: float, b: float, c: float, d: float, e: float, f: float) -> Array:
    """Matrix of ``a x^2 + b x y + c y^2 + d x + e y + f``."""
    return np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]])


# The double line y = 0 of the principal frame: the long axis of the points.
_LONG_AXIS = np.diag([0.0, 1.0, 0.0])


def fit_line(xy: Array) -> Conic:
    """Fit the double line through the points (N, 2): the conic of a straight tube, and the limit of every other fit."""
    frame, _ = _principal_frame(xy)
    return Conic(_LONG_AXIS, frame)


def fit_halir_flusser(xy: Array) -> Conic:
    """Direct least-squares ellipse (Halir & Flusser 1998; Fitzgibbon's constraint ``4 a c - b^2 = 1``).

    The answer is an ellipse whatever the points are; points on a line give the double line.

    Parameters
    ----------
    xy
        (N, 2), N >= 5 for anything but a line.
    """
    frame, line = _principal_frame(xy)
    if line:
        return Conic(_LONG_AXIS, frame)
    x, y = _to_frame(xy, frame)
    quadratic = np.stack([x * x, x * y, y * y], 1)
    linear = np.stack([x, y, np.ones_like(x)], 1)
    s1, s2, s3 = quadratic.T @ quadratic, quadratic.T @ linear, linear.T @ linear
    reduce = -np.linalg.solve(s3, s2.T)
    m = s1 + s2 @ reduce
    m = np.stack([m[2] / 2, -m[1], m[0] / 2])
    _, vectors = np.linalg.eig(m)
    vectors = np.real(vectors)
    condition = 4 * vectors[0] * vectors[2] - vectors[1] ** 2
    best = vectors[:, int(np.argmax(condition))]
    return Conic(_symmetric(*best, *(reduce @ best)), frame)


def fit_taubin(xy: Array) -> Conic:
    """Fit a conic of any kind by Taubin's approximate mean square distance (Taubin 1991).

    Minimises ``sum f^2 / sum |grad f|^2``: a generalised eigenproblem.

    Parameters
    ----------
    xy
        (N, 2), N >= 5 for anything but a line.
    """
    frame, line = _principal_frame(xy)
    if line:
        return Conic(_LONG_AXIS, frame)
    x, y = _to_frame(xy, frame)
    one, zero = np.ones_like(x), np.zeros_like(x)
    # The constant is eliminated: its gradient is zero, so the optimum has mean f = 0.
    design = np.stack([x * x, x * y, y * y, x, y], 1)
    mean = design.mean(0)
    centred = design - mean
    gx = np.stack([2 * x, y, zero, one, zero], 1)
    gy = np.stack([zero, x, 2 * y, zero, one], 1)
    _, _, vt = np.linalg.svd(centred, full_matrices=False)
    if len(x) == 5:
        best = vt[-1]
    else:
        _, vectors = scipy.linalg.eigh(centred.T @ centred, gx.T @ gx + gy.T @ gy)
        best = vectors[:, 0]
        exact = np.linalg.norm(centred @ vt[-1]) <= 1e-7 * np.linalg.norm(centred)
        # On exact points the normal equations square the conditioning; the singular vector does not.
        best = vt[-1] if exact else best
    return Conic(_symmetric(*best, -float(mean @ best)), frame)


def fit_parabola(xy: Array) -> Conic:
    """Fit the parabola ``y = a + b x + c x^2`` over the long principal axis x.

    It is regular for every set of points, a straight one included, and never has a second branch.

    Parameters
    ----------
    xy
        (N, 2), N >= 3.
    """
    frame, line = _principal_frame(xy)
    if line:
        return Conic(_LONG_AXIS, frame)
    x, y = _to_frame(xy, frame)
    (a, b, c), *_ = np.linalg.lstsq(np.stack([np.ones_like(x), x, x * x], 1), y, rcond=None)
    return Conic(_symmetric(c, 0.0, 0.0, b, -1.0, a), frame)


CONIC_FITS: dict[str, ConicFit] = {
    "halir_flusser": fit_halir_flusser,
    "taubin": fit_taubin,
    "parabola": fit_parabola,
    "line": fit_line,
}
