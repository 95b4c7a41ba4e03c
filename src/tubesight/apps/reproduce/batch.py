"""The closed form on many sets of points at once: whole arrays of trials in place of one reconstruction after another.

Each function is the batched twin of one in `tubesight.geometry` or `tubesight.methods`, by scatter matrices: with noise
of millimetres the digits that they lose against singular values do not count. Arrays are (B, N, ...) for B trials of N
points; a point that is not there is NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Mask
from tubesight.geometry.pose import Pose

# Fewest points that fix plane and circle with some to spare, as in `tubesight.methods.dalvand`.
_POINTS_MIN = 5
# Gauss-Legendre nodes for the length of an elliptic arc: 1e-9 of it for half an ellipse with a ratio of axes of 4.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
# Newton steps to the foot of a point on an ellipse.
_FOOT_STEPS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """What is reported of B trials; NaN where a trial failed.

    Attributes
    ----------
    tip_mm
        (B, 3)
    bending_rad, orientation_rad, length_mm
        (B,)
    """

    tip_mm: Array
    bending_rad: Array
    orientation_rad: Array
    length_mm: Array


def _form(vectors: Array, matrix: Array, others: Array) -> Array:
    """``v^T C w`` of vectors (B, N, 3) and w, matrices (B, 3, 3): (B, N)."""
    return np.asarray(((vectors @ matrix) * others).sum(-1))


def _principal(xy: Array) -> tuple[Array, Array]:
    """Points in the frame of their principal axes at unit spread (B, N, 2), NaN as 0, and the frame (B, 3, 3)."""
    there = np.isfinite(xy[..., 0])
    count = np.maximum(there.sum(1), 1)[:, None]
    p = np.where(there[..., None], xy, 0.0)
    mean = p.sum(1) / count
    p = np.where(there[..., None], p - mean[:, None], 0.0)
    values, axes = np.linalg.eigh(np.swapaxes(p, 1, 2) @ p)
    scale = np.sqrt(count / np.maximum(values[:, ::-1], 1e-300))
    linear = np.swapaxes(axes[:, :, ::-1], 1, 2) * scale[:, :, None]
    frame = np.zeros((len(xy), 3, 3))
    frame[:, :2, :2], frame[:, 2, 2] = linear, 1.0
    frame[:, :2, 2] = -(linear @ mean[..., None])[..., 0]
    return p @ np.swapaxes(linear, 1, 2), frame


def ellipses(xy: Array) -> Array:
    """Halir and Flusser's ellipse through each set of points (B, N, 2): conics (B, 3, 3)."""
    p, frame = _principal(xy)
    there = np.isfinite(xy[..., 0]).astype(float)
    x, y = p[..., 0], p[..., 1]
    quadratic, linear = np.stack([x * x, x * y, y * y], -1), np.stack([x, y, there], -1)
    transposed = np.swapaxes(linear, 1, 2)
    mixed = transposed @ quadratic
    rest = -np.linalg.solve(transposed @ linear, mixed)
    m = np.swapaxes(quadratic, 1, 2) @ quadratic + np.swapaxes(mixed, 1, 2) @ rest
    _, vectors = np.linalg.eig(np.stack([m[:, 2] / 2, -m[:, 1], m[:, 0] / 2], 1))
    vectors = np.real(vectors)
    positive = 4 * vectors[:, 0] * vectors[:, 2] - vectors[:, 1] ** 2
    best = np.take_along_axis(vectors, positive.argmax(1)[:, None, None], 2)
    return _conics(np.concatenate([best, rest @ best], 1)[..., 0], frame)


def parabolas(xy: Array) -> Array:
    """Fit the parabola over the long principal axis of each set of points (B, N, 2): conics (B, 3, 3)."""
    p, frame = _principal(xy)
    x, y = p[..., 0], p[..., 1]
    design = np.stack([np.ones_like(x), x, x * x], -1)
    transposed = np.swapaxes(design, 1, 2)
    a, b, c = np.linalg.solve(transposed @ design, transposed @ y[..., None])[..., 0].T
    zero = np.zeros_like(a)
    return _conics(np.stack([c, zero, zero, b, zero - 1, a], 1), frame)


def _conics(coefficients: Array, frame: Array) -> Array:
    """Matrices of ``a x^2 + b x y + c y^2 + d x + e y + f`` (B, 6) in frames, carried to the image plane."""
    a, b, c, d, e, f = coefficients.T
    rows = [[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]]
    matrix = np.stack([np.stack(row, -1) for row in rows], 1)
    made = np.swapaxes(frame, 1, 2) @ matrix @ frame
    return np.asarray(made / np.linalg.norm(made, axis=(1, 2), keepdims=True))


