"""Centrelines known exactly, as functions of arc length: the ground truth of every simulated picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike
from scipy.special import ellipeinc

from tubesight.core import Array, readonly
from tubesight.geometry.pose import Pose

# Points of a centreline in truth.json, both ends included: every 1.6 mm of a tube of 160 mm.
_TRUTH_POINTS = 101
# Gauss-Legendre nodes for the position along a curvature polynomial: at 48 nodes the quadrature of cos and sin of a
# polynomial of degree 6 that turns by 360 degrees is exact to 1e-12 of the length.
_QUADRATURE_NODES = 48
# Steps on the incomplete elliptic integral: Newton's, 1e-15 after 6 from most places at axis ratios of 0.2 to 5, and
# halves of the interval where those lead out of it. Angles that differ by rounding lie within it.
_ELLIPSE_STEPS, _ROUNDING = 24, 1e-12


class Phantom(Protocol):
    """A centreline by arc length; clamped ones leave the origin of the base frame along +z."""

    @property
    def kind(self) -> str:
        """Family of the curve, as in truth.json."""
        ...

    @property
    def length_mm(self) -> float:
        """Arc length from base to tip."""
        ...

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (..., 3) at arc lengths (...), base frame."""
        ...

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...), base frame."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the parameters as truth.json gives them, angles in degrees."""
        ...


def _out_of_plane(radial: Array, axial: Array, phi_rad: float) -> Array:
    """Points or directions (..., 3) in the half plane of azimuth phi: distance from z, and z."""
    return np.stack([radial * np.cos(phi_rad), radial * np.sin(phi_rad), axial], -1)


def _check_length(length_mm: float) -> None:
    if not (np.isfinite(length_mm) and length_mm > 0):
        raise ValueError(f"length_mm: expected a positive number, got {length_mm}")


@dataclass(frozen=True, slots=True)
class Arc:
    """Circular arc that bends by `theta_rad` towards azimuth `phi_rad`; straight in the limit theta = 0.

    ``r = s sinc(a) sin(a)``, ``z = s sinc(a) cos(a)`` with ``a = theta s / (2 length)``: the chord of an arc makes half
    its turning angle with the tangent at its start.
    """

    theta_rad: float
    phi_rad: float
    length_mm: float

    def __post_init__(self) -> None:
        _check_length(self.length_mm)

    @property
    def kind(self) -> str:
        """``straight`` or ``circle``."""
        return "straight" if self.theta_rad == 0 else "circle"

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (..., 3) at arc lengths (...)."""
        s = np.asarray(s_mm, float)
        half = self.theta_rad * s / (2 * self.length_mm)
        chord = s * np.sinc(half / np.pi)
        return _out_of_plane(chord * np.sin(half), chord * np.cos(half), self.phi_rad)

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...)."""
        angle = self.theta_rad * np.asarray(s_mm, float) / self.length_mm
        return _out_of_plane(np.sin(angle), np.cos(angle), self.phi_rad)

    def describe(self) -> dict[str, Any]:
        """Return theta and phi in degrees; nothing for a straight tube."""
        if self.theta_rad == 0:
            return {"kind": self.kind}
        return {"kind": self.kind, "theta": float(np.degrees(self.theta_rad)), "phi": float(np.degrees(self.phi_rad))}


def straight(length_mm: float) -> Arc:
    """Return the straight tube along +z."""
    return Arc(0.0, 0.0, length_mm)


