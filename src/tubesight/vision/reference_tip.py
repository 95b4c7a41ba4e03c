"""The paper's tip: lowest point, distance transform, masked Canny edges, circle through three points.

Dalvand, Nahavandi & Howe 2016, section 3.1, figure 4 (c) to (h).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tubesight.core import Array, Image, Status, Tip, Unmeasurable, readonly
from tubesight.vision.reference_picture import Box, Catheter

# A tip nearer to the camera than the base, or farther, by 0.4 of the distance is 1.7 or 0.6 times as large.
_LARGER, _SMALLER = 1.8, 0.55
# Half side of the region of interest over the radius of the tip: the circle and the cloth around it.
_ROI_RADII = 1.6
# The distance transform sees this much: with more, the centre of a rounded end could be anywhere on the tube's axis.
_INSIDE_RADII = 1.1
# Depths that count as equal: OpenCV's differ by 2e-6 px from call to call, and the middle of a tie is the better guess.
_TIE_PX = 0.01
# Two 8-connected lines of one pixel can cross without a common pixel; three pixels cannot be missed.
_LINE_PX = 3
# Edges beyond the rough centre that belong to the circle, in radii.
_ARM_RADII = (0.7, 1.4)
# Canny's thresholds over the step between bright tube and background times 4, the gain of its Sobel filter. The shaded
# side of a tip is half as bright, and a blur of 2 px leaves 0.4 of the gradient.
_CANNY_LOW, _CANNY_HIGH = 0.08, 0.2
# Disagreement of the circle's radius with the distance transform's, share and pixels (rounding of both).
_RADIUS_OFF, _RADIUS_OFF_PX = 0.15, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class TipSearch:
    """The tip and the pictures on the way to it, in pixels of the crop.

    Attributes
    ----------
    roi
        (x0, y0, x1, y1) region of interest.
    distance
        Distance transform of the region, pixels.
    lines, edges
        Mask of the line from the origin and its perpendicular, Canny edges; in the region.
    rough_px, rough_radius_px
        (2,) maximum of the distance transform, and its value.
    points_px
        (3, 2) where lines and edges meet: ahead, left, right.
    centre_px, radius_px
        (2,) the circle through them.
    """

    roi: Box
    distance: Array
    lines: Image
    edges: Image
    rough_px: Array
    rough_radius_px: float
    points_px: Array
    centre_px: Array
    radius_px: float

    def __post_init__(self) -> None:
        for name, shape in (("rough_px", (2,)), ("points_px", (3, 2)), ("centre_px", (2,))):
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))


def find_tip(catheter: Catheter, signal: Image, tip: Tip, ball_ratio: float) -> TipSearch:
    """Find the centre of the tip circle.

    Parameters
    ----------
    catheter, signal
        The isolated catheter, and the gray picture without background that it comes from.
    tip, ball_ratio
        What the tip is, and its diameter over that of the tube.

    Raises
    ------
    Unmeasurable
        If the lowest part of the catheter is not a circle of about the expected size.
    """
    if tip.shape == "flat":
        raise Unmeasurable(Status.TIP_NOT_FOUND, detail="the paper's image processing finds balls and rounded ends")
    lowest = catheter.contour_px[:, 1].max()
    if lowest >= catheter.mask.shape[0] - 2:
        raise Unmeasurable(Status.TIP_AT_BORDER)
    bottom = np.array([catheter.contour_px[catheter.contour_px[:, 1] == lowest, 0].mean(), lowest])
    expected = ball_ratio * catheter.width_px / 2
    rough, radius = _deepest(catheter.mask, bottom - (0, expected), _LARGER * expected)
    rough, radius = _deepest(catheter.mask, bottom - (0, radius), _INSIDE_RADII * radius)
    if not _SMALLER * expected <= radius <= _LARGER * expected:
        raise Unmeasurable(
            Status.TIP_NOT_FOUND, detail=f"the lowest part has a radius of {radius:.0f} px, not {expected:.0f}"
        )
    roi = _box(catheter.mask, rough, _ROI_RADII * radius)
    lines = _line_mask(roi, catheter.origin_px, rough, 1.5 * radius)
    edges = _canny(signal, roi)
    points = _three_points(lines & edges, roi, catheter.origin_px, rough, radius)
    centre, circle_radius = _circle(points)
    if abs(circle_radius - radius) > _RADIUS_OFF * radius + _RADIUS_OFF_PX:
        raise Unmeasurable(
            Status.TIP_NOT_FOUND, detail=f"a circle of {circle_radius:.0f} px where {radius:.0f} px fit inside"
        )
    distance = _distances(catheter.mask, roi)
    return TipSearch(roi, distance, lines, edges, rough, radius, points, centre, circle_radius)


def _box(mask: Image, centre: Array, half: float) -> Box:
    height, width = mask.shape
    low, high = np.floor(centre - half).astype(int), np.ceil(centre + half).astype(int) + 1
    return max(int(low[0]), 0), max(int(low[1]), 0), min(int(high[0]), width), min(int(high[1]), height)


def _distances(mask: Image, box: Box) -> Array:
    """Distance transform in a box; what lies outside of it counts as background."""
    x0, y0, x1, y1 = box
    padded = cv2.copyMakeBorder(mask[y0:y1, x0:x1], 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    return np.asarray(cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1], np.float64)


def _deepest(mask: Image, centre: Array, half: float) -> tuple[Array, float]:
    """Point (2,) deepest inside the catheter near a place, and its depth."""
    box = _box(mask, centre, half)
    distance = _distances(mask, box)
    rows, columns = np.nonzero(distance > distance.max() - _TIE_PX)
    # The distance counts to the middle of the first background pixel, the edge lies half a pixel before it.
    return np.array([box[0] + columns.mean(), box[1] + rows.mean()]), float(distance.max()) - 0.5


def _line_mask(roi: Box, origin: Array, rough: Array, reach: float) -> Image:
    """Line from the origin through the rough tip, and its perpendicular there (figure 4 e)."""
    x0, y0, x1, y1 = roi
    mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
    along = (rough - origin) / np.linalg.norm(rough - origin)
    across = np.array([along[1], -along[0]])
    for start, end in ((origin, rough + reach * along), (rough - reach * across, rough + reach * across)):
        (ax, ay), (bx, by) = np.rint(np.stack([start, end]) - (x0, y0)).astype(int).tolist()
        cv2.line(mask, (ax, ay), (bx, by), 255, _LINE_PX)
    return mask


def _canny(signal: Image, roi: Box) -> Image:
    """Canny edges of the region of interest (figure 4 f).

    Of the gray picture: both pixels beside the step of a binary one have the same gradient, and the tie moves every
    edge half a pixel to the upper left.
    """
    x0, y0, x1, y1 = roi
    part = np.ascontiguousarray(signal[y0:y1, x0:x1])
    low, high = np.percentile(part, (5, 95))
    step = 4.0 * float(high - low)
    return np.asarray(cv2.Canny(part, _CANNY_LOW * step, _CANNY_HIGH * step, L2gradient=True), np.uint8)


def _three_points(common: Image, roi: Box, origin: Array, rough: Array, radius: float) -> Array:
    """Points (3, 2) where the lines meet the circle: ahead, left and right; each the mean of its pixels."""
    rows, columns = np.nonzero(common)
    offset = np.stack([columns + roi[0], rows + roi[1]], 1) - rough
    along = (rough - origin) / np.linalg.norm(rough - origin)
    left = np.array([along[1], -along[0]])
    found = []
    for arm in (along, left, -left):
        reach, aside = offset @ arm, np.abs(offset @ np.array([arm[1], -arm[0]]))
        near = (aside <= _LINE_PX) & (reach > _ARM_RADII[0] * radius) & (reach < _ARM_RADII[1] * radius)
        if not near.any():
            raise Unmeasurable(Status.TIP_NOT_FOUND, detail="fewer than three edge points around the tip")
        # The outermost edge is the contour; others are shading on the tip.
        outer = near & (reach >= reach[near].max() - _LINE_PX / 2)
        found.append(rough + offset[outer].mean(0))
    return np.array(found)


def _circle(points: Array) -> tuple[Array, float]:
    """Circle through three points (3, 2): centre (2,) and radius, infinite where they are in line."""
    a, b = points[1] - points[0], points[2] - points[0]
    cross = a[0] * b[1] - a[1] * b[0]
    if abs(cross) < 1e-9:
        return points[0], float("inf")
    offset = np.array([b[1] * (a @ a) - a[1] * (b @ b), a[0] * (b @ b) - b[0] * (a @ a)]) / (2 * cross)
    return points[0] + offset, float(np.linalg.norm(offset))
