"""Families of centrelines by a few parameters: what the silhouette fit chooses from.

A curve is a chain of `INTERVALS` short arcs. A family says by how much each of them turns (a vector across the tube, in
a frame without twist: Bishop 1975) and how long it is, with the derivatives of both by its parameters; the chain of the
arcs and its derivatives are the same for all families.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from tubesight.core import Array
from tubesight.geometry.pose import Pose

# Arcs of a curve: 3.3 mm on a 160 mm tube; it divides into the pieces of every family.
INTERVALS = 48
# Numbers of the base's own parameters after a family's: offset x, y in mm, tilts towards x, y in rad.
BASE = 4
# Places of the nodes as shares.
_ENDS = np.linspace(0.0, 1.0, INTERVALS + 1)
_HALVES = np.linspace(0.0, 1.0, 2 * INTERVALS + 1)
# Cubic B-splines of curvature: as many as bends of a quarter of the tube need, and as helices of three turns need.
SPLINE, FINE_SPLINE = 10, 18


def _basis() -> tuple[Array, Array]:
    """Shapes of curvature at the nodes (K, M + 1), with their integrals over each arc (K, M).

    In rows: Legendre polynomials of degree 0 to 4, then `SPLINE` and `FINE_SPLINE` B-splines.
    """
    legendre = [np.polynomial.legendre.Legendre.basis(k, domain=[0, 1]) for k in range(5)]
    ends = [np.stack([p(_ENDS) for p in legendre])]
    turned = [np.stack([p.integ(lbnd=0)(_ENDS) for p in legendre])]
    for count in (SPLINE, FINE_SPLINE):
        knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, count - 2), np.ones(3)])
        splines = BSpline(knots, np.eye(count), 3)
        ends.append(splines(_ENDS).T)
        turned.append(splines.antiderivative()(_ENDS).T)
    return np.concatenate(ends), np.diff(np.concatenate(turned), axis=1)


BASIS_ENDS, BASIS_TURNS = _basis()
# What the first guess of an ellipse is held to: least turn from which it is told, least curvature as a share of the
# largest, and a ratio of axes of 4.4 to 1.
_TURN_MIN, _LEAST_CURVATURE, _TANH_MAX = 0.03, 0.1, 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Arcs of a curve and their derivatives by the P parameters of its family.

    Attributes
    ----------
    turns
        (M, 2) rad, towards x and y of the frame that is carried along.
    lengths
        (M,) mm.
    curvature
        (M + 1, 2) at the nodes, 1 / mm.
    skew
        (M, 2) rad by which each chord leans against its arc's since curvature changes along it.
    d_turns
        (M, 2, P)
    d_lengths
        (M, P) relative: of the logarithm.
    """

    turns: Array
    lengths: Array
    curvature: Array
    skew: Array
    d_turns: Array
    d_lengths: Array


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """A curve at its nodes.

    Attributes
    ----------
    points, tangents, curvature
        (M, 3) each, millimetres, unit, 1 / mm; the curvature is the vector dt/ds.
    s_mm
        (M,) arc length.
    d_points, d_turn
        (M, 3, P) derivatives by the parameters of the family and of the base: of the points, and the rotation vectors
        by which the frame there turns.
    d_s
        (M, P) of the arc length.
    """

    points: Array
    tangents: Array
    curvature: Array
    s_mm: Array
    d_points: Array
    d_turn: Array
    d_s: Array

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array, Array, Array]:
        """All but the curvature: points, tangents, arc length, and the three derivatives."""
        return self.points, self.tangents, self.s_mm, self.d_points, self.d_turn, self.d_s


@dataclass(frozen=True, slots=True)
class Family:
    """A family of curves.

    Attributes
    ----------
    name
        As reported.
    kind
        Number of its chain (`CHAINS`).
    count
        Number of parameters; the last one is the length in mm, the others are angles in radians or pure numbers.
    soft
        Indices of parameters that the data may leave open (shares of pieces, ratios of axes), each with the deviation
        from 0 that is expected of it.
    """

    name: str
    kind: int
    count: int
    soft: tuple[tuple[int, float], ...] = ()


