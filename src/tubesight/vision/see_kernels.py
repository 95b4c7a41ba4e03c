"""Compiled twin of `see` for the common case: a known start, and every stage succeeds at its first attempt.

Whatever else happens (`DOUBTFUL`), a gap that is told of or a tip that might be a corner, is left to the stages one by
one, which know what to try next and what to say.
"""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Image
from tubesight.core.kernels import part
from tubesight.vision import locate, see, tip, walker
from tubesight.vision.colour_kernels import learn, numbers_of, segmenter
from tubesight.vision.ending import FOUND
from tubesight.vision.kernels import find_end, walk
from tubesight.vision.line_kernels import Numbers, Picture
from tubesight.vision.ray_kernels import Optics, tangent_cone, tube_rays, unproject
from tubesight.vision.scan_kernels import measure
from tubesight.vision.tip_kernels import Found, ball, face, round_end

# Shapes of a tip.
ROUND, FLAT, BALL = 0, 1, 2
# In place of the number of a reason (`silhouette.REASONS`).
DOUBTFUL = -1
# That number; edges, their rays, rays, centreline and contour; base (2), roughness (2), doubts (2), blur; axis
# (3), pixel (2), angle, rms and doubt of the tip.
Seen = tuple[int, Array, Array, Array, Array, Array, Numbers, Numbers]
Tip = tuple[bool, Array, Numbers]


@part
def doubtful() -> Seen:
    """Make a result without anything."""
    flat, nan = np.empty((0, 2)), np.nan
    scans, rays = np.empty((0, 2, 2)), np.empty((0, 2, 3))
    few, many = (nan, nan, nan, nan, nan, nan, nan), (nan, nan, nan, nan, nan, nan, nan, nan)
    return DOUBTFUL, scans, rays, np.empty((0, 3)), flat, flat, few, many


@part
def contour_of(
    picture: Picture,
    place: Numbers,
    heading: Numbers,
    width: float,
    shape: int,
    ratio: float,
    blur: float,
    outwards: float,
) -> tuple[bool, Found]:
    """Twin of `locate._contour` at its first attempt, and whether that suffices."""
    radius = ratio * width / 2
    centre = place[0] - radius * heading[0], place[1] - radius * heading[1]
    if shape == FLAT:
        found = face(picture, place, heading, width, blur, outwards)
        return found[0] == FOUND, found
    if shape == ROUND:
        found = round_end(picture, centre, heading, radius, blur, outwards)
        return found[0] == FOUND and found[2][3] < locate.ROUND_SURE_PX, found
    half = np.pi - np.arcsin(min(1 / ratio, 1.0)) - tip.NECK_RAD
    found = ball(picture, centre, heading, radius, half, blur, outwards, False)
    sure = found[0] == FOUND and found[2][3] < locate.BALL_SURE_PX and found[2][5] > locate.BALL_SURE_SEEN
    return sure, found


@part
def tip_of(optics: Optics, focal: float, shape: int, contour: Found) -> Tip:
    """Twin of `locate._tip_view`: whether the contour fits, its points, and the numbers of the tip."""
    _, points, (x, y, radius, rms, doubt, _) = contour
    if shape == BALL:
        (ax, ay, az, px, py, angle, rms), kept = tangent_cone(optics, focal, points)
        return rms <= locate.RMS_MAX_PX, kept, (ax, ay, az, px, py, angle, rms, doubt)
    u, v = unproject(x, y, optics)
    size, limit, angle = np.sqrt(u * u + v * v + 1.0), locate.RMS_MAX_PX, np.nan
    if np.isfinite(radius):
        limit += locate.RMS_SHARE * radius
        angle = np.arctan(radius / focal / size)
    return rms <= limit, points, (u / size, v / size, 1.0 / size, x, y, angle, rms, doubt)


@part
def see_from_base(
    image: Image,
    behind: Image,
    start: tuple[float, float],
    way: Numbers,
    width: float,
    optics: Optics,
    focal: float,
    shape: int,
    ratio: float,
) -> Seen:
    """Twin of `see.see` from a known start with a tip of a known size."""
    channels = image.shape[2]
    if not (width > 0 and width < max(image.shape[0], image.shape[1])):
        return doubtful()
    colours, difference = learn(image, behind, start, way, width)
    why = segmenter(colours, difference, channels, behind.shape[0] > 0)
    if why == DOUBTFUL:
        return doubtful()
    picture = Picture(image, behind, numbers_of(colours, channels))
    middles, widths, gaps = walk(picture, start, way, width, True)
    if len(middles) < see.PLACES_MIN or (len(gaps) > 0 and gaps.max() > walker.GAP_TOLD):
        return doubtful()
    edges, blur, left, right, outwards = measure(picture, middles, widths)
    widths += 2 * outwards
    outcome, place, heading, size = find_end(picture, middles, widths, locate.REACH_WIDTHS + locate.REACH_BALLS * ratio)
    if outcome != FOUND:
        return doubtful()
    sure, contour = contour_of(picture, place, heading, size, shape, ratio, blur, outwards)
    if not sure:
        return doubtful()
    fits, points, seen = tip_of(optics, focal, shape, contour)
    if not (fits and seen[6] < see.SURE_TIP_PX and len(points) >= see.SURE_CONTOUR):
        return doubtful()
    room = see.ROOM_PX
    if shape == BALL:
        room += contour[2][2]
    elif shape == FLAT:
        room += see.ROOM_FLAT_WIDTHS * size
    near = see.NEAR_WIDTHS * size + room
    edges, unit, rays, centreline, base, rough = tube_rays(
        optics, edges, heading, (seen[3], seen[4]), near, room, start
    )
    if len(edges) < see.SCANS_MIN:
        return doubtful()
    few = base[0], base[1], rough[0], rough[1], left, right, blur
    return why, edges, unit, rays, centreline, points, few, seen
