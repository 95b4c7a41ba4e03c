"""Lines, circles and ellipses through measured points in space."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.geometry.conic import fit_halir_flusser
from tubesight.geometry.curve import Arc, EllipseArc
from tubesight.geometry.pose import Pose


def clamped_arc(tip_mm: Array) -> Arc:
    """Arc that leaves the origin along +z and ends in a point.

    ``theta = 2 atan2(hypot(x, y), z)``, ``kappa = 2 sin(theta / 2) / |tip|``, length ``theta / kappa``; the straight line is the
    limit theta = 0.

    Parameters
    ----------
    tip_mm
        (3,), not the origin.

    Raises
    ------
    ValueError
        If the tip is the origin, or lies on the -z axis (no arc leads there).
    """
    x, y, z = (float(c) for c in tip_mm)
    side, chord = float(np.hypot(x, y)), float(np.linalg.norm(tip_mm))
    theta = 2 * float(np.arctan2(side, z))
    if chord == 0 or (side == 0 and z < 0):
        raise ValueError(f"no clamped arc ends in {tip_mm}")
    length = chord / float(np.sinc(theta / 2 / np.pi))
    direction = np.array([x, y]) / side if side > 0 else np.zeros(2)
    return Arc(direction * theta / length, length)


def bending_plane(points_mm: Array, weights: Array) -> Array:
    """Unit direction (2,) in the xy plane of the plane through the z axis that fits points (N, 3) best.

    The principal direction of their weighted second moment about the axis, signed towards the points.
    """
    xy = points_mm[:, :2]
    _, vectors = np.linalg.eigh((xy * weights[:, None]).T @ xy)
    direction = vectors[:, -1]
    return np.asarray(direction if weights @ (xy @ direction) >= 0 else -direction)


def clamped_ellipse(points_mm: Array, weights: Array, tip_mm: Array) -> EllipseArc:
    """Elliptic arc in a plane through the z axis that leaves the origin along +z.

    In the bending plane (rho, z) such a conic is ``A rho^2 + B rho z + C z^2 + D rho = 0``; its coefficients minimise the
    Sampson distance (two reweighted singular value problems).

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
    scale = float(np.abs(points_mm).max())
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
    return _ellipse_arc(conic, axes * scale, np.zeros(3), np.zeros(3), tip_mm)


def _ellipse_arc(conic: Array, axes_mm: Array, origin_mm: Array, start_mm: Array, tip_mm: Array) -> EllipseArc:
    """Turn a plane conic into the arc from `start_mm` to `tip_mm`; ``axes_mm`` (2, 3) span the plane with its scale."""
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
    start, end = (_nearest_parameter(middle, a, b, p) for p in (start_mm, tip_mm))
    # The shorter way round: a tube bends by less than half a turn.
    end = start + (end - start + np.pi) % (2 * np.pi) - np.pi
    return EllipseArc(middle, a, b, start, end)


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
    """Weighted plane of points (N, 3): centre (3,), in-plane axes (2, 3) with the first along the points, spreads (3,)."""
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

    It runs from the foot of the first point to that of the tip.

    Raises
    ------
    ValueError
        If the points lie on a line.
    """
    centre, axes, spread = free_plane(points_mm, weights)
    if spread[1] <= 1e-9 * spread[0]:
        raise ValueError("the points lie on a line; no circle passes through them")
    x, y = ((points_mm - centre) @ axes.T).T
    w = weights**2 / (weights**2).sum()
    z = x * x + y * y
    x0, y0, z0 = w @ x, w @ y, w @ z
    design = np.stack([(z - z0) / (2 * np.sqrt(z0)), x - x0, y - y0], 1) * np.sqrt(w)[:, None]
    _, _, vt = np.linalg.svd(design, full_matrices=False)
    a = vt[-1, 0] / (2 * np.sqrt(z0))
    if abs(a) * np.sqrt(z0) < 1e-12:
        raise ValueError("the points lie on a line; no circle passes through them")
    middle = -vt[-1, 1:] / (2 * a)
    d = -(a * z0 + vt[-1, 1] * x0 + vt[-1, 2] * y0)
    radius = float(np.sqrt(middle @ middle - d / a))
    foot = (np.stack([points_mm[0], tip_mm]) - centre) @ axes.T - middle
    start, end = np.arctan2(foot[:, 1], foot[:, 0])
    turn = (end - start + np.pi) % (2 * np.pi) - np.pi
    inward = -np.array([np.cos(start), np.sin(start)])
    along = np.sign(turn) * np.array([inward[1], -inward[0]])
    pose = _frame(centre + (middle - radius * inward) @ axes, along @ axes, inward @ axes)
    return Arc(np.array([1 / radius, 0.0]), abs(turn) * radius, pose)


def free_ellipse(points_mm: Array, weights: Array, tip_mm: Array) -> EllipseArc:
    """Elliptic arc through points (N, 3) in order: plane, then Halir-Flusser in it.

    Raises
    ------
    ValueError
        If the points lie on a line.
    """
    centre, axes, spread = free_plane(points_mm, weights)
    if spread[1] <= 1e-9 * spread[0]:
        raise ValueError("the points lie on a line; no ellipse passes through them")
    conic = fit_halir_flusser((points_mm - centre) @ axes.T).matrix
    return _ellipse_arc(conic, axes, centre, points_mm[0], tip_mm)


def _frame(start_mm: Array, along: Array, side: Array) -> Pose:
    """Pose of a curve's start: +z along the tube, +x to the side it bends."""
    z = along / np.linalg.norm(along)
    x = side - z * (side @ z)
    x /= np.linalg.norm(x)
    return Pose(np.stack([x, np.cross(z, x), z], 1), start_mm)
