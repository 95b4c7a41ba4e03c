"""The end of the tube: ball, rounded end or flat face."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Status, Tip, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.vision.edges import SPACING_PX, Edges, colour_profiles, left_of, measure_edges, profiles, steepest
from tubesight.vision.signal import Signal
from tubesight.vision.view import TipView

# Radial profiles around a ball: one every 5 degrees.
_RADIALS = 72
# Rays of a rounded end are used this far to both sides of the way: its contour is half a circle.
_ROUND_HALF_RAD = np.radians(85.0)
# How far a ball's radius may be off its expectation, and the share of radials that have to find an edge.
_RADIUS_OFF, _SEEN_MIN = 0.25, 0.4
# Largest accepted rms of the contour about the model: a contour that is something else is off by a pixel and more.
_RMS_MAX_PX = 1.0
# End of the tube: its share falls below this part of its level.
_SHARE = 0.5
# Fall of the tube's share under which an edge is noise.
_DROP_MIN = 0.15
# Contour points farther off the circle than this share of its radius (and half a pixel) belong to something else.
_OFF_CIRCLE = 0.06
# Share of the width to both sides of the middle over which a flat face is measured: beyond, its corners round it off.
_FACE_WIDTHS = 0.42


def end_of_tube(
    signal: Signal, camera: Camera, start_px: Array, way: Array, bend: float, width_px: float, reach_px: float
) -> float:
    """Distance from a place on the tube to its end, along its way.

    Parameters
    ----------
    start_px, way, bend
        (2,) a place on the tube, its unit way there and the curvature of the way (1 / px, positive to the left).
    width_px
        Width of the tube.
    reach_px
        How far to look.

    Raises
    ------
    Unmeasurable
        If the tube leaves the picture before it ends, or does not end.
    """
    along = np.arange(-width_px, reach_px, SPACING_PX)
    left = left_of(way)
    sideways = np.linspace(-0.2, 0.2, 5) * width_px
    path = start_px + along[:, None] * way + (bend * along**2 / 2)[:, None] * left
    share = np.mean([signal(path + offset * left) for offset in sideways], axis=0)
    level = float(np.nanmedian(share[along <= 0])) * _SHARE
    inside = share >= level
    quiet = max(int(0.5 * width_px / SPACING_PX), 4)
    for k in np.flatnonzero(along > 0):
        ahead = share[k : k + quiet]
        if np.isnan(ahead).any():
            if camera.contains(path[k], 2.0):
                continue
            raise Unmeasurable(Status.TIP_AT_BORDER)
        if len(ahead) == quiet and not inside[k : k + quiet].any():
            return float(along[k])
    raise Unmeasurable(Status.TIP_NOT_FOUND, detail="the tube does not end")


def find_tip(
    signal: Signal,
    camera: Camera,
    tip: Tip,
    start_px: Array,
    way: Array,
    bend: float,
    width_px: float,
    ball_ratio: float,
    blur_px: float,
) -> TipView:
    """Find the tip beyond a place near the end of the tube.

    Parameters
    ----------
    ball_ratio
        Diameter of the ball over that of the tube (1 for a rounded end).
    blur_px
        Width of the picture's edges.

    Raises
    ------
    Unmeasurable
        If the end does not look like the tip that was announced.
    """
    radius = ball_ratio * width_px / 2
    end = end_of_tube(signal, camera, start_px, way, bend, width_px, 3 * width_px + 3 * radius)
    heading = way + bend * end * left_of(way)
    heading /= np.linalg.norm(heading)
    end_px = start_px + end * way + bend * end**2 / 2 * left_of(way)
    if tip.shape == "flat":
        return _flat(signal, camera, end_px, heading, width_px, blur_px)
    if tip.shape == "round" and ball_ratio == 1.0:
        try:
            return _round(signal, camera, end_px, heading, width_px / 2, blur_px)
        except Unmeasurable:
            # Near the end of a tube that turns towards the camera its way is not known; its round contour still is.
            return _ball(signal, camera, end_px - radius * heading, heading, radius, _ROUND_HALF_RAD, blur_px)
    half = np.pi - np.arcsin(min(1 / ball_ratio, 1.0)) - np.radians(12.0)
    return _ball(signal, camera, end_px - radius * heading, heading, radius, half, blur_px)


def _ball(
    signal: Signal, camera: Camera, centre: Array, heading: Array, radius: float, half: float, blur_px: float
) -> TipView:
    """Fit the cone of tangent rays to a ball's contour, starting from a rough centre."""
    angles = np.linspace(-half, half, max(int(_RADIALS * half / np.pi), 12))
    left = left_of(heading)
    directions = np.cos(angles)[:, None] * heading + np.sin(angles)[:, None] * left
    contour, doubt = np.empty((0, 2)), 0.0
    for sweep in range(4):
        # The first sweep looks far for a rough centre, the last ones near.
        low, high = (0.5, 1.5) if sweep == 0 else (0.7, 1.3)
        along = np.arange(low * radius - 4.0, high * radius + 10.0, SPACING_PX)
        profile = profiles(signal, np.broadcast_to(centre, directions.shape), directions, along)
        lines = colour_profiles(signal, np.broadcast_to(centre, directions.shape), directions, along, radius)
        edges = measure_edges(lines, _outermost(profile, along, radius), blur_px)
        position = _unshrunk(edges, radius, blur_px)
        good = np.isfinite(position)
        if good.sum() < max(8, _SEEN_MIN * len(angles)):
            raise Unmeasurable(Status.TIP_NOT_FOUND, detail="its contour does not stand out")
        points = centre + directions * position[:, None]
        new_centre, new_radius, kept = _circle(points[good])
        contour, doubt = points[good][kept], edges.doubt_px
        if not abs(new_radius / radius - 1) < (2 * _RADIUS_OFF if sweep == 0 else _RADIUS_OFF):
            raise Unmeasurable(
                Status.TIP_NOT_FOUND, detail=f"radius {new_radius:.1f} px where {radius:.1f} were expected"
            )
        centre = new_centre
    if len(contour) < _SEEN_MIN * len(angles):
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail="too little of its contour is round")
    return _cone_of_tangents(camera, contour, doubt)


