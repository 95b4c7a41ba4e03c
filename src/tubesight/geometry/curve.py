"""Space curves of slender tubes, by arc length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from tubesight.core import Array, readonly
from tubesight.core.kernels import COMPILED
from tubesight.geometry import point_kernels
from tubesight.geometry.pose import Pose

# Panels and nodes of the quadrature of an ellipse's arc length: 1e-13 relative for axis ratios up to 10.
_PANELS = 64
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
# Where a tube in its clamp starts.
_CLAMP = Pose.identity()


class Curve3D(Protocol):
    """Centreline of a tube in the base frame, millimetres, from its base (s = 0) to its tip (s = length)."""

    @property
    def model(self) -> str:
        """Name of the family: ``line``, ``circle``, ``ellipse`` ..."""

    @property
    def length_mm(self) -> float:
        """Arc length from base to tip."""

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (N, 3) at arc lengths (N,)."""

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (N, 3) at arc lengths (N,), towards the tip."""


@dataclass(frozen=True, eq=False)
class NodeCurve:
    """Curve through nodes with known tangents (cubic Hermite), and how far it may be off.

    Attributes
    ----------
    model
        Name of its family.
    s_mm, points_mm, tangents
        (M,), (M, 3), (M, 3) in the base frame.
    from_picture, from_rig
        The curve displaced by one standard deviation along each independent direction of its covariance: what comes
        from the pictures, and what comes from the calibration. Empty where not known.
    note
        Why it is of this family, in words, where that is worth telling.
    """

    model: str
    s_mm: Array
    points_mm: Array
    tangents: Array
    from_picture: Sequence[NodeCurve] = ()
    from_rig: Sequence[NodeCurve] = ()
    note: str = ""

    def __post_init__(self) -> None:
        m = len(self.s_mm)
        for name, shape in (("s_mm", (m,)), ("points_mm", (m, 3)), ("tangents", (m, 3))):
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))

    @property
    def length_mm(self) -> float:
        """Arc length from base to tip."""
        return float(self.s_mm[-1])

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (N, 3) at arc lengths (N,)."""
        return self._hermite(s_mm)[0]

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (N, 3) at arc lengths (N,)."""
        t = self._hermite(s_mm)[1]
        return np.asarray(t / np.sqrt((t * t).sum(-1, keepdims=True)))

    def _hermite(self, s_mm: ArrayLike) -> tuple[Array, Array]:
        s = np.array(s_mm, float)
        places, slopes = (point_kernels.hermite if COMPILED else hermite)(
            self.s_mm, self.points_mm, self.tangents, s.ravel()
        )
        return places.reshape(*s.shape, 3), slopes.reshape(*s.shape, 3)


def hermite(s: Array, points: Array, tangents: Array, at: Array) -> tuple[Array, Array]:
    """Points (N, 3) at arc lengths (N,) of the cubic spline through points with given derivatives, and its derivatives.

    SciPy's spline, imported only here: that takes longer than a result.
    """
    from scipy.interpolate import CubicHermiteSpline

    spline = CubicHermiteSpline(s, points, tangents)
    return np.asarray(spline(at)), np.asarray(spline(at, 1))


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """Circular arc of constant curvature; the straight line is its limit.

    In the frame of its start the curve leaves the origin along +z and bends towards the curvature vector:
    ``p(s) = (n s^2 kappa / 2 sinc^2(kappa s / 2), s sinc(kappa s))`` with ``n`` the unit direction of bending and
    ``sinc(x) = sin(x) / x``, which is regular at kappa = 0.

    Attributes
    ----------
    curvature_per_mm
        (2,) curvature vector: direction of bending in the start's xy plane times curvature.
    length_mm
        Arc length.
    start
        ``base_from_start``; the identity for a tube in its clamp.
    """

    curvature_per_mm: Array
    length_mm: float
    start: Pose = _CLAMP

    def __post_init__(self) -> None:
        object.__setattr__(self, "curvature_per_mm", readonly(self.curvature_per_mm, (2,), "curvature_per_mm"))

    @property
    def model(self) -> str:
        """``line`` where the curvature is zero, else ``circle``."""
        return "circle" if self.curvature_per_mm.any() else "line"

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (N, 3) at arc lengths (N,)."""
        return self._arc(s_mm)[0]

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (N, 3) at arc lengths (N,)."""
        return self._arc(s_mm)[1]

    def _arc(self, s_mm: ArrayLike) -> tuple[Array, Array]:
        s = np.array(s_mm, float)
        points, tangents = (point_kernels.arc if COMPILED else arc)(
            self.curvature_per_mm, self.start.rotation, self.start.translation_mm, s.ravel()
        )
        return points.reshape(*s.shape, 3), tangents.reshape(*s.shape, 3)


def arc(curvature: Array, rotation: Array, translation: Array, at: Array) -> tuple[Array, Array]:
    """Points and unit tangents (N, 3) of `Arc` at arc lengths (N,), from its curvature vector (2,) and its start."""
    angle = at * float(np.hypot(*curvature))
    side, slope = at * at / 2 * np.sinc(angle / (2 * np.pi)) ** 2, at * np.sinc(angle / np.pi)
    points = np.stack([*(k * side for k in curvature), slope], -1) @ rotation.T + translation
    return points, np.stack([*(k * slope for k in curvature), np.cos(angle)], -1) @ rotation.T


@dataclass(frozen=True, eq=False)
class EllipseArc:
    """Arc of an ellipse: ``p(t) = centre + cos(t) a + sin(t) b`` for t from `start_rad` to `end_rad`.

    Attributes
    ----------
    centre_mm, a_mm, b_mm
        (3,) each; a and b are orthogonal semi-axes.
    start_rad, end_rad
        Parameters t of base and tip; the curve runs from one to the other whichever is larger.
    """

    centre_mm: Array
    a_mm: Array
    b_mm: Array
    start_rad: float
    end_rad: float
    model: str = "ellipse"

    def __post_init__(self) -> None:
        for name in ("centre_mm", "a_mm", "b_mm"):
            object.__setattr__(self, name, readonly(getattr(self, name), (3,), name))
        if abs(float(self.a_mm @ self.b_mm)) > 1e-9 * float(np.linalg.norm(self.a_mm) * np.linalg.norm(self.b_mm)):
            raise ValueError("the semi-axes of an ellipse have to be orthogonal")
        if not abs(self.end_rad - self.start_rad) > 0:
            raise ValueError(f"the ends of an elliptic arc have to differ, got {self.start_rad} and {self.end_rad}")

    def _point(self, t: Array) -> Array:
        return np.asarray(self.centre_mm + np.cos(t)[..., None] * self.a_mm + np.sin(t)[..., None] * self.b_mm)

    def _velocity(self, t: Array) -> Array:
        return np.asarray(-np.sin(t)[..., None] * self.a_mm + np.cos(t)[..., None] * self.b_mm)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Parameter t and arc length at the panel ends."""
        t = np.linspace(self.start_rad, self.end_rad, _PANELS + 1)
        half = (t[1] - t[0]) / 2
        nodes = (t[:-1] + half)[:, None] + half * _NODES
        speed = np.linalg.norm(self._velocity(nodes), axis=-1)
        return t, np.concatenate([[0.0], np.cumsum(abs(half) * speed @ _WEIGHTS)])

    @property
    def length_mm(self) -> float:
        """Arc length from base to tip."""
        return float(self._table[1][-1])

    def _parameter(self, s_mm: ArrayLike) -> Array:
        """Invert the arc length by Newton's method from the panel's linear guess."""
        s = np.asarray(s_mm, float)
        t_table, s_table = self._table
        panel = np.clip(np.searchsorted(s_table, s, side="right") - 1, 0, _PANELS - 1)
        width = t_table[1] - t_table[0]
        t = t_table[panel] + width * (s - s_table[panel]) / (s_table[panel + 1] - s_table[panel])
        for _ in range(4):
            half = (t - t_table[panel]) / 2
            nodes = (t_table[panel] + half)[..., None] + half[..., None] * _NODES
            arc = np.abs(half) * (np.linalg.norm(self._velocity(nodes), axis=-1) @ _WEIGHTS)
            arc *= np.sign(half) * np.sign(width)
            t = t - np.sign(width) * (s_table[panel] + arc - s) / np.linalg.norm(self._velocity(t), axis=-1)
        return np.asarray(t)

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (N, 3) at arc lengths (N,)."""
        return self._point(self._parameter(s_mm))

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (N, 3) at arc lengths (N,)."""
        v = self._velocity(self._parameter(s_mm)) * np.sign(self.end_rad - self.start_rad)
        return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
