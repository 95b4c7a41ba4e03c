"""Lines, circles and ellipses through measured points in space."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tubesight.core import Array, sealed
from tubesight.geometry.conic import fit_halir_flusser
from tubesight.geometry.curve import Arc, EllipseArc, NodeCurve
from tubesight.geometry.pose import Pose

# Ratio of spreads under which points in space lie on a line, so that rounding alone would choose their plane.
_LINE_RATIO = 1e-9
# An arc is longer than the way along its points by a few percent, by 1.57 where there is none on half a turn; a needle
# through the noise of a straight tube's points by 3 and more.
_WINDS = 1.6
# Nodes of each arc of a curve: a cubic Hermite piece of a quarter turn cut in 24 is 1e-8 of its length off.
_NODES = 25


def clamped_arc(tip_mm: Array) -> Arc:
    """Arc that leaves the origin along +z and ends in a point.

    ``theta = 2 atan2(hypot(x, y), z)``, ``kappa = 2 sin(theta / 2) / |tip|``, length ``theta / kappa``; the straight
    line is the limit theta = 0.

    Parameters
    ----------
    tip_mm
        (3,), not the origin.

    Raises
    ------
    ValueError
        If the tip is the origin, or lies on the -z axis (no arc leads there).
    """
    x, y, z = tip_mm.tolist()
    side, chord = math.hypot(x, y), math.hypot(x, y, z)
    half = math.atan2(side, z)
    if chord == 0 or (side == 0 and z < 0):
        raise ValueError(f"no clamped arc ends in {tip_mm}")
    length = chord * half / math.sin(half) if half > 0 else chord
    bend = 2 * half / (side * length) if side > 0 else 0.0
    return Arc(sealed(np.array([bend * x, bend * y])), length)


def tangent_arc(start: Pose, chord_mm: Array) -> Arc:
    """Arc that leaves a frame along its +z and ends at a point (3,) of that frame; see `clamped_arc`."""
    arc = clamped_arc(chord_mm)
    return Arc(arc.curvature_per_mm, arc.length_mm, start)


def end_of(arc: Arc) -> Pose:
    """Frame at the end of an arc, carried along it without twist."""
    axis = np.array([-arc.curvature_per_mm[1], arc.curvature_per_mm[0], 0.0])
    turned = Pose.from_rotvec(arc.length_mm * axis, np.zeros(3))
    return Pose((arc.start @ turned).rotation, arc.at([arc.length_mm])[0])


def joined(arcs: Sequence[Arc]) -> NodeCurve:
    """One curve of arcs, each of which starts where the one before it ends; arcs of no length are left out."""
    longer = [arc for arc in arcs if arc.length_mm > 0]
    if not longer:
        raise ValueError("arcs of no length do not make a curve")
    starts = np.concatenate([[0.0], np.cumsum([arc.length_mm for arc in longer])])
    s, points, tangents = [], [], []
    for first, (start, arc) in enumerate(zip(starts[:-1], longer, strict=True)):
        own = np.linspace(0.0, arc.length_mm, _NODES)[min(first, 1) :]
        s.append(start + own)
        points.append(arc.at(own))
        tangents.append(arc.tangent(own))
    return NodeCurve("arcs", np.concatenate(s), np.vstack(points), np.vstack(tangents))


def bending_plane(points_mm: Array, weights: Array) -> Array:
    """Find the plane through the z axis that fits points (N, 3) best: its unit direction (2,) in the xy plane.

    The principal direction of their weighted second moment about the axis, signed towards the points.
    """
    xy = points_mm[:, :2]
    _, vectors = np.linalg.eigh((xy * weights[:, None]).T @ xy)
    direction = vectors[:, -1]
    return np.asarray(direction if weights @ (xy @ direction) >= 0 else -direction)


def clamped_ellipse(points_mm: Array, weights: Array, tip_mm: Array) -> EllipseArc:
    """Elliptic arc in a plane through the z axis that leaves the origin along +z.

    In the bending plane (rho, z) such a conic is ``A rho^2 + B rho z + C z^2 + D rho = 0``; its coefficients minimise
    the Sampson distance (two reweighted singular value problems).

    Parameters
    ----------
    points_mm, weights
        (N, 3) and (N,) inverse standard deviations.
    tip_mm
        (3,) the curve ends at its point nearest to the tip.

    Raises
    ------
    ValueError
        If the best conic is not an ellipse.
    """
    direction = bending_plane(points_mm, weights**2)
    scale = float(np.linalg.norm(points_mm, axis=1).max())
    rho, z = points_mm[:, :2] @ direction / scale, points_mm[:, 2] / scale
    design = np.stack([rho * rho, rho * z, z * z, rho], 1)
    weight = weights.copy()
    for _ in range(3):
        _, _, vt = np.linalg.svd(design * weight[:, None], full_matrices=False)
        a, b, c, d = vt[-1]
        slope = np.hypot(2 * a * rho + b * z + d, b * rho + 2 * c * z)
        weight = weights / np.maximum(slope, 1e-6 * slope.max())
    conic = np.array([[a, b / 2, d / 2], [b / 2, c, 0], [d / 2, 0, 0]])
    axes = np.array([[*direction, 0.0], [0.0, 0.0, 1.0]])
    return _ellipse_arc(conic, axes * scale, np.zeros(3), np.vstack([np.zeros(3), points_mm, tip_mm]))


def _ellipse_arc(conic: Array, axes_mm: Array, origin_mm: Array, along_mm: Array) -> EllipseArc:
    """Turn a plane conic into the arc from the first to the last of the points `along_mm` (N, 3), the way they run.

    ``axes_mm`` (2, 3) span the plane with its scale, from `origin_mm`.
    """
    if np.linalg.det(conic[:2, :2]) <= 0:
        raise ValueError("the best quadratic curve is not an ellipse")
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = conic[2, 2] + conic[:2, 2] @ centre
    values, vectors = np.linalg.eigh(conic[:2, :2])
    squares = -level / values
    if not (squares > 0).all():
        raise ValueError("the best quadratic curve is not a real ellipse")
    semi = np.sqrt(squares)[:, None] * vectors.T
    a, b = semi @ axes_mm
    middle = origin_mm + centre @ axes_mm
    start, end = (_nearest_parameter(middle, a, b, p) for p in along_mm[[0, -1]])
    local = along_mm - middle
    way = np.unwrap(np.arctan2(local @ b / (b @ b), local @ a / (a @ a)))
    turn = float(way[-1] - way[0])
    arc = EllipseArc(middle, a, b, start, start + turn + _wrap(end - start - turn))
    if arc.length_mm > _WINDS * np.linalg.norm(np.diff(along_mm, axis=0), axis=1).sum():
        raise ValueError("the best ellipse winds around where the points run straight")
    return arc


def _wrap(angle_rad: float) -> float:
    """Shift an angle by whole turns to -pi ... pi."""
    return float(np.remainder(angle_rad + np.pi, 2 * np.pi) - np.pi)


def _nearest_parameter(centre: Array, a: Array, b: Array, point: Array) -> float:
    """Parameter t of the ellipse's point nearest to a point (N = 720 samples, then Newton on the derivative)."""
    t = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    d = centre + np.cos(t)[:, None] * a + np.sin(t)[:, None] * b - point
    best = float(t[(d * d).sum(1).argmin()])
    for _ in range(8):
        p = centre + np.cos(best) * a + np.sin(best) * b - point
        v = -np.sin(best) * a + np.cos(best) * b
        curvature = v @ v - p @ (np.cos(best) * a + np.sin(best) * b)
        if curvature <= 0:
            break
        best -= float(p @ v / curvature)
    return best


