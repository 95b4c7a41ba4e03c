"""The numbers a user asks for, from a curve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tubesight.core import Array, readonly
from tubesight.geometry.curve import Curve3D, NodeCurve

SD_NAMES = ("tip_x", "tip_y", "tip_z", "bending", "orientation", "length", "curvature")


def _unknown() -> dict[str, float]:
    return dict.fromkeys(SD_NAMES, float("nan"))


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
    sd: Mapping[str, float] = field(default_factory=_unknown)
    sd_picture: Mapping[str, float] = field(default_factory=_unknown)
    sd_rig: Mapping[str, float] = field(default_factory=_unknown)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", readonly(self.tip_mm, (3,), "tip_mm"))


def angle_between(a: Array, b: Array) -> float:
    """Angle between two vectors, accurate for small angles too: ``atan2(|a x b|, a . b)``."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


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
    values = _measure(curve)
    picture, rig = _unknown(), _unknown()
    if isinstance(curve, NodeCurve) and curve.from_picture:
        picture = _deviations(values, curve.from_picture)
        rig = _deviations(values, curve.from_rig) if curve.from_rig else rig
        moved = [np.hypot(*(_measure(c)[:2] - values[:2])) for c in (*curve.from_picture, *curve.from_rig)]
        orientation_from_mm = max(orientation_from_mm, 3 * float(np.linalg.norm(moved)))
    known_rig = {k: v if np.isfinite(v) else 0.0 for k, v in rig.items()}
    both = {k: float(np.hypot(picture[k], known_rig[k])) for k in SD_NAMES}
    side_mm = np.hypot(values[0], values[1])
    # An azimuth of minus one rounding is a full turn after the modulus: fold that to zero.
    phi = values[4] % (2 * np.pi) % (2 * np.pi) if side_mm > 0 and side_mm >= orientation_from_mm else float("nan")
    if np.isnan(phi):
        both["orientation"] = picture["orientation"] = rig["orientation"] = float("nan")
    return Shape(values[:3], float(values[3]), float(phi), float(values[5]), float(values[6]), both, picture, rig)


def _measure(curve: Curve3D) -> Array:
    """Values (7,) in the order of `SD_NAMES`."""
    length = curve.length_mm
    tip = curve.at([length])[0]
    tangents = curve.tangent(np.linspace(0.0, length, 65))
    turned = np.arctan2(
        np.linalg.norm(np.cross(tangents[:-1], tangents[1:]), axis=1), (tangents[:-1] * tangents[1:]).sum(1)
    )
    bending = angle_between(tangents[0], tangents[-1])
    return np.array([*tip, bending, np.arctan2(tip[1], tip[0]), length, turned.sum() / max(length, 1e-9)])


def _deviations(values: Array, displaced: tuple[NodeCurve, ...]) -> dict[str, float]:
    """Root sum of squares of what each displaced curve changes."""
    off = np.array([_measure(curve) for curve in displaced]) - values
    off[:, 4] = (off[:, 4] + np.pi) % (2 * np.pi) - np.pi
    return dict(zip(SD_NAMES, np.sqrt((off**2).sum(0)).tolist(), strict=True))
