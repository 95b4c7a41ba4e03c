"""The numbers a user asks for, from a curve."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from tubesight.core import Array, readonly
from tubesight.core.kernels import COMPILED
from tubesight.geometry import shape_kernels
from tubesight.geometry.curve import Arc, Curve3D, NodeCurve
from tubesight.geometry.deviations import Deviations

SD_NAMES = ("tip_x", "tip_y", "tip_z", "bending", "orientation", "length", "curvature")
_UNKNOWN: Mapping[str, float] = MappingProxyType(dict.fromkeys(SD_NAMES, math.nan))
# Tangents by which a curve that has no nodes is measured.
_SAMPLES = 65


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Tip, angles, length and curvature of a tube in the base frame.

    Attributes
    ----------
    tip_mm
        (3,) centre of the tip ball or of the rounded end, or the middle of a flat end face.
    bending_rad
        theta: angle between the tangents at base and tip, 0 to pi.
    orientation_rad
        phi: azimuth of the tip about +z from +x, 0 to 2 pi; NaN where the tip lies on the z axis.
    length_mm
        Arc length of the centreline.
    curvature_per_mm
        Mean absolute curvature.
    sd, sd_picture, sd_rig
        Standard deviations by name (`SD_NAMES`), in the units above: together, from the pictures and from the
        calibration; NaN where not known.
    """

    tip_mm: Array
    bending_rad: float
    orientation_rad: float
    length_mm: float
    curvature_per_mm: float
    sd: Mapping[str, float] = field(default_factory=lambda: _UNKNOWN)
    sd_picture: Mapping[str, float] = field(default_factory=lambda: _UNKNOWN)
    sd_rig: Mapping[str, float] = field(default_factory=lambda: _UNKNOWN)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", readonly(self.tip_mm, (3,), "tip_mm"))