def nearest_depths(
    conics: Array, cone_from_ray: Pose, rays: Array, base_depth_mm: float, missed: bool = False
) -> Array:
    """Depths (B, N) at which rays (B, N, 3) meet the cones, chosen by equation 10; NaN where they miss.

    Twin of `tubesight.geometry.cone.Cone.intersect` with `nearest_depth`. With `missed` a ray that misses its cone is
    given the depth at which it comes closest to it: equation 9 with a root of 0.
    """
    a = rays @ cone_from_ray.rotation.T
    b = np.broadcast_to(cone_from_ray.translation_mm, (len(rays), 1, 3))
    square, half, constant = _form(a, conics, a), _form(a, conics, b), _form(b, conics, b)
    with np.errstate(invalid="ignore", divide="ignore"):
        inside = half * half - square * constant
        root = np.sqrt(np.maximum(inside, 0.0) if missed else inside)
        q = -(half + np.where(half >= 0, root, -root))
        both = np.stack([q / square, constant / q], -1)
        in_front = (both > 0) & (a[..., 2:] * both + cone_from_ray.translation_mm[2] > 0)
        off = np.where(in_front, np.abs(both - base_depth_mm), np.inf)
    chosen = np.take_along_axis(both, off.argmin(-1)[..., None], -1)[..., 0]
    return np.where(np.isfinite(off.min(-1)), chosen, np.nan)


def curvatures(xy: Array) -> Array:
    """Curvature (B,) of point sets (B, N, 2) as the paper compares it: 8 s / c^2, chord c and sagitta s."""
    chord, off = xy[:, -1] - xy[:, 0], xy - xy[:, :1]
    squared = (chord * chord).sum(1)
    sagitta = np.abs(off[..., 0] * chord[:, None, 1] - off[..., 1] * chord[:, None, 0]).max(1) / np.sqrt(squared)
    return np.asarray(8 * sagitta / squared)


def circles(points_mm: Array) -> Shapes:
    """Plane and circle through each set of points (B, N, 3) in order, from the foot of the first to that of the last.

    Twin of `tubesight.geometry.arcs.free_arc`. The last point has to be there.
    """
    p, centre, axes, enough = _in_planes(points_mm)
    there = np.isfinite(p[..., 0])
    count = np.maximum(there.sum(1), 1)
    q = np.where(there[..., None], p, 0.0)
    square = (q * q).sum(-1)
    mean_square = square.sum(1) / count
    size = 2 * np.sqrt(mean_square)
    design = np.stack([np.where(there, square - mean_square[:, None], 0.0) / size[:, None], q[..., 0], q[..., 1]], -1)
    best = np.linalg.eigh(np.swapaxes(design, 1, 2) @ design)[1][:, :, 0]
    a, normal = best[:, 0] / size, best[:, 1:]
    constant = -a * mean_square
    norm = np.sqrt((normal * normal).sum(1) - 4 * a * constant) * np.where(a >= 0, 1, -1)
    half, normal, constant = a / norm, normal / norm[:, None], constant / norm
    inward = -(normal[:, None] + 2 * half[:, None, None] * p)
    inward /= np.linalg.norm(inward, axis=-1, keepdims=True)
    level = half[:, None] * (p * p).sum(-1) + (p @ normal[..., None])[..., 0] + constant[:, None]
    with np.errstate(invalid="ignore"):
        reach = np.sqrt(np.maximum(1 + 4 * half[:, None] * level, 0))
    foot = p + (2 * level / (1 + reach))[..., None] * inward
    turn = _turned(np.arctan2(inward[..., 1], inward[..., 0]))
    first = _first(foot)
    chord = np.linalg.norm(foot[:, -1] - first, axis=1)
    length = chord / np.abs(np.sinc(turn / (2 * np.pi)))
    return _reported(centre + (foot[:, -1, None] @ axes)[:, 0], np.abs(turn), length, enough)