@dataclass(frozen=True, slots=True)
class EllipseArc:
    """Arc of an ellipse from one of its vertices, tangent to +z there, to the point where it has turned by theta.

    ``r = b (1 - cos t)``, ``z = a sin t`` with ``ratio = a / b``; the arc length is ``a E(t | 1 - b^2 / a^2)``, so that
    a ratio above one bends more and more towards the tip. theta lies between 0 and 180 degrees, ends excluded.
    """

    theta_rad: float
    ratio: float
    phi_rad: float
    length_mm: float

    def __post_init__(self) -> None:
        _check_length(self.length_mm)
        if not 0 < self.theta_rad < np.pi:
            raise ValueError(f"theta_rad: expected between 0 and pi for an ellipse, got {self.theta_rad}")
        if not self.ratio > 0:
            raise ValueError(f"ratio: expected a positive number, got {self.ratio}")

    @property
    def kind(self) -> str:
        """``ellipse``."""
        return "ellipse"

    @property
    def axial_mm(self) -> float:
        """Semi-axis a along z."""
        end = np.arctan2(self.ratio * np.sin(self.theta_rad), np.cos(self.theta_rad))
        return float(self.length_mm / ellipeinc(end, 1 - self.ratio**-2))

    def _parameter(self, s_mm: ArrayLike) -> Array:
        """Solve ``a E(t) = s`` for the eccentric angle t."""
        goal = np.asarray(s_mm, float) / self.axial_mm
        m = 1 - self.ratio**-2
        t = goal.copy()
        # The arc length of an ellipse with a = 1 grows by something between 1 and 1 / ratio with the angle.
        low, high = goal * min(1.0, self.ratio), goal * max(1.0, self.ratio)
        for _ in range(_ELLIPSE_STEPS):
            off = ellipeinc(t, m) - goal
            low, high = np.where(off < 0, t, low), np.where(off < 0, high, t)
            t = t - off / np.sqrt(1 - m * np.sin(t) ** 2)
            t = np.where((t > low - _ROUNDING) & (t < high + _ROUNDING), t, (low + high) / 2)
        return np.asarray(t)

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (..., 3) at arc lengths (...)."""
        t = self._parameter(s_mm)
        a = self.axial_mm
        return _out_of_plane(a / self.ratio * 2 * np.sin(t / 2) ** 2, a * np.sin(t), self.phi_rad)

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...)."""
        t = self._parameter(s_mm)
        direction = np.stack([np.sin(t) / self.ratio, np.cos(t)], -1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return _out_of_plane(direction[..., 0], direction[..., 1], self.phi_rad)

    def describe(self) -> dict[str, Any]:
        """Return theta and phi in degrees and the ratio of the axes."""
        theta, phi = np.degrees([self.theta_rad, self.phi_rad]).tolist()
        return {"kind": self.kind, "theta": theta, "ratio": self.ratio, "phi": phi}


@dataclass(frozen=True, slots=True)
class Pieces:
    """Circular arcs one after the other (an S-shape, a robot of several segments).

    The azimuth of each arc counts in a frame carried along without twist: the rotation of the frame over an arc is
    ``Rz(phi) Ry(theta) Rz(-phi)``, the axis of the bend.
    """

    arcs: tuple[Arc, ...]

    def __post_init__(self) -> None:
        if not self.arcs:
            raise ValueError("pieces: expected at least one arc")

    @property
    def kind(self) -> str:
        """``segments``."""
        return "segments"

    @property
    def length_mm(self) -> float:
        """Sum of the lengths."""
        return float(sum(arc.length_mm for arc in self.arcs))

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (..., 3) at arc lengths (...)."""
        return self._walk(s_mm)[0]

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...)."""
        return self._walk(s_mm)[1]

    def _walk(self, s_mm: ArrayLike) -> tuple[Array, Array]:
        s = np.asarray(s_mm, float)
        points, tangents = np.empty((*s.shape, 3)), np.empty((*s.shape, 3))
        base_from_piece, start = Pose.identity(), 0.0
        for arc in self.arcs:
            here = (s >= start) if start else np.ones(s.shape, bool)
            points[here] = base_from_piece.apply(arc.at(s[here] - start))
            tangents[here] = base_from_piece.rotate(arc.tangent(s[here] - start))
            axis = np.array([-np.sin(arc.phi_rad), np.cos(arc.phi_rad), 0.0])
            base_from_piece = base_from_piece @ Pose.from_rotvec(arc.theta_rad * axis, arc.at(arc.length_mm))
            start += arc.length_mm
        return points, tangents

    def describe(self) -> dict[str, Any]:
        """Return length, theta and phi (degrees) of every arc."""
        rows = [
            {"length": a.length_mm, "theta": float(np.degrees(a.theta_rad)), "phi": float(np.degrees(a.phi_rad))}
            for a in self.arcs
        ]
        return {"kind": self.kind, "segments": rows}


@dataclass(frozen=True, slots=True)
class CurvaturePolynomial:
    """Planar curve whose curvature is a sum of Legendre polynomials of arc length.

    ``kappa(s) = sum_k c_k P_k(2 s / length - 1)``, so that ``c_0`` is the mean curvature (1/mm).
    """

    curvature_per_mm: tuple[float, ...]
    phi_rad: float
    length_mm: float

    def __post_init__(self) -> None:
        _check_length(self.length_mm)

    @property
    def kind(self) -> str:
        """``polynomial``."""
        return "polynomial"

    def _angle(self, s: Array) -> Array:
        turned = legendre.legint(np.asarray(self.curvature_per_mm, float), lbnd=-1)
        return np.asarray(self.length_mm / 2 * legendre.legval(2 * s / self.length_mm - 1, turned))

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (..., 3) at arc lengths (...): Gauss-Legendre quadrature of the tangent."""
        s = np.asarray(s_mm, float)
        nodes, weights = legendre.leggauss(_QUADRATURE_NODES)
        angle = self._angle(s[..., None] * (nodes + 1) / 2)
        radial, axial = s / 2 * (np.sin(angle) @ weights), s / 2 * (np.cos(angle) @ weights)
        return _out_of_plane(radial, axial, self.phi_rad)

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...)."""
        angle = self._angle(np.asarray(s_mm, float))
        return _out_of_plane(np.sin(angle), np.cos(angle), self.phi_rad)

    def describe(self) -> dict[str, Any]:
        """Return the coefficients (1/mm) and phi in degrees."""
        return {
            "kind": self.kind,
            "curvature_per_mm": list(self.curvature_per_mm),
            "phi": float(np.degrees(self.phi_rad)),
        }


@dataclass(frozen=True, slots=True)
class Helix:
    """Curve of constant curvature and torsion that leaves the origin along +z and bends towards azimuth phi first.

    The tangent turns about the constant Darboux vector ``torsion T + curvature B`` of the start.
    """

    curvature_per_mm: float
    torsion_per_mm: float
    phi_rad: float
    length_mm: float

    def __post_init__(self) -> None:
        _check_length(self.length_mm)
        if not self.curvature_per_mm > 0:
            raise ValueError(f"curvature_per_mm: expected a positive number, got {self.curvature_per_mm}")

    @property
    def kind(self) -> str:
        """``helix``."""
        return "helix"

    def _axes(self) -> tuple[float, Array, Array, Array]:
        """Return the turning rate (rad/mm) and the tangent's parts: along the axis, across it, across and turned."""
        rate = float(np.hypot(self.curvature_per_mm, self.torsion_per_mm))
        start = np.array([0.0, 0.0, 1.0])
        binormal = np.array([-np.sin(self.phi_rad), np.cos(self.phi_rad), 0.0])
        axis = (self.torsion_per_mm * start + self.curvature_per_mm * binormal) / rate
        along = (start @ axis) * axis
        return rate, along, start - along, np.cross(axis, start)

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (..., 3) at arc lengths (...)."""
        s = np.asarray(s_mm, float)[..., None]
        rate, along, across, turned = self._axes()
        return np.asarray(along * s + across * np.sin(rate * s) / rate + turned * (1 - np.cos(rate * s)) / rate)

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...)."""
        s = np.asarray(s_mm, float)[..., None]
        rate, along, across, turned = self._axes()
        return np.asarray(along + across * np.cos(rate * s) + turned * np.sin(rate * s))

    def describe(self) -> dict[str, Any]:
        """Return curvature and torsion (1/mm) and phi in degrees."""
        return {
            "kind": self.kind,
            "curvature_per_mm": self.curvature_per_mm,
            "torsion_per_mm": self.torsion_per_mm,
            "phi": float(np.degrees(self.phi_rad)),
        }


@dataclass(frozen=True, slots=True)
class Placed:
    """A phantom whose base is not at the clamp: moved by ``base_from_phantom``."""

    phantom: Phantom
    base_from_phantom: Pose

    @property
    def kind(self) -> str:
        """Kind of the phantom moved."""
        return self.phantom.kind

    @property
    def length_mm(self) -> float:
        """Arc length from base to tip."""
        return self.phantom.length_mm

    def at(self, s_mm: ArrayLike) -> Array:
        """Return points (..., 3) at arc lengths (...), base frame."""
        return self.base_from_phantom.apply(self.phantom.at(s_mm))

    def tangent(self, s_mm: ArrayLike) -> Array:
        """Return unit tangents (..., 3) at arc lengths (...), base frame."""
        return self.base_from_phantom.rotate(self.phantom.tangent(s_mm))

    def describe(self) -> dict[str, Any]:
        """Return the phantom's parameters and its pose."""
        return {**self.phantom.describe(), "base_from_phantom": self.base_from_phantom.matrix.tolist()}


def truth(phantom: Phantom) -> dict[str, Any]:
    """Describe a phantom as one frame of truth.json (mm, degrees).

    Returns
    -------
    dict
        ``kind``, ``shape`` (parameters), ``tip`` (3,), ``length``, ``theta`` (angle between the tangents at base and
        tip), ``phi`` (azimuth of the tip about +z, 0 on the axis), ``centreline`` (101, 3).
    """
    length = phantom.length_mm
    points = readonly(phantom.at(np.linspace(0, length, _TRUTH_POINTS)), (None, 3), "centreline")
    base, end = phantom.tangent(np.array([0.0, length]))
    tip = points[-1]
    # atan2 keeps full precision at small angles, where the arc cosine of the dot product loses half the digits.
    theta = np.degrees(np.arctan2(np.linalg.norm(np.cross(base, end)), base @ end))
    on_axis = np.hypot(tip[0], tip[1]) < 1e-9 * length
    phi = 0.0 if on_axis else np.degrees(np.arctan2(tip[1], tip[0])) % 360
    return {
        "kind": phantom.kind,
        "shape": phantom.describe(),
        "tip": tip.tolist(),
        "length": float(length),
        "theta": float(theta),
        "phi": float(phi),
        "centreline": points.round(6).tolist(),
    }