def free_plane(points_mm: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Fit a plane to points (N, 3): centre (3,), axes (2, 3) in it with the first along the points, spreads (3,)."""
    w = weights**2 / (weights**2).sum()
    centre = w @ points_mm
    _, spread, axes = np.linalg.svd((points_mm - centre) * np.sqrt(w)[:, None], full_matrices=False)
    first = axes[0] if axes[0] @ (points_mm[-1] - points_mm[0]) >= 0 else -axes[0]
    return centre, np.stack([first, axes[1]]), spread


def free_line(points_mm: Array, weights: Array, tip_mm: Array) -> Arc:
    """Line through points (N, 3) in order, from the foot of the first to that of the tip."""
    centre, axes, _ = free_plane(points_mm, weights)
    start = centre + axes[0] * float((points_mm[0] - centre) @ axes[0])
    return Arc(np.zeros(2), float((tip_mm - start) @ axes[0]), _frame(start, axes[0], axes[1]))


def free_arc(points_mm: Array, weights: Array, tip_mm: Array) -> Arc:
    """Circular arc through points (N, 3) in order: plane, then circle by Taubin's algebraic fit in it.

    It runs from the foot of the first point to that of the tip. The circle is kept as
    ``curvature / 2 |p|^2 + n . p + c = 0``, which stays regular where it straightens into a line.

    Raises
    ------
    ValueError
        If the points lie on a line (no plane is fixed then).
    """
    centre, axes, spread = free_plane(points_mm, weights)
    if spread[1] <= _LINE_RATIO * spread[0]:
        raise ValueError("the points lie on a line; no circle passes through them")
    p = (np.vstack([points_mm, tip_mm]) - centre) @ axes.T
    half, normal, constant = _taubin_circle(p[:-1], weights**2 / (weights**2).sum())
    inward = -(normal + 2 * half * p)
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    level = half * (p * p).sum(1) + p @ normal + constant
    foot = p + (2 * level / (1 + np.sqrt(np.maximum(1 + 4 * half * level, 0))))[:, None] * inward
    turns = np.unwrap(np.arctan2(inward[:, 1], inward[:, 0]))
    turn = float(turns[-1] - turns[0])
    chord = foot[-1] - foot[0]
    # The chord of an arc makes half its turn with the tangent at its start.
    cos, sin = np.cos(turn / 2), np.sin(turn / 2)
    along = np.array([[cos, sin], [-sin, cos]]) @ chord * np.sign(np.sinc(turn / (2 * np.pi)))
    length = float(np.linalg.norm(chord) / abs(np.sinc(turn / (2 * np.pi))))
    return Arc(np.array([2 * half, 0.0]), length, _frame(centre + foot[0] @ axes, along @ axes, inward[0] @ axes))


def _taubin_circle(xy: Array, share: Array) -> tuple[float, Array, float]:
    """Fit the circle ``a |p|^2 + n . p + c = 0``, ``|n|^2 - 4 a c = 1``, a >= 0 half its curvature; shares sum to 1."""
    square = (xy * xy).sum(1)
    mean, mean_square = share @ xy, float(share @ square)
    design = np.column_stack([(square - mean_square) / (2 * np.sqrt(mean_square)), xy - mean]) * np.sqrt(share)[:, None]
    best = np.linalg.svd(design, full_matrices=False)[2][-1]
    a, normal = float(best[0]) / (2 * np.sqrt(mean_square)), best[1:]
    constant = -(a * mean_square + float(normal @ mean))
    size = np.sqrt(normal @ normal - 4 * a * constant) * (1 if a >= 0 else -1)
    return a / size, normal / size, constant / size


def free_ellipse(points_mm: Array, weights: Array, tip_mm: Array) -> EllipseArc:
    """Elliptic arc through points (N, 3) in order: plane, then Halir-Flusser in it.

    Raises
    ------
    ValueError
        If the points lie on a line.
    """
    centre, axes, spread = free_plane(points_mm, weights)
    if spread[1] <= _LINE_RATIO * spread[0]:
        raise ValueError("the points lie on a line; no ellipse passes through them")
    conic = fit_halir_flusser((points_mm - centre) @ axes.T).matrix
    return _ellipse_arc(conic, axes, centre, np.vstack([points_mm, tip_mm]))


def _frame(start_mm: Array, along: Array, side: Array) -> Pose:
    """Pose of a curve's start: +z along the tube, +x to the side it bends."""
    z = along / np.linalg.norm(along)
    x = side - z * (side @ z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z], 1), start_mm)
