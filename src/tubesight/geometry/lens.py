"""Lens models: ideal image plane (x, y) = (X / Z, Y / Z) to the distorted plane, and back.

Each model is OpenCV's, with its order of coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Mask

# Real lenses need 3 to 6 steps; points near the edge of the invertible region halve theirs a few times more.
NEWTON_STEPS = 30
# Residual on the image plane at which the iteration stops: some units in the last place of a coordinate of 1 to 10.
NEWTON_TOLERANCE = 1e-14
# Residual up to which a point counts as inverted: 1e-6 px at a focal length of 1000 px. Points without an inverse stay
# orders of magnitude above it.
INVERTED = 1e-9
# Least determinant of the derivative inside the invertible region: there the picture is squeezed a million to one.
DETERMINANT_MIN = 1e-6
# Angle (86 degrees) up to which the guess of an equidistant lens is exact.
ANGLE_MAX_RAD = 1.5


@dataclass(frozen=True, slots=True)
class LensModel:
    """A distortion: its names of coefficients and the map from the ideal plane, with derivative.

    ``distort(xy, coefficients)`` maps (..., 2) to (..., 2); `jacobian` returns (..., 2, 2); `guess` maps the distorted
    plane (..., 2) to where its inversion starts: the inverse with all coefficients zero.
    """

    coefficients: tuple[str, ...]
    distort: Callable[[Array, Array], Array]
    jacobian: Callable[[Array, Array], Array]
    guess: Callable[[Array], Array] = np.copy


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


def _equidistant_guess(distorted_xy: Array) -> Array:
    """Turn the angle |xy| into its tangent; past 86 degrees go on in proportion."""
    angle = np.minimum(np.linalg.norm(distorted_xy, axis=-1, keepdims=True), ANGLE_MAX_RAD)
    return np.asarray(distorted_xy * np.sinc(angle / np.pi) / np.cos(angle))


LENSES: dict[str, LensModel] = {
    "brown": LensModel(("k1", "k2", "p1", "p2", "k3"), _brown, _brown_jacobian),
    "rational": LensModel(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), _rational, _rational_jacobian),
    "equidistant": LensModel(("k1", "k2", "k3", "k4"), _equidistant, _equidistant_jacobian, _equidistant_guess),
}


def undistort(model: LensModel, distorted_xy: Array, coefficients: Array) -> Array:
    """Invert a lens model by Newton's method with step halving.

    A step that leaves the region where the lens keeps its sense, or does not lower the residual, is halved; where the
    guess itself lies outside that region the way starts on the optical axis, where every lens is regular.

    Parameters
    ----------
    distorted_xy
        (..., 2) on the distorted image plane.

    Returns
    -------
    Array
        (..., 2) on the ideal plane; NaN where the model cannot be inverted (outside its monotone region).
    """
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # far outside the picture; ends as NaN
        xy = model.guess(distorted_xy)
        step, regular, error = _newton(model, xy, distorted_xy, coefficients)
        if not regular.all():
            xy = np.where(regular[..., None], xy, 0.0)
            step, _, error = _newton(model, xy, distorted_xy, coefficients)
        fraction = np.ones_like(error)
        for _ in range(NEWTON_STEPS):
            if not (error > NEWTON_TOLERANCE).any():
                break
            trial = xy - fraction[..., None] * step
            trial_step, regular, trial_error = _newton(model, trial, distorted_xy, coefficients)
            better = regular & (trial_error < error)
            xy, step = np.where(better[..., None], trial, xy), np.where(better[..., None], trial_step, step)
            error = np.where(better, trial_error, error)
            fraction = np.where(better, 1.0, fraction / 2)
    return np.where((error < INVERTED)[..., None], xy, np.nan)


def _newton(model: LensModel, xy: Array, distorted_xy: Array, coefficients: Array) -> tuple[Array, Mask, Array]:
    """Newton step (..., 2) to be subtracted, whether the lens is regular there, and length of the residual (...)."""
    residual = model.distort(xy, coefficients) - distorted_xy
    j = model.jacobian(xy, coefficients)
    determinant = j[..., 0, 0] * j[..., 1, 1] - j[..., 0, 1] * j[..., 1, 0]
    u, v = residual[..., 0], residual[..., 1]
    step = np.stack([j[..., 1, 1] * u - j[..., 0, 1] * v, j[..., 0, 0] * v - j[..., 1, 0] * u], -1)
    # Past the fold one direction of the picture runs backwards (determinant), past a second one both do (trace).
    regular = (determinant > DETERMINANT_MIN) & (j[..., 0, 0] + j[..., 1, 1] > 0)
    return step / determinant[..., None], regular, np.hypot(u, v)