def _round(signal: Signal, camera: Camera, end_px: Array, heading: Array, radius: float, blur_px: float) -> TipView:
    """Centre of a rounded end: on the way of the tube, one radius behind its contour.

    The width and the way are those of the tube's edges; only the place along the way is taken from the end's contour,
    from as much of it on the lit as on the shaded side.
    """
    angles = np.linspace(-_ROUND_HALF_RAD, _ROUND_HALF_RAD, 41)
    directions = np.cos(angles)[:, None] * heading + np.sin(angles)[:, None] * left_of(heading)
    along = np.arange(0.4 * radius - 4.0, 1.6 * radius + 10.0, SPACING_PX)
    place = -radius
    contour, off = np.empty((0, 2)), np.empty(0)
    for _ in range(4):
        centre = end_px + place * heading
        origins = np.broadcast_to(centre, directions.shape)
        profile = profiles(signal, origins, directions, along)
        lines = colour_profiles(signal, origins, directions, along, radius)
        edges = measure_edges(lines, _outermost(profile, along, radius), blur_px)
        position = _unshrunk(edges, radius, blur_px)
        off = position - radius
        pairs = np.isfinite(off) & np.isfinite(off[::-1]) & (np.abs(off) < 0.5 * radius + 1)
        pairs &= pairs[::-1]
        if pairs.sum() < _SEEN_MIN * len(angles):
            raise Unmeasurable(Status.TIP_NOT_FOUND, detail="its contour does not stand out")
        contour = (centre + directions * position[:, None])[pairs]
        weight = np.cos(angles[pairs])
        shift = float(weight @ off[pairs] / (weight @ weight))
        off = off[pairs] - shift * weight
        place += shift
    rms = float(np.sqrt(np.mean(off**2)))
    if rms > _RMS_MAX_PX + 0.05 * radius:
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail=f"its end is not round (rms {rms:.1f} px)")
    px = end_px + place * heading
    ray = camera.unproject(px)
    angle = float(np.arctan(radius / camera.focal_px / np.linalg.norm(ray)))
    return TipView(ray / np.linalg.norm(ray), px, angle, contour, rms, edges.doubt_px)


def _unshrunk(edges: Edges, radius: float, blur_px: float) -> Array:
    """Undo the blur of a disc: a Gaussian of sigma moves its half level inwards by sigma^2 / (2 radius)."""
    return np.asarray(edges.position_px + blur_px**2 / (2 * radius))


def _outermost(profile: Array, along: Array, radius: float) -> Array:
    """Place (N,) of the fall nearest the expected radius, among the strong ones of each profile."""
    smooth, slope = steepest(profile, along)
    reach = int(3.0 / SPACING_PX)
    padded = np.pad(smooth, ((0, 0), (reach, reach)), mode="edge")
    falls = padded[:, : -2 * reach] - padded[:, 2 * reach :] > _DROP_MIN
    strong = (slope >= 0.5 * slope.max(1, keepdims=True)) & falls
    peak = np.zeros_like(strong)
    peak[:, 1:-1] = strong[:, 1:-1] & (slope[:, 1:-1] > slope[:, :-2]) & (slope[:, 1:-1] >= slope[:, 2:])
    distance = np.where(peak, np.abs(along - radius), np.inf)
    best = distance.argmin(1)
    return np.where(np.isfinite(distance.min(1)), along[best], np.nan)


