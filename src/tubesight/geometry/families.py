"""Families of centrelines by a few parameters: what the silhouette fit chooses from.

Each family maps its parameters to nodes along the curve, in the frame of its start (origin, leaving along +z), for a
batch of parameter vectors at once, so that a Jacobian by differences is one call.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array

# Intervals between nodes: 2.5 mm on a 160 mm tube, on which a parabola is exact to 1e-5 mm.
INTERVALS = 64
# Nodes as shares of the length, the places and weights of a Gauss-Legendre quadrature between them, and the Legendre
# polynomials of curvature with their integrals there, up to the highest order of any family.
_ENDS = np.linspace(0.0, 1.0, INTERVALS + 1)
_NODES, _WEIGHTS = (values / (2 * INTERVALS) for values in np.polynomial.legendre.leggauss(4))
_INNER = ((_ENDS[:-1] + 0.5 / INTERVALS)[:, None] + _NODES).ravel()
_POLYNOMIALS = [np.polynomial.legendre.Legendre.basis(k, domain=[0, 1]) for k in range(6)]
_BASIS_ENDS = np.stack([p(_ENDS) for p in _POLYNOMIALS])
_BASIS_MIDDLE = np.stack([p((_ENDS[:-1] + _ENDS[1:]) / 2) for p in _POLYNOMIALS])
_TURN_ENDS = np.stack([p.integ(lbnd=0)(_ENDS) for p in _POLYNOMIALS])
_TURN_INNER = np.stack([p.integ(lbnd=0)(_INNER) for p in _POLYNOMIALS])


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """Curves of a batch at their nodes.

    Attributes
    ----------
    points, tangents, curvature
        (B, M, 3) each, millimetres, unit, 1 / mm; the curvature is the vector dt/ds.
    s_mm
        (B, M) arc length.
    """

    points: Array
    tangents: Array
    curvature: Array
    s_mm: Array


@dataclass(frozen=True, slots=True)
class Family:
    """A family of curves.

    Attributes
    ----------
    name
        As reported.
    count
        Number of parameters; the last one is the length in mm, the others are angles in radians or pure numbers.
    nodes
        ``(B, count) -> Nodes``.
    soft
        Indices of parameters that the data may leave open (shares of pieces, ratios of axes), each with the deviation
        from 0 that is expected of it.
    """

    name: str
    count: int
    nodes: Callable[[Array], Nodes]
    soft: tuple[tuple[int, float], ...] = ()


def circle_nodes(parameters: Array) -> Nodes:
    """Circular arc: bend vector (rad, total turn times direction) and length. Straight is the zero vector."""
    return _pieces(parameters[:, None, :2], parameters[:, 2:3])


def pieces_nodes(parameters: Array) -> Nodes:
    """Circular arcs end to end with common tangents: bend vectors of each, lengths as shares, total length.

    ``(bx1, by1, ..., bxn, byn, l1, ..., l(n-1), length)`` where l are logits of the shares against the last piece.
    """
    count = parameters.shape[1] // 3
    bends = parameters[:, : 2 * count].reshape(-1, count, 2)
    weights = np.exp(np.concatenate([parameters[:, 2 * count : -1], np.zeros((len(parameters), 1))], 1))
    lengths = weights / weights.sum(1, keepdims=True) * parameters[:, -1:]
    return _pieces(bends, lengths)


def _pieces(bends: Array, lengths: Array) -> Nodes:
    """Arcs end to end: bends (B, n, 2) and lengths (B, n); nodes are shared evenly among the pieces."""
    batch, count = lengths.shape
    per_piece = INTERVALS // count
    share = np.linspace(0.0, 1.0, per_piece + 1)
    origin, frame = np.zeros((batch, 3)), np.broadcast_to(np.eye(3), (batch, 3, 3))
    travelled = np.zeros((batch, 1))
    parts: list[tuple[Array, Array, Array, Array]] = []
    for k in range(count):
        length = lengths[:, k : k + 1]
        bend = bends[:, k]
        total = np.linalg.norm(bend, axis=1, keepdims=True)
        angle = total * share
        side = share**2 / 2 * np.sinc(angle / (2 * np.pi)) ** 2
        along = share * np.sinc(angle / np.pi)
        turn = share * np.sinc(angle / np.pi)
        local = np.stack([bend[:, :1] * side, bend[:, 1:] * side, along], -1) * length[..., None]
        tangent = np.stack([bend[:, :1] * turn, bend[:, 1:] * turn, np.cos(angle)], -1)
        safe = np.maximum(total, 1e-300)
        direction = bend / safe
        inward = (
            np.stack([direction[:, :1] * np.cos(angle), direction[:, 1:] * np.cos(angle), -np.sin(angle)], -1)
            * (total / length)[..., None]
        )
        first = 0 if k == 0 else 1
        parts.append(
            (
                (origin[:, None] + local @ frame.transpose(0, 2, 1))[:, first:],
                (tangent @ frame.transpose(0, 2, 1))[:, first:],
                (inward @ frame.transpose(0, 2, 1))[:, first:],
                (travelled + length * share)[:, first:],
            )
        )
        origin = origin + np.einsum("bij,bj->bi", frame, local[:, -1])
        frame = frame @ _bend_rotation(bend)
        travelled = travelled + length
    return Nodes(*(np.concatenate(p, 1) for p in zip(*parts, strict=True)))


def _bend_rotation(bend: Array) -> Array:
    """Rotations (B, 3, 3) that turn +z towards the bend vectors (B, 2) without twist."""
    angle = np.linalg.norm(bend, axis=1)
    a = np.sinc(angle / np.pi)
    b = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    x, y = bend[:, 0], bend[:, 1]
    rows = [
        np.stack([1 - b * x * x, -b * x * y, a * x], -1),
        np.stack([-b * x * y, 1 - b * y * y, a * y], -1),
        np.stack([-a * x, -a * y, np.cos(angle)], -1),
    ]
    return np.stack(rows, 1)


def ellipse_nodes(parameters: Array) -> Nodes:
    """Plane arc of an ellipse: ``(azimuth, theta, psi0, q, length)``.

    By its turning angle psi from 0 to theta the radius of curvature of an ellipse is proportional to
    ``(1 + (exp(2 q) - 1) sin^2(psi + psi0))^(-3/2)``, q the logarithm of the ratio of its axes.
    """
    azimuth, theta, psi0, q, length = (parameters[:, k : k + 1] for k in range(5))

    def radius(at: Array) -> Array:
        return np.asarray((1 + np.expm1(2 * np.clip(q, -3.0, 3.0)) * np.sin(theta * at + psi0) ** 2) ** -1.5)

    speed = radius(_INNER)
    s = _cumulate(speed)
    scale = length / s[:, -1:]
    side, along = _cumulate(speed * np.sin(theta * _INNER)), _cumulate(speed * np.cos(theta * _INNER))
    return _planar(azimuth, theta * _ENDS, side * scale, along * scale, theta / (scale * radius(_ENDS)), s * scale)


def polynomial_nodes(parameters: Array) -> Nodes:
    """Plane curve of polynomial curvature: ``(azimuth, c0, ..., cn, length)``, Legendre, cn in rad of total turn."""
    azimuth, length = parameters[:, :1], parameters[:, -1:]
    coefficients = parameters[:, 1:-1]
    count = coefficients.shape[1]
    angle = coefficients @ _TURN_INNER[:count]
    side, along = _cumulate(np.sin(angle)), _cumulate(np.cos(angle))
    turned, bend = coefficients @ _TURN_ENDS[:count], coefficients @ _BASIS_ENDS[:count]
    return _planar(azimuth, turned, side * length, along * length, bend / length, _ENDS * length)


def _cumulate(values: Array) -> Array:
    """Integrals (B, M) from the start to each node of values (B, K) given at the quadrature's places."""
    panels = values.reshape(len(values), INTERVALS, -1) @ _WEIGHTS
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(panels, 1)], 1)


