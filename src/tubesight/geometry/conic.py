"""Conic fits: three ways to put ``v^T C v = 0`` through points of the ideal image plane, behind one signature.

Every fit works in the frame of the points' principal axes, centred and with both axes scaled to unit spread: without it
the arc of a 1 degree bend, a thousand times longer than deep, loses eight digits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, readonly

# Below this ratio of spreads the points are on a line as far as float64 can tell: the undistorted pixels of a straight
# tube stay below 5e-15, of one a tenth of a picture long below 1e-13. It straightens curves 1e-11 of their length deep.
_LINE_RATIO = 1e-11
# Ratio of singular values under which a direction is empty: exact points give 1e-15, noise of 1e-6 px gives 1e-8.
_EMPTY = 1e-12
# |det| and discriminant of a unit-norm conic in its principal frame under which it counts as degenerate.
_DEGENERATE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Conic:
    """Conic ``v^T C v = 0`` with ``C = frame^T normal frame``.

    The image of a circular arc can be a hyperbola (when the full circle crosses the camera's focal plane), and the
    image of a straight tube is a double line: every kind is legal.

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
        """``ellipse``, ``parabola``, ``hyperbola``, ``line`` (a double line) or ``degenerate`` (two lines, a point)."""
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
    # Copies of one point differ from their mean by its rounding.
    if spread[0] <= 1e-15 * np.sqrt(len(points)) * np.abs(points).max():
        raise ValueError("a conic fit needs points that differ")
    line = bool(spread[1] <= _LINE_RATIO * spread[0])
    scale = np.sqrt(len(points)) / np.array([spread[0], spread[0] if line else spread[1]])
    linear = axes * scale[:, None]
    frame = np.eye(3)
    frame[:2, :2] = linear
    frame[:2, 2] = -linear @ mean
    return frame, line


def _to_frame(xy: Array, frame: Array) -> tuple[Array, Array]:
    q = xy @ frame[:2, :2].T + frame[:2, 2]
    return q[:, 0], q[:, 1]


def _symmetric(coefficients: Array) -> Array:
    """Matrix of ``a x^2 + b x y + c y^2 + d x + e y + f`` from its coefficients (6,)."""
    a, b, c, d, e, f = coefficients
    return np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]])


# The double line y = 0 of the principal frame: the long axis of the points.
_LONG_AXIS = np.diag([0.0, 1.0, 0.0])


def fit_line(xy: Array) -> Conic:
    """Fit the double line through the points (N, 2): the conic of a straight tube, and the limit of every other fit."""
    frame, _ = _principal_frame(xy)
    return Conic(_LONG_AXIS, frame)


def fit_halir_flusser(xy: Array) -> Conic:
    """Direct least-squares ellipse (Halir & Flusser 1998; Fitzgibbon's constraint ``4 a c - b^2 = 1``).

    The answer is an ellipse whatever the points are, a parabola at the limit. Points that fix no conic (on a line, or
    on fewer than five places) give the double line along their long axis.

    Parameters
    ----------
    xy
        (N, 2), finite, N >= 2, not all equal.

    Raises
    ------
    ValueError
        If there are fewer than two points, or they are all equal or not finite.
    """
    frame, line = _principal_frame(xy)
    if line or len(xy) < 5:
        return Conic(_LONG_AXIS, frame)
    x, y = _to_frame(xy, frame)
    quadratic = np.stack([x * x, x * y, y * y], 1)
    linear = np.stack([x, y, np.ones_like(x)], 1)
    # Halir & Flusser eliminate the linear part by their scatter matrix; an orthogonal projection does not
    # square the conditioning. `reduced` is what the linear part cannot explain: S1 - S2 S3^-1 S2^T = reduced^T reduced.
    basis, triangle = np.linalg.qr(linear)
    reduced = quadratic - basis @ (basis.T @ quadratic)
    _, size, vt = np.linalg.svd(reduced, full_matrices=False)
    if size[1] <= _EMPTY * size[0]:
        return Conic(_LONG_AXIS, frame)
    best = vt[2]
    if size[2] > _EMPTY * size[0] or 4 * best[0] * best[2] <= best[1] ** 2:
        m = reduced.T @ reduced
        _, vectors = np.linalg.eig(np.stack([m[2] / 2, -m[1], m[0] / 2]))
        vectors = np.real(vectors)
        best = vectors[:, int(np.argmax(4 * vectors[0] * vectors[2] - vectors[1] ** 2))]
    rest = -np.linalg.solve(triangle, basis.T @ (quadratic @ best))
    return Conic(_symmetric(np.concatenate([best, rest])), frame)


def fit_taubin(xy: Array) -> Conic:
    """Fit a conic of any kind by Taubin's approximate mean square distance (Taubin 1991).

    Minimises ``sum f^2 / sum |grad f|^2``. Points that fix no conic (on a line, or on fewer than five places) give the
    double line along their long axis.

    Parameters
    ----------
    xy
        (N, 2), finite, N >= 2, not all equal.

    Raises
    ------
    ValueError
        If there are fewer than two points, or they are all equal or not finite.
    """
    frame, line = _principal_frame(xy)
    if line or len(xy) < 5:
        return Conic(_LONG_AXIS, frame)
    x, y = _to_frame(xy, frame)
    one, zero = np.ones_like(x), np.zeros_like(x)
    # The constant is eliminated: its gradient is zero, so the optimum has mean f = 0.
    design = np.stack([x * x, x * y, y * y, x, y], 1)
    mean = design.mean(0)
    gradient = np.concatenate([np.stack([2 * x, y, zero, one, zero], 1), np.stack([zero, x, 2 * y, zero, one], 1)])
    # With gradient = Q T the quotient is |centred c|^2 / |T c|^2: a singular value problem, which does not square the
    # conditioning as the generalised eigenproblem of the scatter matrices does.
    _, triangle = np.linalg.qr(gradient)
    _, size, vt = np.linalg.svd(np.linalg.solve(triangle.T, (design - mean).T).T, full_matrices=False)
    if size[3] <= _EMPTY * size[0]:
        return Conic(_LONG_AXIS, frame)
    best = np.linalg.solve(triangle, vt[4])
    return Conic(_symmetric(np.append(best, -mean @ best)), frame)


def fit_parabola(xy: Array) -> Conic:
    """Fit the parabola ``y = a + b x + c x^2`` over the long principal axis x.

    It is regular for every set of points, a straight one included, and never has a second branch.

    Parameters
    ----------
    xy
        (N, 2), finite, N >= 2, not all equal; fewer than three places along the long axis give the double line.

    Raises
    ------
    ValueError
        If there are fewer than two points, or they are all equal or not finite.
    """
    frame, line = _principal_frame(xy)
    if line:
        return Conic(_LONG_AXIS, frame)
    x, y = _to_frame(xy, frame)
    (a, b, c), _, rank, _ = np.linalg.lstsq(np.stack([np.ones_like(x), x, x * x], 1), y, rcond=_EMPTY)
    if rank < 3:
        return Conic(_LONG_AXIS, frame)
    return Conic(_symmetric(np.array([c, 0.0, 0.0, b, -1.0, a])), frame)


CONIC_FITS: dict[str, ConicFit] = {
    "halir_flusser": fit_halir_flusser,
    "taubin": fit_taubin,
    "parabola": fit_parabola,
    "line": fit_line,
}
