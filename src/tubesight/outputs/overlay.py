"""What was found, drawn on the photographs."""

from __future__ import annotations

import math

import cv2
import numpy as np

from tubesight.core import Array, FramePair, Image
from tubesight.geometry.rig import Rig
from tubesight.sensor import Reconstruction
from tubesight.vision.view import View

# Width of a camera's column: two columns fit a full-HD screen.
_COLUMN_PX = 960
_HEADER_PX, _LINE_PX = 96, 30
# OpenCV draws at 1 / 16 pixel with this many fractional bits.
_SHIFT = 4
_FONT, _TEXT = cv2.FONT_HERSHEY_SIMPLEX, 0.62

_EDGES = (255, 190, 60)
_CENTRELINE = (60, 220, 255)
_CURVE = (230, 60, 255)
_TIP = (60, 60, 255)
_LEGEND = (("edges", _EDGES), ("centreline", _CENTRELINE), ("3-D curve, reprojected", _CURVE), ("tip", _TIP))

_Box = tuple[int, int, int, int]


def draw_overlay(pair: FramePair, result: Reconstruction, rig: Rig) -> Image:
    """Draw edges, centreline, tip and the reprojected curve on all photographs of one instant.

    Returns
    -------
    Image
        As `draw_views`; on top the measured values or the reason why there are none.
    """
    body = draw_views(pair, result, rig, _COLUMN_PX)
    return np.concatenate([_header(result, body.shape[1]), body])


def draw_views(pair: FramePair, result: Reconstruction, rig: Rig, column_px: int) -> Image:
    """Draw what was found on the photographs: a column of this width per camera.

    Returns
    -------
    Image
        In each column the whole picture, below it the part with the tube, enlarged.
    """
    columns = []
    for name in rig.names:
        view = result.views.get(name)
        curve = _curve_px(result, rig, name)
        image = pair.images[name]
        whole = (0, 0, image.shape[1], image.shape[0])
        boxes = (whole, _tube_box(image, view, curve))
        panels = [_panel(image, view, curve, box, column_px) for box in boxes if box is not None]
        cv2.putText(panels[0], name, (16, 36), _FONT, 1.0, (255, 255, 255), 2, cv2.LINE_AA)
        columns.append(np.concatenate(panels))
    height = max(len(column) for column in columns)
    padded = [np.pad(column, ((0, height - len(column)), (0, 0), (0, 0))) for column in columns]
    return np.concatenate(padded, axis=1)


def _curve_px(result: Reconstruction, rig: Rig, name: str) -> Array:
    if result.curve is None or name not in rig.camera_from_base:
        return np.zeros((0, 2))
    points = rig.project(name, result.curve.at(np.linspace(0.0, result.curve.length_mm, 201)))
    return points[np.isfinite(points).all(1)]


def _tube_box(image: Image, view: View | None, curve_px: Array) -> _Box | None:
    """Part of the picture with the tube, no higher than wide; None where there is no tube."""
    points = [curve_px]
    if view is not None:
        points += [view.edges_px.reshape(-1, 2), view.centreline_px, view.tip_px.reshape(1, 2)]
    found = np.concatenate(points)
    found = found[np.isfinite(found).all(1)]
    if len(found) == 0:
        return None
    limits = np.array([image.shape[1], image.shape[0]])
    low, high = np.clip(found.min(0), 0, limits - 1), np.clip(found.max(0), 0, limits - 1)
    # A margin of a fifth on either side keeps the surroundings in sight. At least as wide as high, so that an upright
    # tube does not make a panel of many screens, and at least half as high as wide.
    size = 1.4 * np.maximum(high - low, 0.04 * limits.max())
    size = np.minimum(np.maximum(size, size[::-1] * (1.0, 0.5)), limits).astype(int)
    corner = np.clip(np.rint((low + high) / 2 - size / 2), 0, limits - size).astype(int)
    return int(corner[0]), int(corner[1]), int(corner[0] + size[0]), int(corner[1] + size[1])