def _circle(points: Array) -> tuple[Array, float, Array]:
    """Circle through points (N, 2), trimmed: centre, radius, mask of the points kept."""
    keep = np.ones(len(points), dtype=bool)
    centre, radius = points.mean(0), 0.0
    for _ in range(5):
        p = points[keep]
        solution = np.linalg.lstsq(np.column_stack([2 * p, np.ones(len(p))]), (p * p).sum(1), rcond=None)[0]
        centre = solution[:2]
        radius = float(np.sqrt(max(solution[2] + centre @ centre, 0.0)))
        off = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        keep = off <= np.clip(4 * 1.4826 * float(np.median(off)), 0.5, 0.5 + _OFF_CIRCLE * radius)
    return centre, radius, keep


def _cone_of_tangents(camera: Camera, contour: Array, doubt_px: float) -> TipView:
    """Fit the circular cone of unit rays u that touch a ball: ``u . a = 1``, the axis is ``a / |a|``."""
    rays = camera.unproject(contour)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    keep = np.isfinite(unit).all(1)
    a = np.zeros(3)
    off_px = np.zeros(len(contour))
    for _ in range(4):
        a = np.linalg.lstsq(unit[keep], np.ones(int(keep.sum())), rcond=None)[0]
        size = float(np.linalg.norm(a))
        if not size > 1:
            raise Unmeasurable(Status.TIP_NOT_FOUND, detail="its contour is not round")
        angle = np.arccos(1 / size)
        off_px = (np.arccos(np.clip(unit @ a / size, -1, 1)) - angle) * camera.focal_px
        scale = 1.4826 * float(np.median(np.abs(off_px[keep])))
        keep = np.abs(off_px) <= max(0.2, 3.0 * scale)
    rms = float(np.sqrt(np.mean(off_px[keep] ** 2)))
    if rms > _RMS_MAX_PX:
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail=f"its contour is not round (rms {rms:.1f} px)")
    axis = a / np.linalg.norm(a)
    return TipView(axis, camera.project(axis), float(np.arccos(1 / np.linalg.norm(a))), contour[keep], rms, doubt_px)


def _flat(signal: Signal, camera: Camera, end_px: Array, heading: Array, width_px: float, blur_px: float) -> TipView:
    """Middle of a flat end face: its contour is half an ellipse, ``a(d) = a0 + bulge sqrt(1 - (2 d / width)^2)``."""
    left = left_of(heading)
    offsets = np.linspace(-_FACE_WIDTHS, _FACE_WIDTHS, 31)
    origins = end_px + offsets[:, None] * width_px * left
    along = np.arange(-0.6 * width_px - 6.0, 0.6 * width_px + 10.0, SPACING_PX)
    profile = profiles(signal, origins, np.broadcast_to(heading, origins.shape), along)
    lines = colour_profiles(signal, origins, np.broadcast_to(heading, origins.shape), along, width_px / 2, (0.0,))
    edges = measure_edges(lines, _outermost(profile, along, 0.0), blur_px)
    good = np.isfinite(edges.position_px)
    if good.sum() < 10:
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail="its end face does not stand out")
    place, d = edges.position_px[good], offsets[good]
    design = np.stack([np.ones_like(d), np.sqrt(1 - (2 * d) ** 2), d], 1)
    keep = np.ones(len(d), dtype=bool)
    solution = np.zeros(3)
    for _ in range(4):
        solution = np.linalg.lstsq(design[keep], place[keep], rcond=None)[0]
        off = np.abs(place - design @ solution)
        keep = off <= max(0.3, 3 * 1.4826 * float(np.median(off[keep])))
    rms = float(np.sqrt(np.mean((place - design @ solution)[keep] ** 2)))
    if rms > _RMS_MAX_PX or keep.sum() < 10:
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail=f"its end face is not flat (rms {rms:.1f} px)")
    middle = end_px + heading * solution[0]
    ray = camera.unproject(middle)
    contour = (origins[good] + heading * place[:, None])[keep]
    return TipView(ray / np.linalg.norm(ray), middle, float("nan"), contour, rms, edges.doubt_px)
