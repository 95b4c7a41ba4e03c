"""Contours of the end of the tube: ball, rounded end or flat face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, Mask
from tubesight.vision.edges import LINES_PX, colour_profiles, left_of, measure_edges, profiles, window
from tubesight.vision.ending import FOUND
from tubesight.vision.falls import grid, nearest_fall, spacing
from tubesight.vision.fitting import solve
from tubesight.vision.signal import Signal

# What else may become of a tip (`Contour.outcome`).
FAINT, RADIUS, NOT_ROUND = 3, 4, 5
# Lines across the contour of a whole ball, of a rounded end and of a face.
BALL_LINES, ROUND_LINES, FACE_LINES = 48, 31, 31
# Rays of a rounded end are used this far to both sides of the way: its contour is half a circle.
ROUND_HALF_RAD = float(np.radians(85.0))
# Lines of a ball keep this far from the tube that carries it.
NECK_RAD = float(np.radians(12.0))
# The first sweep looks for the contour this far inside and outside of where it is expected, in radii, the second one
# nearer: and so many pixels beyond. It is not needed where the first one moved the circle by less than this.
SWEEPS = (0.5, 0.3)
SWEEP_IN_PX, SWEEP_OUT_PX, NEAR_PX = 4.0, 10.0, 3.0
# They use every so many-th line of a ball.
ROUGH_EVERY = 2
# Then edges are measured next to the model; again where it moved by more than this (at most so often).
MOVED_PX, MEASURES = 0.75, 3
# How far a ball's radius may be off its expectation, and the share of lines that have to find an edge.
RADIUS_OFF, SEEN_MIN = 0.25, 0.4
# Fewest edges of a contour.
POINTS_MIN = 8
# Fall of the tube's share under which an edge is noise.
DROP_MIN = 0.15
# Contour points farther off the circle than this share of its radius (and half a pixel) belong to something else, or
# farther than 4 robust deviations.
OFF_CIRCLE, OFF_PX, OFF_SIGMAS = 0.06, 0.5, 4 * 1.4826
# A circle is fitted by least absolute deviations first, which a third of outliers does not move, then trimmed.
LEAST_ABSOLUTE, TRIMS = 4, 2
# Points lie on a line where the determinant of their second moments is below this share of its largest value.
ON_LINE = 1e-9
# Edges of a rounded end count when they lie within this of it, in radii and pixels.
OFF_ROUND, OFF_ROUND_PX = 0.5, 1.0
# Share of the width to both sides of the middle over which a flat face is measured: beyond, its corners round it off.
FACE_WIDTHS = 0.42
# Fewest edges of a face.
FACE_MIN = 10
# A face's edges are trimmed at this, or 3 robust deviations.
OFF_FACE_PX, FACE_SIGMAS, FACE_TRIMS = 0.3, 3 * 1.4826, 4


@dataclass(frozen=True, slots=True, eq=False)
class Contour:
    """Contour of the tip in a picture.

    Attributes
    ----------
    outcome
        `FOUND`, or why there is none: `NO_END`, `BORDER` (the tube leaves the picture), `FAINT` (too few edges),
        `RADIUS` (not of the expected size), `NOT_ROUND`.
    points_px
        (K, 2) edge points that fit the model.
    middle_px, radius_px
        (2,) and radius of circle or rounded end; the middle of a flat face, NaN.
    rms_px, doubt_px
        Root mean square distance of the points from the model, and how far they all may be off.
    ball
        Whether the contour is fitted as that of a ball (or of a rounded end whose way is not known).
    seen
        Share of a ball's lines whose edges fit.
    """

    outcome: int
    points_px: Array
    middle_px: Array
    radius_px: float
    rms_px: float
    doubt_px: float
    ball: bool
    seen: float = 0.0


def failed(outcome: int, radius: float = float("nan")) -> Contour:
    """Make a contour without points."""
    nan = float("nan")
    return Contour(outcome, np.empty((0, 2)), np.full(2, nan), radius, nan, nan, False)


def _fan(heading: Array, half: float, count: int) -> tuple[Array, Array]:
    """Angles (N,) from the heading, and unit directions (N, 2)."""
    angles = np.asarray(-half + 2 * half / (count - 1) * np.arange(float(count)))
    return angles, np.cos(angles)[:, None] * heading + np.sin(angles)[:, None] * left_of(heading)


def _rough(
    signal: Signal,
    origins: Array,
    directions: Array,
    radius: float,
    sweep: int,
    blur_px: float,
    outwards_px: float,
    careful: bool = False,
) -> Array:
    """Edges (N,) of a sweep on lines that start where the contour is expected; NaN where none stands out.

    They are falls of the likeness to tube, moved outwards as the walk's edges were; carefully, each is then measured
    with the colours on both sides of it.
    """
    reach = SWEEPS[sweep] * radius
    along = grid(-reach - SWEEP_IN_PX, reach + SWEEP_OUT_PX, spacing(2 * radius))
    if not careful:
        return nearest_fall(profiles(signal, origins, directions, along, (0.0,)), along, DROP_MIN) + outwards_px
    guess = nearest_fall(profiles(signal, origins, directions, along), along, DROP_MIN) + outwards_px
    return measure_edges(colour_profiles(signal, origins, directions, along, radius), guess, blur_px).position_px


def _fine(
    signal: Signal,
    origins: Array,
    directions: Array,
    radius: float,
    blur_px: float,
    lines_px: tuple[float, ...] = LINES_PX,
) -> tuple[Array, float]:
    """Edges (N,) measured on lines that start on the model, and how far they all may be off."""
    lines = colour_profiles(signal, origins, directions, window(blur_px, radius), radius, lines_px)
    edges = measure_edges(lines, np.zeros(len(origins)), blur_px)
    return edges.position_px, edges.doubt_px


def ball(
    signal: Signal,
    centre_px: Array,
    heading: Array,
    expected: float,
    half: float,
    blur_px: float,
    outwards_px: float,
    careful: bool,
) -> Contour:
    """Fit a circle to a ball's contour, starting from a rough centre.

    Parameters
    ----------
    centre_px, heading
        (2,) rough centre, and the unit way of the tube there.
    expected
        Radius; the contour's has to be near to it.
    half
        Angle to both sides of the heading within which the contour is looked for.
    blur_px, outwards_px
        Width of the picture's edges, and how far they lie outwards of those by likeness (`walker.measure`).
    careful
        Whether the first sweeps measure edges already, where shading hides them from the likeness to tube.
    """
    angles, directions = _fan(heading, half, max(int(BALL_LINES * half / np.pi), 12))
    needed = max(POINTS_MIN, SEEN_MIN * len(angles))
    centre, radius, doubt, points = centre_px, expected, 0.0, np.empty((0, 2))
    sweep = -1
    for _ in range(len(SWEEPS) + MEASURES):
        sweep += 1
        origins = centre + radius * directions
        rough = sweep < len(SWEEPS)
        if rough:
            position = np.full(len(angles), np.nan)
            lines = origins[::ROUGH_EVERY], directions[::ROUGH_EVERY]
            position[::ROUGH_EVERY] = _rough(signal, *lines, expected, sweep, blur_px, outwards_px, careful)
        else:
            position, doubt = _fine(signal, origins, directions, radius, blur_px)
            position = position + shrinkage(blur_px, radius)
        points = (origins + directions * position[:, None])[np.isfinite(position)]
        if len(points) < needed / (ROUGH_EVERY if rough else 1):
            return failed(FAINT)
        moved, new_radius, kept = _circle(points)
        points = points[kept]
        if not abs(new_radius / expected - 1) < (2 * RADIUS_OFF if sweep == 0 else RADIUS_OFF):
            return failed(RADIUS, new_radius)
        step = float(np.linalg.norm(moved - centre)) + abs(new_radius - radius)
        centre, radius = moved, expected if rough and sweep + 1 < len(SWEEPS) else new_radius
        if not rough and step < MOVED_PX:
            break
        if rough and step < NEAR_PX:
            sweep, radius = len(SWEEPS) - 1, new_radius
    if len(points) < SEEN_MIN * len(angles):
        return failed(NOT_ROUND)
    off = np.linalg.norm(points - centre, axis=1) - radius
    return Contour(
        FOUND, points, centre, radius, float(np.sqrt(np.mean(off**2))), doubt, True, len(points) / len(angles)
    )


def round_end(
    signal: Signal, centre_px: Array, heading: Array, radius: float, blur_px: float, outwards_px: float
) -> Contour:
    """Centre of a rounded end: on the way of the tube, one radius behind its contour.

    `centre_px` is a rough one. The width and the way are those of the tube's edges; only the place along the way is
    taken from the end's contour, from as much of it on the lit as on the shaded side.
    """
    angles, directions = _fan(heading, ROUND_HALF_RAD, ROUND_LINES)
    centre, doubt, points, rest = centre_px, 0.0, np.empty((0, 2)), np.empty(0)
    for sweep in range(len(SWEEPS) + MEASURES):
        origins = centre + radius * directions
        if sweep < len(SWEEPS):
            off = _rough(signal, origins, directions, radius, sweep, blur_px, outwards_px)
        else:
            off, doubt = _fine(signal, origins, directions, radius, blur_px)
            off = off + shrinkage(blur_px, radius)
        good: Mask = np.asarray(np.abs(off) < OFF_ROUND * radius + OFF_ROUND_PX)
        good = good & good[::-1]
        if good.sum() < SEEN_MIN * len(angles):
            return failed(FAINT)
        points = (origins + directions * off[:, None])[good]
        weight = np.cos(angles[good])
        shift = float(weight @ off[good] / (weight @ weight))
        rest = off[good] - shift * weight
        centre = centre + shift * heading
        if sweep >= len(SWEEPS) and abs(shift) < MOVED_PX:
            break
    return Contour(FOUND, points, centre, radius, float(np.sqrt(np.mean(rest**2))), doubt, False)


def shrinkage(blur_px: float, radius: float) -> float:
    """How far the blur of a disc, a Gaussian of sigma, moves its half level inwards: sigma^2 / (2 radius)."""
    return blur_px**2 / (2 * radius)


def _circle(points: Array) -> tuple[Array, float, Mask]:
    """Circle through points (N, 2), trimmed: centre, radius (NaN for points on a line), mask of the points kept."""
    middle = points.mean(0)
    p = points - middle
    design, right = np.column_stack([2 * p, np.ones(len(p))]), (p * p).sum(1)
    weight = np.ones(len(points))
    centre, radius, keep = middle, 0.0, weight > 0
    for k in range(LEAST_ABSOLUTE + TRIMS):
        if _on_line(2 * p, weight):
            return middle, float("nan"), keep
        solution = solve(design, right, weight)
        centre = solution[:2]
        radius = float(np.sqrt(max(solution[2] + centre @ centre, 0.0)))
        off = np.abs(np.linalg.norm(p - centre, axis=1) - radius)
        keep = off <= np.clip(OFF_SIGMAS * float(np.median(off)), OFF_PX, OFF_PX + OFF_CIRCLE * radius)
        weight = 1 / np.maximum(off, OFF_PX) if k < LEAST_ABSOLUTE else keep.astype(float)
    return middle + centre, radius, keep


def _on_line(points: Array, weight: Array) -> bool:
    """Whether no circle can be told from weighted points (N, 2)."""
    centred = points - weight @ points / weight.sum()
    moments = centred.T @ (weight[:, None] * centred)
    determinant = moments[0, 0] * moments[1, 1] - moments[0, 1] ** 2
    return not determinant > ON_LINE * max(float(np.trace(moments)), 1.0) ** 2


def face(signal: Signal, end_px: Array, heading: Array, width_px: float, blur_px: float, outwards_px: float) -> Contour:
    """Middle of a flat end face: its contour is half an ellipse, ``a(d) = a0 + bulge sqrt(1 - 4 d^2) + tilt d``.

    d is the distance from the middle, in widths.
    """
    d = -FACE_WIDTHS + 2 * FACE_WIDTHS / (FACE_LINES - 1) * np.arange(FACE_LINES)
    design = np.stack([np.ones_like(d), np.sqrt(1 - (2 * d) ** 2), d], 1)
    origins = end_px + d[:, None] * width_px * left_of(heading)
    directions = np.broadcast_to(heading, origins.shape)
    place = _rough(signal, origins, directions, width_px / 2, 0, blur_px, outwards_px)
    model, keep = _fit_face(design, place)
    doubt = 0.0
    for _ in range(MEASURES):
        if keep.sum() < FACE_MIN:
            return failed(FAINT)
        start = design @ model
        off, doubt = _fine(signal, origins + directions * start[:, None], directions, width_px / 2, blur_px, (0.0,))
        place = start + off
        moved, keep = _fit_face(design, place)
        step = float(np.abs(design @ (moved - model)).max())
        model = moved
        if step < MOVED_PX:
            break
    if keep.sum() < FACE_MIN:
        return failed(FAINT)
    rms = float(np.sqrt(np.mean((place - design @ model)[keep] ** 2)))
    contour = (origins + directions * place[:, None])[keep]
    return Contour(FOUND, contour, end_px + heading * model[0], float("nan"), rms, doubt, False)


def _fit_face(design: Array, place: Array) -> tuple[Array, Mask]:
    """Fit a face's model (3,) to places (N,), trimmed; the places kept (none where there are too few)."""
    keep: Mask = np.isfinite(place)
    model = np.zeros(3)
    for _ in range(FACE_TRIMS):
        if keep.sum() < FACE_MIN:
            return model, np.zeros(len(place), dtype=bool)
        used = design[keep]
        model = solve(used, place[keep])
        off = np.abs(place - design @ model)
        keep = off <= max(OFF_FACE_PX, FACE_SIGMAS * float(np.median(off[keep])))
    return model, keep