def ellipse_chain(p: Array) -> Chain:
    """Plane arc of an ellipse ``(bx, by, ex, ey, length)``: bend vector in rad, and how it differs from a circle.

    By its turning angle psi an ellipse has the radius of curvature ``(cosh q - sinh q cos(2 psi + 2 psi0))^(-3/2)`` up
    to scale, q the logarithm of the ratio of its axes. With ``e = q (cos 2 psi0, sin 2 psi0)`` this is regular at the
    circle e = 0, and the same for both names of the axes. Arcs turn evenly; their lengths differ.
    """
    bend, e, length = p[:2], p[2:4], p[4]
    theta, q = float(np.hypot(*bend)), float(np.hypot(*e))
    cosh = np.cosh(q)
    sinhc = np.sinh(q) / q if q > 1e-3 else 1 + q * q / 6
    slope = (cosh - sinhc) / (q * q) if q > 1e-3 else 1 / 3
    c, s = np.cos(2 * theta * _HALVES), np.sin(2 * theta * _HALVES)
    wave = e[0] * c - e[1] * s
    d = cosh - sinhc * wave
    radius = d**-1.5
    d_d = [(sinhc - slope * wave) * e[0] - sinhc * c, (sinhc - slope * wave) * e[1] + sinhc * s]
    d_theta = 2 * _HALVES * sinhc * (e[0] * s + e[1] * c)
    along = bend / theta if theta > 0 else np.zeros(2)
    relative = -1.5 * radius / d * np.stack([d_theta * along[0], d_theta * along[1], *d_d])
    share, d_share = _simpson(radius), _simpson(relative)
    lengths = length * share / share.sum()
    d_lengths = np.zeros((INTERVALS, 5))
    d_lengths[:, :4] = (d_share / share - d_share.sum(1, keepdims=True) / share.sum()).T
    d_lengths[:, 4] = 1 / length
    per_share = length * radius[::2] / share.sum() / INTERVALS
    curvature = bend / (INTERVALS * INTERVALS * per_share[:, None])
    d_turns = np.zeros((INTERVALS, 2, 5))
    d_turns[:, 0, 0] = d_turns[:, 1, 1] = 1 / INTERVALS
    turns = np.broadcast_to(bend / INTERVALS, (INTERVALS, 2))
    return Chain(turns, lengths, curvature, _skew(curvature, lengths), d_turns, d_lengths)


def _simpson(values: Array) -> Array:
    """Means (..., M) over each arc of values (..., 2 M + 1) at its ends and middle."""
    return np.asarray((values[..., :-1:2] + 4 * values[..., 1::2] + values[..., 2::2]) / 6)


def _skew(curvature: Array, lengths: Array) -> Array:
    """Lean (M, 2) of the chords: a curvature that changes by c over a length h turns the chord by -c h / 12."""
    return np.asarray(-np.diff(curvature, axis=0) * lengths[:, None] / 12)


def pieces_chain(p: Array) -> Chain:
    """Circular arcs end to end with common tangents: bend vectors of each, lengths as shares, total length.

    ``(bx1, by1, ..., bxn, byn, l1, ..., l(n-1), length)`` where l are logits of the shares against the last piece. The
    circle is one piece; straight is its zero vector.
    """
    size = len(p)
    count = size // 3
    per_piece = INTERVALS // count
    piece = np.arange(INTERVALS) // per_piece
    bends = p[: 2 * count].reshape(count, 2)
    weights = np.exp(np.append(p[2 * count : -1], 0.0))
    share = weights / weights.sum()
    d_turns = np.zeros((INTERVALS, 2, size))
    rows = np.arange(INTERVALS)
    d_turns[rows, 0, 2 * piece] = d_turns[rows, 1, 2 * piece + 1] = 1 / per_piece
    d_lengths = np.zeros((INTERVALS, size))
    for k in range(count - 1):
        d_lengths[:, 2 * count + k] = (piece == k) - share[k]
    d_lengths[:, -1] = 1 / p[-1]
    at_node = np.append(0, piece)
    curvature = bends[at_node] / (share[at_node] * p[-1])[:, None]
    lengths = share[piece] * p[-1] / per_piece
    return Chain(bends[piece] / per_piece, lengths, curvature, np.zeros((INTERVALS, 2)), d_turns, d_lengths)


def polynomial_chain(p: Array) -> Chain:
    """Plane curve of polynomial curvature: ``(azimuth, c0, ..., cn, length)``, Legendre, cn in rad of total turn."""
    count = len(p) - 2
    way = np.array([np.cos(p[0]), np.sin(p[0])])
    basis = BASIS_TURNS[:count]
    turn = p[1:-1] @ basis
    d_turns = np.zeros((INTERVALS, 2, len(p)))
    d_turns[:, 0, 0], d_turns[:, 1, 0] = -way[1] * turn, way[0] * turn
    d_turns[:, :, 1:-1] = basis.T[:, None, :] * way[:, None]
    curvature = (p[1:-1] @ BASIS_ENDS[:count])[:, None] * way / p[-1]
    return _even(turn[:, None] * way, curvature, d_turns, p[-1])