def _planar(azimuth: Array, angle: Array, side: Array, along: Array, curvature: Array, s: Array) -> Nodes:
    """Turn curves of the bending plane, (B, M) each, by their azimuths (B, 1)."""
    c, d = np.cos(azimuth), np.sin(azimuth)
    points = np.stack([c * side, d * side, along], -1)
    tangents = np.stack([c * np.sin(angle), d * np.sin(angle), np.cos(angle)], -1)
    inward = np.stack([c * np.cos(angle), d * np.cos(angle), -np.sin(angle)], -1) * curvature[..., None]
    return Nodes(points, tangents, inward, np.broadcast_to(s, side.shape))


def spatial_nodes(parameters: Array) -> Nodes:
    """Space curve whose two curvatures in a frame without twist are polynomials: ``(x0, y0, x1, y1, ..., length)``.

    Each of the intervals is an arc of the curvature at its middle (a rotation-minimising frame, Bishop 1975).
    """
    length = parameters[:, -1:]
    coefficients = parameters[:, :-1].reshape(len(parameters), -1, 2)
    count = coefficients.shape[1]
    bends = np.einsum("bkc,km->bmc", coefficients, _BASIS_MIDDLE[:count]) / INTERVALS
    batch = len(parameters)
    steps = _bend_rotation(bends.reshape(-1, 2)).reshape(batch, INTERVALS, 3, 3)
    angle = np.linalg.norm(bends, axis=-1)
    side = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    local = np.concatenate([bends * side[..., None], np.sinc(angle / np.pi)[..., None]], -1) / INTERVALS
    frame = np.broadcast_to(np.eye(3), (batch, 3, 3))
    frames = [frame]
    for k in range(INTERVALS):
        frame = frame @ steps[:, k]
        frames.append(frame)
    stack = np.stack(frames, 1)
    hops = np.einsum("bmij,bmj->bmi", stack[:, :-1], local) * length[..., None]
    points = np.concatenate([np.zeros((batch, 1, 3)), np.cumsum(hops, 1)], 1)
    bend = np.einsum("bkc,km->bmc", coefficients, _BASIS_ENDS[:count])
    curvature = np.einsum("bmij,bmj->bmi", stack[..., :2], bend) / length[..., None]
    return Nodes(points, stack[..., 2], curvature, _ENDS * length)


def bends_of_pieces(coefficients: Array, count: int) -> Array:
    """Bend vectors (count, 2) of equal pieces of a curve of `spatial_nodes` with coefficients (K, 2)."""
    turned = np.stack([p.integ(lbnd=0)(np.linspace(0.0, 1.0, count + 1)) for p in _POLYNOMIALS[: len(coefficients)]])
    return np.asarray(np.diff(turned, axis=1).T @ coefficients)


FAMILIES: dict[str, Family] = {
    "circle": Family("circle", 3, circle_nodes),
    "ellipse": Family("ellipse", 5, ellipse_nodes, soft=((3, 1.0),)),
    "polynomial2": Family("polynomial2", 5, polynomial_nodes),
    "polynomial3": Family("polynomial3", 6, polynomial_nodes),
    "arcs2": Family("arcs2", 6, pieces_nodes, soft=((4, 1.0),)),
    "spatial2": Family("spatial2", 7, spatial_nodes),
    "arcs3": Family("arcs3", 9, pieces_nodes, soft=((6, 1.0), (7, 1.0))),
    "spatial4": Family("spatial4", 11, spatial_nodes),
}
