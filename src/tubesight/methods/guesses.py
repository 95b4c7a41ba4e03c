"""First guesses of families from the fits of others, and what a fit tells of how a tube bends."""

from __future__ import annotations

import math

import numpy as np

from tubesight.core import Array
from tubesight.geometry.families import BASIS_ENDS, INTERVALS, Family, bends_of_pieces, ellipse_like, spatial_like
from tubesight.methods.fit import Fit
from tubesight.methods.general import turns_by

# Largest bending out of the plane, and back in it, of a curve that bends once, as shares of the largest bending: both
# are smaller on 149 of 154 ellipses, 2 of 79 S-shapes and robots of two segments and none of 34 of three.
_OUT_OF_PLANE, _BACK = 0.25, 0.15
# Neighbouring pieces whose curvatures differ by less than this share of the largest may be one.
_ALIKE = 0.3


def bends_once(fit: Fit) -> bool:
    """Whether a polynomial or a chain of pieces bends in one plane and to one side, nearly."""
    if fit.family.name.startswith("arcs"):
        bending = fit.parameters[: 2 * (fit.family.count // 3)].reshape(-1, 2)
    else:
        coefficients, _ = _coefficients(fit)
        bending = BASIS_ENDS[: len(coefficients), :: INTERVALS // 2].T @ coefficients
    way, out = _plane_of(bending)
    low, high = sorted([float((bending @ way).min()), float((bending @ way).max())], key=abs)
    return out <= _OUT_OF_PLANE and low * math.copysign(1.0, high) >= -_BACK * abs(high)


def _coefficients(fit: Fit) -> tuple[Array, float]:
    """Coefficients (K, 2) of the curvatures of a polynomial, in a plane or in space, and the length of its curve.

    Those of pieces are of a polynomial of degree 2 that turns like them.
    """
    p = fit.parameters[: fit.family.count]
    if fit.family.name.startswith("polynomial"):
        return np.outer(p[1:-1], [np.cos(p[0]), np.sin(p[0])]), float(p[-1])
    if fit.family.name.startswith("arcs"):
        p = spatial_like(turns_by(fit), p[-1], 3)
    return p[:-1].reshape(-1, 2), float(p[-1])


def smooth_like(rough: Fit, family: Family) -> Array:
    """First guess of a polynomial in space: another one with fewer coefficients."""
    coefficients, length = _coefficients(rough)
    guess = np.zeros(family.count)
    guess[: coefficients.size], guess[-1] = coefficients.ravel(), length
    return np.append(guess, rough.parameters[rough.family.count :])


def pieces_like(smooth: Fit, family: Family) -> Array:
    """First guess of a chain of arcs: equal pieces that turn as much as those of a polynomial in space."""
    coefficients, length = _coefficients(smooth)
    count = family.count // 3
    bends, base = bends_of_pieces(coefficients, count), smooth.parameters[smooth.family.count :]
    return np.concatenate([bends.ravel(), np.zeros(count - 1), [length], base])


def merged_pieces(pieces: Fit) -> Array | None:
    """First guess of a chain of one piece less, the two neighbours most alike made one; None where none are alike."""
    count = pieces.family.count // 3
    bends = pieces.parameters[: 2 * count].reshape(count, 2)
    share = np.exp(np.append(pieces.parameters[2 * count : 3 * count - 1], 0.0))
    curvature = bends / share[:, None]
    apart = np.sqrt((np.diff(curvature, axis=0) ** 2).sum(1))
    k = int(apart.argmin())
    if apart[k] > _ALIKE * np.sqrt((curvature**2).sum(1).max()):
        return None
    bends, share = (np.add.reduceat(each, np.delete(np.arange(count), k + 1)) for each in (bends, share))
    return np.concatenate([bends.ravel(), np.log(share[:-1] / share[-1]), pieces.parameters[3 * count - 1 :]])


def _plane_of(coefficients: Array) -> tuple[Array, float]:
    """Direction (2,) of the plane that holds most of bend vectors or coefficients (K, 2), and the share that leaves it.

    The axes of their moments ``C^T C``: the angle of the larger one is ``atan2(2 xy, xx - yy) / 2``.
    """
    (xx, xy), (_, yy) = (coefficients.T @ coefficients).tolist()
    spread, angle = math.hypot(xx - yy, 2 * xy), math.atan2(2 * xy, xx - yy) / 2
    most, least = xx + yy + spread, max(xx + yy - spread, 0.0)
    return np.array([math.cos(angle), math.sin(angle)]), math.sqrt(least / most) if most > 0 else 0.0


def plane_like(smooth: Fit) -> Array:
    """First guess of a polynomial of a degree less or the same, in the plane that holds most of a curve's bending."""
    coefficients, length = _coefficients(smooth)
    way, _ = _plane_of(coefficients)
    bending, base = (coefficients @ way)[:4], smooth.parameters[smooth.family.count :]
    return np.concatenate([[math.atan2(way[1], way[0])], bending, [length], base])


def like_ellipse(smooth: Fit) -> Array:
    """First guess of an ellipse that bends as a polynomial, or one like pieces, does at its start, middle and end."""
    polynomial, base = np.split(plane_like(smooth), [-(len(smooth.parameters) - smooth.family.count)])
    return np.append(ellipse_like(polynomial), base)