def spatial_chain(p: Array) -> Chain:
    """Space curve whose two curvatures in a frame without twist are sums of a basis: ``(x0, y0, x1, y1, ..., length)``.

    The basis goes by the number of coefficients: `SPLINE` or `FINE_SPLINE` B-splines, else Legendre polynomials.
    """
    count = len(p) // 2
    ends, turned = (basis[first_of(count) : first_of(count) + count] for basis in (BASIS_ENDS, BASIS_TURNS))
    coefficients = p[:-1].reshape(count, 2)
    d_turns = np.zeros((INTERVALS, 2, len(p)))
    d_turns[:, 0, 0:-1:2] = d_turns[:, 1, 1::2] = turned.T
    return _even(turned.T @ coefficients, ends.T @ coefficients / p[-1], d_turns, p[-1])


def first_of(count: int) -> int:
    """Row of the basis at which that of a curve with `count` coefficients for each curvature begins."""
    return {SPLINE: 5, FINE_SPLINE: 5 + SPLINE}.get(count, 0)


def _even(turns: Array, curvature: Array, d_turns: Array, length: float) -> Chain:
    """Chain of arcs of equal length."""
    lengths = np.full(INTERVALS, length / INTERVALS)
    d_lengths = np.zeros((INTERVALS, d_turns.shape[2]))
    d_lengths[:, -1] = 1 / length
    return Chain(turns, lengths, curvature, _skew(curvature, lengths), d_turns, d_lengths)


CHAINS: tuple[Callable[[Array], Chain], ...] = (pieces_chain, ellipse_chain, polynomial_chain, spatial_chain)

FAMILIES: dict[str, Family] = {
    "circle": Family("circle", 0, 3),
    "ellipse": Family("ellipse", 1, 5, soft=((2, 1.0), (3, 1.0))),
    "polynomial2": Family("polynomial2", 2, 5),
    "polynomial3": Family("polynomial3", 2, 6),
    "arcs2": Family("arcs2", 0, 6, soft=((4, 1.0),)),
    "spatial2": Family("spatial2", 3, 7),
    "arcs3": Family("arcs3", 0, 9, soft=((6, 1.0), (7, 1.0))),
    "spatial4": Family("spatial4", 3, 11),
    "arcs4": Family("arcs4", 0, 12, soft=((8, 1.0), (9, 1.0), (10, 1.0))),
    "arcs6": Family("arcs6", 0, 18, soft=tuple((k, 1.0) for k in range(12, 17))),
    "spline": Family("spline", 3, 2 * SPLINE + 1),
    "fine_spline": Family("fine_spline", 3, 2 * FINE_SPLINE + 1),
}


def bend_rotation(bend: Array) -> Array:
    """Rotations (..., 3, 3) that turn +z towards the bend vectors (..., 2) without twist."""
    x, y = bend[..., 0], bend[..., 1]
    angle = np.hypot(x, y)
    a, b = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    rows = [
        np.stack([1 - b * x * x, -b * x * y, a * x], -1),
        np.stack([-b * x * y, 1 - b * y * y, a * y], -1),
        np.stack([-a * x, -a * y, np.cos(angle)], -1),
    ]
    return np.stack(rows, -2)


def nodes_of(family: Family, parameters: Array, start: Pose) -> Nodes:
    """Nodes of a curve and their derivatives.

    A parameter that turns the arcs at sigma by ``d beta`` turns all that follows: ``d theta = int F (-d beta_y,
    d beta_x, 0)`` and ``d p = int d theta x t + t d log(length)``, F the frame carried along.

    Parameters
    ----------
    parameters
        Of the family, then of the base (`BASE`).
    start
        ``base_from_start``: where the curve starts before the base's own parameters.
    """
    count = family.count
    chain = CHAINS[family.kind](parameters[:count])
    x, y = chain.turns.T
    angle = np.hypot(x, y)
    side = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    local = np.stack([x * side + chain.skew[:, 0], y * side + chain.skew[:, 1], np.sinc(angle / np.pi)], -1)
    frames = np.empty((INTERVALS + 1, 3, 3))
    frames[0] = start.rotation @ bend_rotation(parameters[count + 2 : count + 4])
    for k, step in enumerate(bend_rotation(chain.turns)):
        frames[k + 1] = frames[k] @ step
    chords = np.einsum("mij,mj->mi", frames[:-1], local) * chain.lengths[:, None]
    origin = start.translation_mm + start.rotation[:, :2] @ parameters[count : count + 2]
    points = origin + np.concatenate([np.zeros((1, 3)), np.cumsum(chords, 0)])
    curvature = np.einsum("mij,mj->mi", frames[..., :2], chain.curvature)
    size = count + BASE
    d_turn, d_points = np.zeros((INTERVALS + 1, 3, size)), np.zeros((INTERVALS + 1, 3, size))
    d_points[0, :, count], d_points[0, :, count + 1] = start.rotation[:, 0], start.rotation[:, 1]
    d_turn[0, :, count + 2], d_turn[0, :, count + 3] = start.rotation[:, 1], -start.rotation[:, 0]
    middle = (frames[:-1] + frames[1:]) / 2
    across = np.stack([middle[:, :, 1], -middle[:, :, 0]], -1)
    d_turn[1:, :, :count] = np.einsum("mik,mkp->mip", across, chain.d_turns)
    d_turn = np.cumsum(d_turn, 0)
    lever = np.cross((d_turn[:-1] + d_turn[1:]) / 2, chords[:, :, None], axis=1)
    d_points[1:] = lever
    d_points[1:, :, :count] += chords[:, :, None] * chain.d_lengths[:, None]
    d_s = np.zeros((INTERVALS + 1, size))
    d_s[1:, :count] = np.cumsum(chain.lengths[:, None] * chain.d_lengths, 0)
    s = np.concatenate([[0.0], np.cumsum(chain.lengths)])
    return Nodes(points, frames[..., 2], curvature, s, np.cumsum(d_points, 0), d_turn, d_s)