def angle_between(a: Array, b: Array) -> float:
    """Angle between two vectors, accurate for small angles too: ``atan2(|a x b|, a . b)``."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return math.atan2(math.hypot(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), ax * bx + ay * by + az * bz)


def shape_of(curve: Curve3D, orientation_from_mm: float) -> Shape:
    """Measure a curve, with the deviations that it carries.

    Parameters
    ----------
    curve
        Centreline in the base frame.
    orientation_from_mm
        Distance of the tip from the z axis below which its azimuth is undefined whatever the curve's deviations are;
        it is at least three standard deviations of that distance.
    """
    picture = rig = None
    if isinstance(curve, NodeCurve) and isinstance(curve.from_picture, Deviations):
        numbers, rows = (shape_kernels.measured if COMPILED else measured)(*curve.from_picture.nodes.arrays)
        values = numbers.tolist()
        picture = _deviations(values, rows, curve.from_picture.covariance)
        if isinstance(curve.from_rig, Deviations):
            rig = _deviations(values, rows, curve.from_rig.covariance)
    else:
        values = _measure(curve)
        if isinstance(curve, NodeCurve) and curve.from_picture:
            picture = _differences(values, curve.from_picture)
            rig = _differences(values, curve.from_rig) if curve.from_rig else None
    both = picture if picture is None or rig is None else [math.hypot(a, b) for a, b in zip(picture, rig, strict=True)]
    side_mm = math.hypot(values[0], values[1])
    if both is not None:
        orientation_from_mm = max(orientation_from_mm, 3 * math.hypot(both[0], both[1]))
    known = side_mm > 0 and side_mm >= orientation_from_mm
    # An azimuth of minus one rounding is a full turn after the modulus: fold that to zero.
    phi = values[4] % (2 * math.pi) % (2 * math.pi) if known else math.nan
    named = (_named(both, known), _named(picture, known), _named(rig, known))
    return Shape(np.array(values[:3]), values[3], phi, values[5], values[6], *named)


def _named(deviations: list[float] | None, oriented: bool) -> Mapping[str, float]:
    if deviations is None:
        return _UNKNOWN
    named = dict(zip(SD_NAMES, deviations, strict=True))
    if not oriented:
        named["orientation"] = math.nan
    return named


def _measure(curve: Curve3D) -> list[float]:
    """Values (7,) in the order of `SD_NAMES`."""
    length = curve.length_mm
    if isinstance(curve, Arc):
        tangents = curve.tangent(np.array([0.0, length]))
        turned = math.hypot(*curve.curvature_per_mm.tolist()) * length
    else:
        tangents = curve.tangent(np.linspace(0.0, length, _SAMPLES))
        turned = float(_turns(tangents).sum())
    x, y, z = curve.at(np.array([length]))[0].tolist()
    bending = angle_between(tangents[0], tangents[-1])
    return [x, y, z, bending, math.atan2(y, x), length, turned / max(length, 1e-9)]


def _turns(tangents: Array) -> Array:
    """Angles (M - 1,) between neighbouring unit tangents (M, 3)."""
    across = np.linalg.norm(np.cross(tangents[:-1], tangents[1:]), axis=1)
    return np.asarray(np.arctan2(across, (tangents[:-1] * tangents[1:]).sum(1)))


def _differences(values: list[float], displaced: Sequence[NodeCurve]) -> list[float]:
    """Root sum of squares of what each displaced curve changes."""
    off = np.array([_measure(curve) for curve in displaced]) - values
    off[:, 4] = (off[:, 4] + np.pi) % (2 * np.pi) - np.pi
    return [float(sd) for sd in np.sqrt((off**2).sum(0))]


def _deviations(values: list[float], rows: Array, covariance: Array) -> list[float]:
    """Derive standard deviations in the order of `SD_NAMES` from the covariance of a curve's parameters.

    Angle and curvature are lengths of vectors: what is ``a`` along such a vector u and ``c`` across it changes its
    length by ``a`` and ``hypot(u, c) - u``, the latter for tubes that are nearly straight.
    """
    deviations = [float(sd) for sd in (shape_kernels.spread if COMPILED else spread)(rows, covariance)]
    across = deviations.pop()
    bending, turned, length = values[3], values[6] * values[5], values[5]
    deviations[3] = math.hypot(deviations[3], math.hypot(bending, across) - bending)
    deviations[6] = math.hypot(deviations[6], (math.hypot(turned, across) - turned) / length)
    return deviations


def measured(
    points: Array, tangents: Array, s: Array, d_points: Array, d_turn: Array, d_s: Array
) -> tuple[Array, Array]:
    """Measure a curve by its nodes, with derivatives by its parameters.

    The angle between two tangents grows by ``axis . (turn of the second - turn of the first)``, the unit axis being
    the one that they turn about.

    Parameters
    ----------
    points, tangents, s, d_points, d_turn, d_s
        As in `tubesight.geometry.families.Nodes`.

    Returns
    -------
    values, rows
        (7,) in the order of `SD_NAMES`, and (8, P): their derivatives, and those of the turn between base and tip
        across the plane of bending.
    """
    x, y, _ = points[-1]
    length, turns = s[-1], _turns(tangents)
    curvature = turns.sum() / length
    axis = _axes(tangents[0], tangents[-1])
    bend = d_turn[-1] - d_turn[0]
    each = np.einsum("mc,mcp->p", _axes(tangents[:-1], tangents[1:]), np.diff(d_turn, axis=0))
    square = x * x + y * y
    azimuth = (x * d_points[-1, 1] - y * d_points[-1, 0]) / square if square > 0 else np.zeros(d_s.shape[1])
    rows = [axis @ bend, azimuth, d_s[-1], (each - curvature * d_s[-1]) / length, np.cross(tangents[-1], axis) @ bend]
    values = [*points[-1], angle_between(tangents[0], tangents[-1]), np.arctan2(y, x), length, curvature]
    return np.array(values), np.stack([*d_points[-1], *rows])


def _axes(a: Array, b: Array) -> Array:
    """Find the unit axes (..., 3) about which unit vectors a turn to b; any across a where they are equal."""
    across = np.stack([a[..., 1], -a[..., 0], np.zeros_like(a[..., 0])], -1)
    other = np.stack([np.zeros_like(a[..., 0]), a[..., 2], -a[..., 1]], -1)
    across = np.where(np.abs(a[..., 2:]) < 0.9, across, other)
    axis = np.cross(a, b)
    axis = np.where((axis == 0).all(-1, keepdims=True), across, axis)
    return np.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True))


def spread(rows: Array, covariance: Array) -> Array:
    """Propagate a covariance (P, P) of parameters to deviations (K,) of what changes with rows (K, P) by them."""
    return np.asarray(np.sqrt(np.maximum(((rows @ covariance) * rows).sum(1), 0.0)))
