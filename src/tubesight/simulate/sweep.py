"""What one camera sees of a tube: covered pixels, surface points, normals and depths.

A tube of constant radius with a round end is the union of the balls along its centreline, and a ray meets it where its
distance from the centreline is below the radius (a canal surface). So the balls are drawn one by one, in parts: the
wall, its ends, which may be cut flat, and the ball at the tip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubesight.core import Array, Mask, Tube
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.simulate.ends import FlatEnd
from tubesight.simulate.phantom import Phantom
from tubesight.simulate.rays import Window, directions, dot, edge_field, slopes, windows_around

Index = NDArray[np.intp]

# Pixels around a ball that still get a distance: partial coverage ends 0.71 px outside the edge.
_HALO_PX = 2
# Least spacing of the balls, in radii: below it their union differs from the tube by 1.1e-6 radii.
_LEAST_STEP = 0.003
# Depth of a flat end's outline, see FlatEnd: the seam at its half is then over 1.4 px, a pixel's diagonal, inside.
_END_DEPTH_PX = 4.0
# Balls within this many radii of a flat end are cut: half a radius more than they can reach over it.
_END_RADII = 1.5


@dataclass(frozen=True, slots=True)
class Body:
    """A tube with its ends: a flat start, and a flat, round or ball end.

    Attributes
    ----------
    phantom
        The centreline, base frame.
    radius_mm
        Of the tube.
    flat_end
        Cut at the end of the centreline; otherwise a half ball of the tube's radius goes on.
    ball_radius_mm
        Ball around the end of the centreline, or None.
    tolerance_px
        How far the edge drawn may lie inside the true one.
    """

    phantom: Phantom
    radius_mm: float
    flat_end: bool = False
    ball_radius_mm: float | None = None
    tolerance_px: float = 0.002

    @classmethod
    def of(cls, phantom: Phantom, tube: Tube) -> Body:
        """Give a centreline the diameter and the tip of a tube."""
        if tube.diameter_mm is None:
            raise ValueError("a simulated tube needs its diameter_mm")
        ball = tube.tip.diameter_mm if tube.tip.shape == "ball" else None
        return cls(phantom, tube.diameter_mm / 2, tube.tip.shape == "flat", None if ball is None else ball / 2)


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The front of a body over a window of the picture.

    Attributes
    ----------
    window
        Where in the picture.
    edge
        (rows, columns, 3) edge field of the silhouette (`rays.edge_field`).
    distance_mm
        (rows, columns) along the ray; beside the silhouette that of the ray's nearest point, far away infinite.
    points_mm, normals
        (rows, columns, 3) camera frame.
    hit
        (rows, columns) whether the ray of the pixel's centre meets the body.
    """

    window: Window
    edge: Array
    distance_mm: Array
    points_mm: Array
    normals: Array
    hit: Mask


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Balls of one radius in the camera frame; of a wall also the tangents of the centreline there."""

    centres: Array
    radius: float
    tangents: Array | None = None
    end: FlatEnd | None = None


def _parts(body: Body, camera: Camera, pose: Pose) -> list[_Part]:
    """Wall, ends and tip; the balls so close that their union is within the tolerance of the tube."""
    length, radius = body.phantom.length_mm, body.radius_mm
    depth = float(pose.apply(body.phantom.at(np.linspace(0, length, 33)))[:, 2].min())
    if not depth > 2 * max(radius, body.ball_radius_mm or 0):
        raise ValueError(f"the tube comes within {depth:.1f} mm of the camera's plane; it cannot be drawn")
    # Half way between two balls `step` apart their union lies step^2 / (8 radius) inside the tube.
    step = max(np.sqrt(8 * radius * body.tolerance_px * depth / camera.focal_px), _LEAST_STEP * radius)
    count = int(np.ceil(length / step)) + 1
    s = np.linspace(0, length, count)
    centres, tangents = pose.apply(body.phantom.at(s)), pose.rotate(body.phantom.tangent(s))
    end_depth = min(_END_DEPTH_PX * depth / camera.focal_px, radius)

    def wall(group: slice, end: FlatEnd | None) -> _Part:
        return _Part(centres[group], radius, tangents[group], end)

    near = min(int(np.ceil(_END_RADII * radius / (length / (count - 1)))), count)
    start = wall(slice(0, near), FlatEnd(centres[0], -tangents[0], radius, end_depth))
    if body.flat_end:
        end = wall(slice(count - near, count), FlatEnd(centres[-1], tangents[-1], radius, end_depth))
        return [start, wall(slice(near, count - near), None), end]
    # A round end is its last ball alone: only there does the surface leave the wall.
    ball = _Part(centres[-1:], radius if body.ball_radius_mm is None else body.ball_radius_mm)
    return [start, wall(slice(near, count - 1), None), ball]


def _windows(part: _Part, camera: Camera) -> list[Window | None]:
    """Window of each ball: the projections of the corners of a cube around it."""
    corners = part.radius * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return windows_around(camera.project(part.centres[:, None] + corners), _HALO_PX, camera.size_px)


def _around(windows: list[Window | None]) -> Window | None:
    """Smallest window that holds all."""
    seen = [w for w in windows if w is not None]
    if not seen:
        return None
    tops, bottoms = [w.top for w in seen], [w.bottom for w in seen]
    return Window(min(tops), max(bottoms), min(w.left for w in seen), max(w.right for w in seen))


def _draw(part: _Part, windows: list[Window | None], window: Window, rays: Array) -> tuple[Array, Index, Array, Index]:
    """Draw balls over a window.

    Returns
    -------
    miss, miss_at, front, front_at
        (rows, columns) least of (squared distance of the ray from a centre minus squared radius) and which ball that
        is; distance along the ray to the first hit, infinite without one, and on which ball.
    """
    shape = window.shape
    miss, front = np.full(shape, np.inf), np.full(shape, np.inf)
    miss_at, front_at = np.zeros(shape, np.intp), np.zeros(shape, np.intp)
    for i, (own, centre) in enumerate(zip(windows, part.centres, strict=True)):
        if own is None:
            continue
        where = own.within(window)
        along = rays[where] @ centre
        excess = centre @ centre - part.radius**2 - along**2
        closer = excess < miss[where]
        miss[where][closer] = excess[closer]
        miss_at[where][closer] = i
        entry = np.where(excess < 0, along - np.sqrt(np.maximum(-excess, 0)), np.inf)
        first = entry < front[where]
        front[where][first] = entry[first]
        front_at[where][first] = i
    return miss, miss_at, front, front_at


def _silhouette(part: _Part, miss: Array, miss_at: Index, rays: Array) -> Array:
    """Edge field of the union of the balls.

    The distance ``d`` of a ray D from the centreline changes with the pixel as ``n . (t dD/dpixel)``, where t D is the
    ray's point nearest to the centreline and n the unit vector to it from there.
    """
    centre = part.centres[miss_at]
    along = dot(rays, centre)
    offset = along[..., None] * rays - centre
    distance = np.sqrt(dot(offset, offset))
    normal = offset / np.maximum(distance, 1e-12)[..., None]
    down, across = (dot(normal, slope) * along for slope in slopes(rays))
    field = edge_field(distance - part.radius, across, down)
    field[~np.isfinite(miss)] = (np.inf, 1.0, 0.0)
    return field


def _see_part(part: _Part, camera: Camera, windows: list[Window | None], window: Window) -> Surface:
    rays = directions(camera, window)
    miss, miss_at, front, front_at = _draw(part, windows, window, rays)
    edge = _silhouette(part, miss, miss_at, rays)
    hit = np.isfinite(front)
    index = np.where(hit, front_at, miss_at)
    centre = part.centres[index]
    distance = np.where(hit, front, dot(rays, centre))
    points = distance[..., None] * rays
    normals = points - centre
    if part.tangents is not None:
        # The wall is normal to the centreline; without this single balls would show as ripple.
        tangent = part.tangents[index]
        normals -= dot(normals, tangent)[..., None] * tangent
    normals /= np.maximum(np.sqrt(dot(normals, normals)), 1e-12)[..., None]
    if part.end is not None:
        end = part.end
        slope = rays @ end.axis
        over = ((points - end.centre_mm) @ end.axis > 0) & (slope < 0)
        distance[over] = (end.centre_mm @ end.axis) / slope[over]
        points[over] = distance[over][:, None] * rays[over]
        normals[over] = end.axis
        columns, rows = np.meshgrid(np.arange(window.left, window.right), np.arange(window.top, window.bottom))
        edge = end.cut_wall(edge, camera, np.stack([columns, rows], -1).astype(float))
    distance[~np.isfinite(miss)] = np.inf
    return Surface(window, edge, distance, points, normals, hit)


def _merge(whole: Surface, part: Surface) -> None:
    """Add a part to the body: the silhouettes' union, and the nearer surface (beside both, the nearer edge's)."""
    at = part.window.within(whole.window)
    both, only = whole.hit[at] & part.hit, part.hit & ~whole.hit[at]
    neither = ~whole.hit[at] & ~part.hit
    closer_edge = part.edge[..., 0] < whole.edge[at][..., 0]
    front = only | (both & (part.distance_mm < whole.distance_mm[at])) | (neither & closer_edge)
    whole.edge[at][closer_edge] = part.edge[closer_edge]
    whole.distance_mm[at][front] = part.distance_mm[front]
    whole.points_mm[at][front] = part.points_mm[front]
    whole.normals[at][front] = part.normals[front]
    whole.hit[at][part.hit] = True


def see(body: Body, camera: Camera, camera_from_base: Pose) -> Surface | None:
    """Draw a body.

    Returns
    -------
    Surface or None
        None where the body lies outside the picture.

    Raises
    ------
    ValueError
        If the body comes too near the plane of the camera.
    """
    parts = _parts(body, camera, camera_from_base)
    windows = [_windows(part, camera) for part in parts]
    around = [_around(own) for own in windows]
    window = _around(around)
    if window is None:
        return None
    rows, columns = window.shape
    edge = np.broadcast_to([np.inf, 1.0, 0.0], (rows, columns, 3)).copy()
    blank = np.zeros((rows, columns, 3))
    whole = Surface(
        window, edge, np.full((rows, columns), np.inf), blank, blank.copy(), np.zeros((rows, columns), bool)
    )
    for part, own, near in zip(parts, windows, around, strict=True):
        if near is not None:
            _merge(whole, _see_part(part, camera, own, near))
    return whole