def _panel(image: Image, view: View | None, curve_px: Array, box: _Box, column_px: int) -> Image:
    x0, y0, x1, y1 = box
    scale = column_px / (x1 - x0)
    size = (column_px, max(round((y1 - y0) * scale), 1))
    part = cv2.resize(image[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    panel = np.ascontiguousarray(cv2.cvtColor(part, cv2.COLOR_GRAY2BGR) if part.ndim == 2 else part, dtype=np.uint8)

    def placed(points_px: Array) -> Array:
        return (points_px - (x0, y0) + 0.5) * scale - 0.5

    if view is not None:
        _line(panel, placed(view.edges_px[:, 0]), _EDGES, 1)
        _line(panel, placed(view.edges_px[:, 1]), _EDGES, 1)
        _dots(panel, placed(view.centreline_px), _CENTRELINE)
    _line(panel, placed(curve_px), _CURVE, 2)
    if view is not None and np.isfinite(view.tip_px).all():
        at = placed(view.tip_px)
        centre = (round(float(at[0])), round(float(at[1])))
        cv2.drawMarker(panel, centre, _TIP, cv2.MARKER_CROSS, 22, 1, cv2.LINE_AA)
        cv2.circle(panel, centre, 9, _TIP, 1, cv2.LINE_AA)
    return panel


def _line(panel: Image, points_px: Array, colour: tuple[int, int, int], width: int) -> None:
    points = points_px[np.isfinite(points_px).all(1)]
    if len(points) > 1:
        fixed = np.rint(points * 2**_SHIFT).astype(np.int32)
        cv2.polylines(panel, [fixed.reshape(-1, 1, 2)], False, colour, width, cv2.LINE_AA, _SHIFT)


def _dots(panel: Image, points_px: Array, colour: tuple[int, int, int]) -> None:
    for x, y in points_px[np.isfinite(points_px).all(1)]:
        centre = (round(float(x) * 2**_SHIFT), round(float(y) * 2**_SHIFT))
        cv2.circle(panel, centre, 3 * 2**_SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)


def _header(result: Reconstruction, width: int) -> Image:
    lines = _wrapped(_values(result), width - 32)
    header = np.full((_HEADER_PX + _LINE_PX * (len(lines) - 1), width, 3), 32, np.uint8)
    colour = (140, 230, 140) if result else (110, 160, 255)
    cv2.putText(header, f"{result.frame}   {result.status}", (16, 36), _FONT, 0.9, colour, 2, cv2.LINE_AA)
    for k, line in enumerate(lines):
        cv2.putText(header, line, (16, 76 + _LINE_PX * k), _FONT, _TEXT, (230, 230, 230), 1, cv2.LINE_AA)
    x = width - 16
    for text, swatch in reversed(_LEGEND):
        x -= cv2.getTextSize(text, _FONT, 0.55, 1)[0][0]
        cv2.putText(header, text, (x, 34), _FONT, 0.55, (230, 230, 230), 1, cv2.LINE_AA)
        cv2.line(header, (x - 32, 29), (x - 10, 29), swatch, 3, cv2.LINE_AA)
        x -= 52
    return header


def _wrapped(parts: list[str], width: int) -> list[str]:
    """Lines of parts that fit into a width; a part that is wider stays on a line of its own."""
    lines = [parts[0]]
    for part in parts[1:]:
        longer = f"{lines[-1]}   {part}"
        if cv2.getTextSize(longer, _FONT, _TEXT, 1)[0][0] <= width:
            lines[-1] = longer
        else:
            lines.append(part)
    return lines


def _values(result: Reconstruction) -> list[str]:
    shape = result.shape
    if not result or shape is None:
        return [_ascii(note) for note in result.notes or (result.status.advice,)]
    x, y, z = shape.tip_mm
    angle = f"{math.degrees(shape.orientation_rad):.2f} deg" if math.isfinite(shape.orientation_rad) else "undefined"
    model = result.curve.model if result.curve is not None else ""
    text = (
        f"tip ({x:.2f}, {y:.2f}, {z:.2f}) mm   bending {math.degrees(shape.bending_rad):.2f} deg   orientation {angle}"
        f"   length {shape.length_mm:.2f} mm   {model}, {result.fit_rms_px:.2f} px rms, {result.total_ms:.1f} ms"
    )
    return [_ascii(part) for part in (text, *result.notes)]


def _ascii(text: str) -> str:
    """Drop what OpenCV's stroke font does not have."""
    return text.encode("ascii", "replace").decode()
