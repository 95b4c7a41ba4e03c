"""Compiled twins of `tubesight.geometry.families`: chains of arcs, their nodes and derivatives."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.core.kernels import part
from tubesight.geometry.families import BASE, BASIS_ENDS, BASIS_TURNS, FINE_SPLINE, INTERVALS, SPLINE

PIECES, ELLIPSE, POLYNOMIAL, SPATIAL = range(4)
# Arrays of a chain and of its nodes, as in `Chain` and `Nodes`.
ChainArrays = tuple[Array, Array, Array, Array, Array, Array]
NodeArrays = tuple[Array, Array, Array, Array, Array, Array, Array]


@part
def empty_chain(count: int) -> ChainArrays:
    """Room for a chain of a family with `count` parameters."""
    m = INTERVALS
    return (
        np.zeros((m, 2)),
        np.zeros(m),
        np.zeros((m + 1, 2)),
        np.zeros((m, 2)),
        np.zeros((m, 2, count)),
        np.zeros((m, count)),
    )


@part
def empty_nodes(count: int) -> NodeArrays:
    """Room for the nodes of a curve of a family with `count` parameters."""
    m, size = INTERVALS + 1, count + BASE
    return (
        np.zeros((m, 3)),
        np.zeros((m, 3)),
        np.zeros((m, 3)),
        np.zeros(m),
        np.zeros((m, 3, size)),
        np.zeros((m, 3, size)),
        np.zeros((m, size)),
    )


@part
def ellipse_chain(p: Array, chain: ChainArrays) -> None:
    """Twin of `tubesight.geometry.families.ellipse_chain`."""
    turns, lengths, curvature, skew, d_turns, d_lengths = chain
    m = INTERVALS
    theta, q = np.hypot(p[0], p[1]), np.hypot(p[2], p[3])
    cosh = np.cosh(q)
    sinhc = np.sinh(q) / q if q > 1e-3 else 1 + q * q / 6
    slope = (cosh - sinhc) / (q * q) if q > 1e-3 else 1 / 3
    along_x, along_y = (p[0] / theta, p[1] / theta) if theta > 0 else (0.0, 0.0)
    radius = np.empty(2 * m + 1)
    relative = np.empty((2 * m + 1, 4))
    for i in range(2 * m + 1):
        u = i / (2 * m)
        c, s = np.cos(2 * theta * u), np.sin(2 * theta * u)
        wave = p[2] * c - p[3] * s
        d = cosh - sinhc * wave
        radius[i] = 1 / (d * np.sqrt(d))
        factor = -1.5 * radius[i] / d
        d_theta = factor * 2 * u * sinhc * (p[2] * s + p[3] * c)
        relative[i, 0], relative[i, 1] = d_theta * along_x, d_theta * along_y
        relative[i, 2] = factor * ((sinhc - slope * wave) * p[2] - sinhc * c)
        relative[i, 3] = factor * ((sinhc - slope * wave) * p[3] + sinhc * s)
    total = 0.0
    d_total = np.zeros(4)
    for i in range(m):
        lengths[i] = (radius[2 * i] + 4 * radius[2 * i + 1] + radius[2 * i + 2]) / 6
        total += lengths[i]
        for k in range(4):
            d_lengths[i, k] = (relative[2 * i, k] + 4 * relative[2 * i + 1, k] + relative[2 * i + 2, k]) / 6
            d_total[k] += d_lengths[i, k]
    for i in range(m + 1):
        per_share = m * p[4] * radius[2 * i] / total
        curvature[i, 0], curvature[i, 1] = p[0] / per_share, p[1] / per_share
    for i in range(m):
        for k in range(4):
            d_lengths[i, k] = d_lengths[i, k] / lengths[i] - d_total[k] / total
        d_lengths[i, 4] = 1 / p[4]
        lengths[i] *= p[4] / total
        turns[i, 0], turns[i, 1] = p[0] / m, p[1] / m
        d_turns[i, 0, 0] = d_turns[i, 1, 1] = 1 / m
    lean(curvature, lengths, skew)


@part
def lean(curvature: Array, lengths: Array, skew: Array) -> None:
    """Lean of the chords where curvature changes evenly over each arc."""
    for i in range(len(lengths)):
        for k in range(2):
            skew[i, k] = -(curvature[i + 1, k] - curvature[i, k]) * lengths[i] / 12


@part
def pieces_chain(p: Array, chain: ChainArrays) -> None:
    """Twin of `tubesight.geometry.families.pieces_chain`."""
    turns, lengths, curvature, _, d_turns, d_lengths = chain
    size = len(p)
    count = size // 3
    per_piece = INTERVALS // count
    share = np.empty(count)
    total = 1.0
    for k in range(count - 1):
        share[k] = np.exp(p[2 * count + k])
        total += share[k]
    share[count - 1] = 1.0
    for k in range(count):
        share[k] /= total
    for i in range(INTERVALS):
        piece = i // per_piece
        lengths[i] = share[piece] * p[size - 1] / per_piece
        for k in range(2):
            turns[i, k] = p[2 * piece + k] / per_piece
            curvature[i + 1, k] = p[2 * piece + k] / (share[piece] * p[size - 1])
            d_turns[i, k, 2 * piece + k] = 1 / per_piece
        for k in range(count - 1):
            d_lengths[i, 2 * count + k] = (1.0 if piece == k else 0.0) - share[k]
        d_lengths[i, size - 1] = 1 / p[size - 1]
    curvature[0, 0], curvature[0, 1] = curvature[1, 0], curvature[1, 1]


@part
def polynomial_chain(kind: int, p: Array, chain: ChainArrays) -> None:
    """Twin of `tubesight.geometry.families.polynomial_chain` and, by its kind, of `spatial_chain`."""
    turns, lengths, curvature, skew, d_turns, d_lengths = chain
    size = len(p)
    length = p[size - 1]
    first = 5 if size // 2 == SPLINE else 5 + SPLINE if size // 2 == FINE_SPLINE else 0
    for i in range(INTERVALS + 1):
        for k in range(2):
            curvature[i, k] = 0.0
            if i < INTERVALS:
                turns[i, k] = 0.0
        if kind == SPATIAL:
            for j in range(size // 2):
                for k in range(2):
                    curvature[i, k] += BASIS_ENDS[first + j, i] * p[2 * j + k] / length
                    if i < INTERVALS:
                        turns[i, k] += BASIS_TURNS[first + j, i] * p[2 * j + k]
                        d_turns[i, k, 2 * j + k] = BASIS_TURNS[first + j, i]
        else:
            way = (np.cos(p[0]), np.sin(p[0]))
            for j in range(size - 2):
                for k in range(2):
                    curvature[i, k] += BASIS_ENDS[j, i] * p[1 + j] * way[k] / length
                    if i < INTERVALS:
                        turns[i, k] += BASIS_TURNS[j, i] * p[1 + j] * way[k]
                        d_turns[i, k, 1 + j] = BASIS_TURNS[j, i] * way[k]
            if i < INTERVALS:
                d_turns[i, 0, 0], d_turns[i, 1, 0] = -turns[i, 1], turns[i, 0]
        if i < INTERVALS:
            lengths[i] = length / INTERVALS
            d_lengths[i, size - 1] = 1 / length
    lean(curvature, lengths, skew)


@part
def turn_by(x: float, y: float) -> tuple[float, float, float]:
    """``sin(t) / t``, ``(1 - cos(t)) / t^2`` and ``cos(t)`` of the angle t of a bend vector."""
    half = np.sqrt(x * x + y * y) / 2
    if half == 0.0:
        return 1.0, 0.5, 1.0
    s, c = np.sin(half), np.cos(half)
    return s * c / half, s * s / (2 * half * half), 1 - 2 * s * s


@part
def turn_frame(frame: Array, x: float, y: float, a: float, b: float, cos: float) -> None:
    """Multiply a frame by the rotation that turns +z towards (x, y) without twist; a, b, cos from `turn_by`."""
    for i in range(3):
        u, v, w = frame[i, 0], frame[i, 1], frame[i, 2]
        across = u * x + v * y
        frame[i, 0] = u - (b * across + a * w) * x
        frame[i, 1] = v - (b * across + a * w) * y
        frame[i, 2] = a * across + cos * w


@part
def nodes_of(
    kind: int,
    count: int,
    p: Array,
    start_rotation: Array,
    start_mm: Array,
    chain: ChainArrays,
    nodes: NodeArrays,
) -> None:
    """Twin of `tubesight.geometry.families.nodes_of`, written into `nodes`."""
    if kind == PIECES:
        pieces_chain(p[:count], chain)
    elif kind == ELLIPSE:
        ellipse_chain(p[:count], chain)
    else:
        polynomial_chain(kind, p[:count], chain)
    turns, lengths, curvatures, skew, d_turns, d_lengths = chain
    points, tangents, curvature, s, d_points, d_turn, d_s = nodes
    frame = start_rotation.copy()
    a, b, cos = turn_by(p[count + 2], p[count + 3])
    turn_frame(frame, p[count + 2], p[count + 3], a, b, cos)
    for c in range(3):
        points[0, c] = start_mm[c] + start_rotation[c, 0] * p[count] + start_rotation[c, 1] * p[count + 1]
        d_points[0, c, count], d_points[0, c, count + 1] = start_rotation[c, 0], start_rotation[c, 1]
        d_turn[0, c, count + 2], d_turn[0, c, count + 3] = start_rotation[c, 1], -start_rotation[c, 0]
        tangents[0, c] = frame[c, 2]
        curvature[0, c] = frame[c, 0] * curvatures[0, 0] + frame[c, 1] * curvatures[0, 1]
    across = np.empty((3, 2))
    for i in range(INTERVALS):
        x, y = turns[i, 0], turns[i, 1]
        a, b, cos = turn_by(x, y)
        u, v, w = (x * b + skew[i, 0]) * lengths[i], (y * b + skew[i, 1]) * lengths[i], a * lengths[i]
        for c in range(3):
            points[i + 1, c] = points[i, c] + (frame[c, 0] * u + frame[c, 1] * v + frame[c, 2] * w)
            across[c, 0], across[c, 1] = frame[c, 0] / 2, frame[c, 1] / 2
        turn_frame(frame, x, y, a, b, cos)
        for c in range(3):
            tangents[i + 1, c] = frame[c, 2]
            curvature[i + 1, c] = frame[c, 0] * curvatures[i + 1, 0] + frame[c, 1] * curvatures[i + 1, 1]
            across[c, 0] += frame[c, 0] / 2
            across[c, 1] += frame[c, 1] / 2
        s[i + 1] = s[i] + lengths[i]
        carry(i, count, across, points, lengths, d_turns, d_lengths, d_points, d_turn, d_s)


@part
def carry(
    i: int,
    count: int,
    across: Array,
    points: Array,
    lengths: Array,
    d_turns: Array,
    d_lengths: Array,
    d_points: Array,
    d_turn: Array,
    d_s: Array,
) -> None:
    """Carry derivatives from node i to node i + 1: the arc between turns and lengthens what follows."""
    u, v, w = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1], points[i + 1, 2] - points[i, 2]
    for q in range(count + BASE):
        x, y, z = d_turn[i, 0, q], d_turn[i, 1, q], d_turn[i, 2, q]
        grow = 0.0
        if q < count:
            tx, ty, grow = d_turns[i, 0, q], d_turns[i, 1, q], d_lengths[i, q]
            dx = across[0, 1] * tx - across[0, 0] * ty
            dy = across[1, 1] * tx - across[1, 0] * ty
            dz = across[2, 1] * tx - across[2, 0] * ty
            d_turn[i + 1, 0, q], d_turn[i + 1, 1, q], d_turn[i + 1, 2, q] = x + dx, y + dy, z + dz
            x, y, z = x + dx / 2, y + dy / 2, z + dz / 2
            d_s[i + 1, q] = d_s[i, q] + lengths[i] * grow
        else:
            d_turn[i + 1, 0, q], d_turn[i + 1, 1, q], d_turn[i + 1, 2, q] = x, y, z
        d_points[i + 1, 0, q] = d_points[i, 0, q] + y * w - z * v + u * grow
        d_points[i + 1, 1, q] = d_points[i, 1, q] + z * u - x * w + v * grow
        d_points[i + 1, 2, q] = d_points[i, 2, q] + x * v - y * u + w * grow
