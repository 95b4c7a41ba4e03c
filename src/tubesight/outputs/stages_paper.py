"""Figure 4 (a) to (l) of Dalvand, Nahavandi & Howe 2016, for one photograph."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from tubesight.core import Array, Image, Tube, Unmeasurable
from tubesight.geometry.camera import Camera
from tubesight.vision.reference import ball_ratio
from tubesight.vision.reference_picture import (
    Box,
    Catheter,
    crop_box,
    isolate,
    threshold,
    undistort_box,
    without_background,
)
from tubesight.vision.reference_tip import TipSearch, find_tip
from tubesight.vision.reference_walk import Walk, ahead_of, arc_mask, erase_tip, mask_radius_px, on_arc, walk_arcs
from tubesight.vision.see import Start

_Stage = tuple[str, Image]
_RED, _GREEN, _YELLOW = (60, 60, 255), (90, 220, 90), (60, 220, 255)


def paper_stages(
    image: Image, camera: Camera, tube: Tube, start: Start | None, base_px: Array | None
) -> Iterator[_Stage]:
    """Titles and pictures of the stages, up to the one that fails; parameters as those of `Reference`."""
    try:
        base, way = (start.px, start.way) if start is not None else (base_px, None)
        crop = undistort_box(image, camera, crop_box(camera, base, way), whole=False)
        yield "crop", crop
        signal = without_background(crop)
        binary = threshold(signal)
        yield "background removed", binary
        catheter = isolate(binary, from_base=start is not None)
        ratio = ball_ratio(tube)
        tip = find_tip(catheter, signal, tube.tip, ratio)
        yield from _tip_stages(crop, catheter, tip)
        radius = mask_radius_px(catheter, tip, ratio)
        walk = walk_arcs(erase_tip(catheter, tip), catheter.origin_px, tip, radius)
        yield from _walk_stages(crop, catheter, tip, walk)
    except Unmeasurable:
        return


def _tip_stages(crop: Image, catheter: Catheter, tip: TipSearch) -> Iterator[_Stage]:
    """(c) to (h): region of interest, distance transform, lines, edges, points, circle."""
    yield "tip region", _part(catheter.mask, tip.roi)
    yield "distance transform", np.asarray(tip.distance / tip.distance.max() * 255, np.uint8)
    yield "line and perpendicular", tip.lines
    yield "Canny edges", tip.edges
    corner = np.array(tip.roi[:2])
    points = (tip.lines & tip.edges) // 2
    for point in tip.points_px - corner:
        _draw_circle(points, point, 1.5, (255, 255, 255), cv2.FILLED)
    yield "three points", points
    circle = _colour(_part(crop, tip.roi))
    _draw_circle(circle, tip.centre_px - corner, tip.radius_px, _RED)
    for point in tip.points_px - corner:
        _draw_circle(circle, point, 1.5, _YELLOW, cv2.FILLED)
    _draw_circle(circle, tip.centre_px - corner, 1.5, _RED, cv2.FILLED)
    yield "circle", circle


def _walk_stages(crop: Image, catheter: Catheter, tip: TipSearch, walk: Walk) -> Iterator[_Stage]:
    """(i) to (l): arc mask, first and second arc of the tube, all points."""
    tube, ring = erase_tip(catheter, tip), arc_mask(walk.radius_px)
    ways = [np.array([0.0, 1.0]), walk.points_px[0] - walk.centres_px[0]]
    x, y = np.rint(catheter.origin_px).astype(int).tolist()
    reach = int(3 * walk.radius_px)
    around = (max(x - reach, 0), max(y - reach // 2, 0), x + reach, y + reach)
    first = np.rint(walk.centres_px[0]) + ahead_of(ring, ways[0])
    yield "arc mask", _part(_white(tube.shape, first), around)
    for title, centre, way in zip(("first arc", "second arc"), walk.centres_px, ways, strict=False):
        found = on_arc(tube, np.rint(centre), way / np.linalg.norm(way), ring)
        yield title, _part(_white(tube.shape, found) | tube // 4, around)
    points = _colour(crop)
    for point in (catheter.origin_px, *walk.points_px):
        _draw_circle(points, point, 4, _GREEN, cv2.FILLED)
    _draw_circle(points, tip.centre_px, tip.radius_px, _RED)
    _draw_circle(points, tip.centre_px, 4, _RED, cv2.FILLED)
    low, high = catheter.contour_px.min(0).astype(int), catheter.contour_px.max(0).astype(int)
    yield "all points", _part(points, (max(low[0] - 60, 0), max(low[1] - 20, 0), *(high + 60)))


def _part(picture: Image, box: Box) -> Image:
    return picture[box[1] : box[3], box[0] : box[2]]


def _white(shape: tuple[int, ...], points: Array) -> Image:
    """Picture with white pixels at whole places (K, 2); those outside are left out."""
    picture = np.zeros(shape, np.uint8)
    place = points.astype(int)
    place = place[((place >= 0) & (place < shape[::-1])).all(1)]
    picture[place[:, 1], place[:, 0]] = 255
    return picture


def _colour(picture: Image) -> Image:
    return np.array(cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture, np.uint8)


def _draw_circle(
    picture: Image, centre: Array, radius: float, colour: tuple[int, int, int], thickness: int = 1
) -> None:
    """Draw to a sixteenth of a pixel."""
    x, y, r = (round(float(v) * 16) for v in (*centre, radius))
    cv2.circle(picture, (x, y), r, colour, thickness, cv2.LINE_AA, 4)
