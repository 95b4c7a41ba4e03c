"""Lens models: ideal image plane (x, y) = (X / Z, Y / Z) to the distorted plane, and back.

Each model is OpenCV's, with its order of coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array

_NEWTON_STEPS = 20
# Newton stops where the last step moved no point by more than this on the image plane (1e-12 of a focal length).
_NEWTON_TOLERANCE = 1e-12


@dataclass(frozen=True, slots=True)
class LensModel:
    """A distortion: its names of coefficients and the map from the ideal plane, with derivative.

    ``distort(xy, coefficients)`` maps (..., 2) to (..., 2); `jacobian` returns (..., 2, 2).
    """

    coefficients: tuple[str, ...]
    distort: Callable[[Array, Array], Array]
    jacobian: Callable[[Array, Array], Array]


def _radial_tangential(xy: Array, p1: float, p2: float, radial: Array) -> Array:
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def _radial_tangential_jacobian(xy: Array, p1: float, p2: float, radial: Array, slope: Array) -> Array:
    """Differentiate `_radial_tangential`; `slope` is d radial / d r2."""
    x, y = xy[..., 0], xy[..., 1]
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], -2)


def _poly(r2: Array, a: float, b: float, c: float) -> tuple[Array, Array]:
    return 1 + r2 * (a + r2 * (b + r2 * c)), a + r2 * (2 * b + 3 * c * r2)


def _brown(xy: Array, k: Array) -> Array:
    radial, _ = _poly((xy**2).sum(-1), k[0], k[1], k[4])
    return _radial_tangential(xy, k[2], k[3], radial)


def _brown_jacobian(xy: Array, k: Array) -> Array:
    radial, slope = _poly((xy**2).sum(-1), k[0], k[1], k[4])
    return _radial_tangential_jacobian(xy, k[2], k[3], radial, slope)


def _ratio(xy: Array, k: Array) -> tuple[Array, Array]:
    r2 = (xy**2).sum(-1)
    top, top_slope = _poly(r2, k[0], k[1], k[4])
    bottom, bottom_slope = _poly(r2, k[5], k[6], k[7])
    return top / bottom, (top_slope * bottom - top * bottom_slope) / bottom**2


def _rational(xy: Array, k: Array) -> Array:
    radial, _ = _ratio(xy, k)
    return _radial_tangential(xy, k[2], k[3], radial)


def _rational_jacobian(xy: Array, k: Array) -> Array:
    radial, slope = _ratio(xy, k)
    return _radial_tangential_jacobian(xy, k[2], k[3], radial, slope)


def _equidistant_scale(xy: Array, k: Array) -> tuple[Array, Array]:
    """Return theta_d / r and its derivative by r2 (Kannala-Brandt), with the limits 1 and (k1 - 1/3) at r = 0."""
    r2 = (xy**2).sum(-1)
    near = r2 < 1e-10
    r = np.sqrt(np.where(near, 1.0, r2))
    theta = np.arctan(r)
    t2 = theta**2
    poly = 1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))
    poly_slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
    scale = theta * poly / r
    slope = (poly_slope / (1 + r * r) - scale) / (2 * r * r)
    limit = k[0] - 1 / 3
    return np.where(near, 1 + limit * r2, scale), np.where(near, limit, slope)


def _equidistant(xy: Array, k: Array) -> Array:
    return np.asarray(xy * _equidistant_scale(xy, k)[0][..., None])


def _equidistant_jacobian(xy: Array, k: Array) -> Array:
    scale, slope = _equidistant_scale(xy, k)
    return _radial_tangential_jacobian(xy, 0.0, 0.0, scale, slope)


LENSES: dict[str, LensModel] = {
    "brown": LensModel(("k1", "k2", "p1", "p2", "k3"), _brown, _brown_jacobian),
    "rational": LensModel(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), _rational, _rational_jacobian),
    "equidistant": LensModel(("k1", "k2", "k3", "k4"), _equidistant, _equidistant_jacobian),
}


def undistort(model: LensModel, distorted_xy: Array, coefficients: Array) -> Array:
    """Invert a lens model by Newton's method with step halving.

    Parameters
    ----------
    distorted_xy
        (..., 2) on the distorted image plane.

    Returns
    -------
    Array
        (..., 2) on the ideal plane; NaN where the model cannot be inverted (outside its monotone region).
    """
    xy = distorted_xy.copy()
    if model.coefficients[0] == "k1" and len(model.coefficients) == 4:
        radius = np.linalg.norm(distorted_xy, axis=-1, keepdims=True)
        angle = np.minimum(radius, 1.5)
        xy = np.where(radius > 1e-9, distorted_xy * np.tan(angle) / np.maximum(radius, 1e-9), distorted_xy)
    if not coefficients.any() and len(model.coefficients) != 4:
        return xy
    residual = model.distort(xy, coefficients) - distorted_xy
    for _ in range(_NEWTON_STEPS):
        jacobian = model.jacobian(xy, coefficients)
        determinant = np.linalg.det(jacobian)
        usable = determinant > 1e-9
        safe = np.where(usable[..., None, None], jacobian, np.eye(2))
        step = np.linalg.solve(safe, residual[..., None])[..., 0]
        xy = np.where(usable[..., None], xy - step, np.nan)
        residual = model.distort(xy, coefficients) - distorted_xy
        if not np.nanmax(np.abs(step), initial=0.0) > _NEWTON_TOLERANCE:
            break
    converged = np.abs(residual).max(-1) < 1e-9
    return np.where(converged[..., None], xy, np.nan)