def bends_of_pieces(coefficients: Array, count: int) -> Array:
    """Bend vectors (count, 2) of equal pieces of a curve of `spatial_chain` with coefficients (K, 2)."""
    first = first_of(len(coefficients))
    turns = BASIS_TURNS[first : first + len(coefficients)].T @ coefficients
    return np.asarray(turns.reshape(count, -1, 2).sum(1))


def spatial_like(turns: Array, length_mm: float, count: int) -> Array:
    """Parameters (2 count + 1,) of `spatial_chain` nearest to a curve whose arcs turn by `turns` (M, 2)."""
    first = first_of(count)
    coefficients = np.linalg.lstsq(BASIS_TURNS[first : first + count].T, turns, rcond=None)[0]
    return np.append(coefficients.ravel(), length_mm)


def turns_of(tangents: Array, start: Pose) -> Array:
    """By how much (M, 2) the arcs of a curve turn, from its unit tangents (M + 1, 3) at the nodes.

    The rotation without twist from t to u carries a vector x across t to ``x - (u . x) / (1 + t . u) (t + u)``.

    Parameters
    ----------
    start
        ``base_from_start``: its x axis, carried along without twist, is the first of the two ways across the curve.
    """
    along = np.concatenate([start.rotation[:, 2:].T, tangents])
    both = along[:-1] + along[1:]
    steps = (both / (1 + (along[:-1] * along[1:]).sum(1, keepdims=True))).tolist()
    x = tuple(start.rotation[:, 0].tolist())
    sides = []
    for (sx, sy, sz), (ux, uy, uz) in zip(steps, along[1:].tolist(), strict=True):
        by = ux * x[0] + uy * x[1] + uz * x[2]
        x = (x[0] - by * sx, x[1] - by * sy, x[2] - by * sz)
        sides.append(x)
    one = np.array(sides)[:-1]
    other = np.cross(tangents[:-1], one)
    across = np.stack([(tangents[1:] * one).sum(1), (tangents[1:] * other).sum(1)], 1)
    size = np.hypot(across[:, 0], across[:, 1])
    angle = np.arctan2(size, (tangents[1:] * tangents[:-1]).sum(1))
    return np.asarray(across * np.divide(angle, size, out=np.ones(len(size)), where=size > 0)[:, None])


def ellipse_like(polynomial: Array) -> Array:
    """Parameters (5,) of `ellipse_chain` with the curvature of a curve of `polynomial_chain` at start, middle and end.

    By the turning angle psi, ``curvature^(2/3)`` of an ellipse is proportional to ``1 - u cos(2 psi) + v sin(2 psi)``
    with ``(u, v) = tanh(q) (cos 2 psi0, sin 2 psi0)``. Curvatures that no ellipse has are brought into range.
    """
    at = [0, INTERVALS // 2, INTERVALS]
    coefficients = polynomial[1:-1]
    turned = np.append(0.0, np.cumsum(coefficients @ BASIS_TURNS[: len(coefficients)]))
    theta = float(turned[-1])
    curvature = coefficients @ BASIS_ENDS[: len(coefficients), at] * np.sign(theta)
    e = np.zeros(2)
    if abs(theta) > _TURN_MIN and curvature.max() > 0:
        level = np.maximum(curvature, _LEAST_CURVATURE * curvature.max()) ** (2 / 3)
        angle = 2 * np.abs(turned[at])
        k, ku, kv = np.linalg.solve(np.stack([np.ones(3), -np.cos(angle), np.sin(angle)], 1), level)
        size = float(np.hypot(ku, kv))
        tanh = min(size / k, _TANH_MAX) if k > 0 else _TANH_MAX
        e = np.arctanh(tanh) * np.array([ku, kv]) / max(size, 1e-300)
    return np.array([theta * np.cos(polynomial[0]), theta * np.sin(polynomial[0]), *e, polynomial[-1]])
