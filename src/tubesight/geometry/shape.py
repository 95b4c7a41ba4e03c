"""The numbers a user asks for, from a curve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from tubesight.core import Array, readonly
from tubesight.geometry.curve import Curve3D

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
    sd
        Standard deviations by name (`SD_NAMES`), in the units above; NaN where not known.
    """

    tip_mm: Array
    bending_rad: float
    orientation_rad: float
    length_mm: float
    curvature_per_mm: float
    sd: Mapping[str, float] = field(default_factory=_unknown)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tip_mm", readonly(self.tip_mm, (3,), "tip_mm"))


def angle_between(a: Array, b: Array) -> float:
    """Angle between two vectors, accurate for small angles too: ``atan2(|a x b|, a . b)``."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def shape_of(curve: Curve3D, orientation_from_mm: float) -> Shape:
    """Measure a curve.

    Parameters
    ----------
    curve
        Centreline in the base frame.
    orientation_from_mm
        Distance of the tip from the z axis below which its azimuth is undefined (three standard deviations of the
        tip across the axis).
    """
    length = curve.length_mm
    tip = curve.at([length])[0]
    ends = curve.tangent([0.0, length])
    defined = float(np.hypot(tip[0], tip[1])) >= orientation_from_mm
    s = np.linspace(0.0, length, 201)
    tangents = curve.tangent(s)
    turned = np.arctan2(
        np.linalg.norm(np.cross(tangents[:-1], tangents[1:]), axis=1), (tangents[:-1] * tangents[1:]).sum(1)
    )
    return Shape(
        tip_mm=tip,
        bending_rad=angle_between(ends[0], ends[1]),
        orientation_rad=float(np.arctan2(tip[1], tip[0]) % (2 * np.pi)) if defined else float("nan"),
        length_mm=length,
        curvature_per_mm=float(turned.sum() / length) if length > 0 else float("nan"),
    )