def elliptic_arcs(points_mm: Array) -> Shapes:
    """Plane and ellipse through each set of points (B, N, 3): twin of `tubesight.geometry.arcs.free_ellipse`."""
    p, centre, axes, enough = _in_planes(points_mm)
    conic = ellipses(p)
    middle = -np.linalg.solve(conic[:, :2, :2], conic[:, :2, 2:])[..., 0]
    level = conic[:, 2, 2] + (conic[:, :2, 2] * middle).sum(1)
    values, vectors = np.linalg.eigh(conic[:, :2, :2])
    with np.errstate(invalid="ignore", divide="ignore"):
        semi = np.sqrt(-level[:, None] / values)
    local = (p - middle[:, None]) @ vectors
    way = np.arctan2(local[..., 1] / semi[:, None, 1], local[..., 0] / semi[:, None, 0])
    turn = _turned(way)
    start, end = (_foot(semi, point) for point in (_first(local), local[:, -1]))
    swept = turn + np.remainder(end - start - turn + np.pi, 2 * np.pi) - np.pi
    at = start[:, None] + swept[:, None] * (_NODES + 1) / 2
    speed = np.hypot(semi[:, :1] * np.sin(at), semi[:, 1:] * np.cos(at))
    length = np.abs(swept) / 2 * (speed @ _WEIGHTS)
    tangents = [np.stack([-semi[:, 0] * np.sin(t), semi[:, 1] * np.cos(t)], -1) for t in (start, end)]
    crossed = tangents[0][:, 0] * tangents[1][:, 1] - tangents[0][:, 1] * tangents[1][:, 0]
    bending = np.arctan2(np.abs(crossed), (tangents[0] * tangents[1]).sum(1))
    tip = np.stack([semi[:, 0] * np.cos(end), semi[:, 1] * np.sin(end)], -1)
    in_plane = middle + (vectors @ tip[..., None])[..., 0]
    return _reported(
        centre + (in_plane[:, None] @ axes)[:, 0], bending, length, np.asarray(enough & np.isfinite(semi).all(1))
    )


def clamped_arcs(tip_mm: Array) -> Shapes:
    """Arcs that leave the origin along +z and end in points (B, 3): twin of `tubesight.geometry.arcs.clamped_arc`."""
    theta = 2 * np.arctan2(np.hypot(tip_mm[:, 0], tip_mm[:, 1]), tip_mm[:, 2])
    length = np.linalg.norm(tip_mm, axis=1) / np.sinc(theta / (2 * np.pi))
    return _reported(tip_mm, theta, length, np.asarray(np.isfinite(tip_mm).all(1)))


def _reported(tip_mm: Array, bending: Array, length: Array, good: Mask) -> Shapes:
    azimuth = np.arctan2(tip_mm[:, 1], tip_mm[:, 0])
    return Shapes(
        np.where(good[:, None], tip_mm, np.nan), *(np.where(good, v, np.nan) for v in (bending, azimuth, length))
    )


def _in_planes(points_mm: Array) -> tuple[Array, Array, Array, Mask]:
    """Points in their planes (B, N, 2), centres (B, 3), axes (B, 2, 3), and where enough points are there (B,)."""
    there = np.isfinite(points_mm[..., 0])
    count = there.sum(1)
    p = np.where(there[..., None], points_mm, 0.0)
    centre = p.sum(1) / np.maximum(count, 1)[:, None]
    p = np.where(there[..., None], p - centre[:, None], 0.0)
    vectors = np.linalg.eigh(np.swapaxes(p, 1, 2) @ p)[1]
    axes = np.swapaxes(vectors[:, :, :0:-1], 1, 2)
    flat = np.where(there[..., None], p @ np.swapaxes(axes, 1, 2), np.nan)
    return flat, centre, axes, np.asarray((count >= _POINTS_MIN) & there[:, -1])


def _first(points: Array) -> Array:
    """First point (B, 2) that is there."""
    index = np.isfinite(points[..., 0]).argmax(1)
    return np.asarray(np.take_along_axis(points, index[:, None, None], 1)[:, 0])


def _turned(angle: Array) -> Array:
    """Total change (B,) of angles (B, N) along the points, in steps of under half a turn; NaN are passed over."""
    there = np.isfinite(angle)
    last = np.maximum.accumulate(np.where(there, np.arange(angle.shape[1]), 0), 1)
    last = np.maximum(last, there.argmax(1)[:, None])
    steps = np.diff(np.take_along_axis(angle, last, 1), axis=1)
    return np.asarray((np.remainder(steps + np.pi, 2 * np.pi) - np.pi).sum(1))


def _foot(semi: Array, point: Array) -> Array:
    """Parameter (B,) of the point of an ellipse with semi-axes (B, 2) that is nearest to points (B, 2)."""
    t = np.arctan2(point[:, 1] / semi[:, 1], point[:, 0] / semi[:, 0])
    for _ in range(_FOOT_STEPS):
        at = np.stack([semi[:, 0] * np.cos(t), semi[:, 1] * np.sin(t)], -1)
        way = np.stack([-semi[:, 0] * np.sin(t), semi[:, 1] * np.cos(t)], -1)
        off = at - point
        bottom = (way * way).sum(1) - (off * at).sum(1)
        t = t - np.where(bottom > 0, (off * way).sum(1) / np.where(bottom > 0, bottom, 1.0), 0.0)
    return np.asarray(t)
