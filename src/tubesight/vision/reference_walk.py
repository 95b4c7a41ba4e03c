"""The paper's centreline: erase the tip circle, then follow the tube with a mask in the form of a circular arc.

Dalvand, Nahavandi & Howe 2016, section 3.1, figure 4 (i) to (l).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tubesight.core import Array, Image, Status, Unmeasurable, readonly
from tubesight.vision.reference_picture import Catheter
from tubesight.vision.reference_tip import TipSearch

# Radius of the arc over the tube's half width: below one the arc would stay inside of the tube.
_RADIUS_HALVES = 1.5
# Thickness of the arc, and its half angle: it has to cross both sides of the tube, asin(1 / 1.5) = 42 degrees from the
# way, with room for the bend between two steps.
_THICKNESS_PX = 3.0
_HALF_ANGLE_RAD = np.radians(75.0)
# What is erased beyond the circle: its blurred rim would leave a ring to walk on.
_RIM_PX = 2.0
# Share of the last arc's area below which the next one is cut by the erased circle.
_AREA_SHARE = 0.75
# Fewest centreline points, with origin and tip two more than a conic needs.
_POINTS_MIN = 5
_STEPS_MAX = 500


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """Centreline points and the arcs they come from, in pixels of the crop.

    Attributes
    ----------
    points_px
        (N, 2) centres of mass, in order from the origin.
    edges_px
        (N, 2, 2) left and right end of each arc.
    centres_px
        (N, 2) of the arcs.
    radius_px
        Radius of the mask.
    """

    points_px: Array
    edges_px: Array
    centres_px: Array
    radius_px: float

    def __post_init__(self) -> None:
        n = len(self.points_px)
        for name, shape in (("points_px", (n, 2)), ("edges_px", (n, 2, 2)), ("centres_px", (n, 2))):
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))


def erase_tip(catheter: Catheter, tip: TipSearch) -> Image:
    """Remove the tip circle from the isolated catheter."""
    tube = catheter.mask.copy()
    x, y = np.rint(tip.centre_px).astype(int).tolist()
    cv2.circle(tube, (x, y), int(np.ceil(tip.radius_px + _RIM_PX)), 0, cv2.FILLED)
    return tube


def mask_radius_px(catheter: Catheter, tip: TipSearch, ball_ratio: float) -> float:
    """Radius of the arc: above the tube's half width wherever it is widest, at the base or at the tip."""
    return _RADIUS_HALVES * max(catheter.width_px / 2, tip.radius_px / ball_ratio)


def arc_mask(radius_px: float) -> Array:
    """Pixels (K, 2) of the ring around a place; its part around the way is the mask (figure 4 i)."""
    reach = int(np.ceil(radius_px + _THICKNESS_PX))
    offset = np.stack(np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1)), -1).reshape(-1, 2)
    ring = np.abs(np.hypot(offset[:, 0], offset[:, 1]) - radius_px) <= _THICKNESS_PX / 2
    return np.asarray(offset[ring], np.float64)


def ahead_of(ring: Array, way: Array) -> Array:
    """Part (K, 2) of the ring around a unit way: the mask."""
    return np.asarray(ring[ring @ way >= np.cos(_HALF_ANGLE_RAD) * np.linalg.norm(ring, axis=1)])


def on_arc(tube: Image, centre: Array, way: Array, ring: Array) -> Array:
    """White pixels (K, 2) of the tube under the mask at a place (figure 4 j, k)."""
    place = np.rint(centre + ahead_of(ring, way)).astype(int)
    inside = (place >= 0).all(1) & (place < tube.shape[::-1]).all(1)
    place = place[inside]
    white = tube[place[:, 1], place[:, 0]] > 0
    return np.asarray(place[white], np.float64)


def walk_arcs(tube: Image, origin: Array, tip: TipSearch, radius_px: float) -> Walk:
    """Follow the tube from the origin until nothing of it lies under the mask.

    Raises
    ------
    Unmeasurable
        If that is after fewer than five points.
    """
    ring = arc_mask(radius_px)
    points, edges, centres = [], [], []
    # The first arc is the lower half circle around the origin: the tube hangs down.
    centre, way, area = origin, np.array([0.0, 1.0]), 0
    for _ in range(_STEPS_MAX):
        white = on_arc(tube, np.rint(centre), way, ring)
        if len(white) == 0 or len(white) < _AREA_SHARE * area:
            break
        mass = white.mean(0)
        step = mass - centre
        if np.linalg.norm(mass - tip.centre_px) <= tip.radius_px or np.linalg.norm(step) < radius_px / 4:
            break
        way = step / np.linalg.norm(step)
        aside = (white - mass) @ np.array([way[1], -way[0]])
        points.append(mass)
        edges.append(white[[int(aside.argmax()), int(aside.argmin())]])
        centres.append(centre)
        centre, area = mass, len(white)
    if len(points) < _POINTS_MIN:
        raise Unmeasurable(Status.TOO_FEW_POINTS, detail=f"{len(points)} points on the centreline")
    return Walk(np.array(points), np.array(edges), np.array(centres), radius_px)
