"""Stages of the pipelines that walk along the tube and measure its edges, for one photograph."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from tubesight.core import Array, Image, Unmeasurable
from tubesight.vision.silhouette import choose
from tubesight.vision.view import View

_Stage = tuple[str, Image]
# What is shown around the tube and around its tip, in widths; the drawn part is enlarged to this longer side, and the
# signal is computed for as many pixels.
_TUBE_WIDTHS, _TIP_WIDTHS, _SIDE_PX = 1.5, 1.2, 960
# Scans lie 6 px apart: one in three is drawn, and reaches half a width beyond both edges.
_SCANS_DRAWN, _SCAN_BEYOND = 3, 0.5
_EDGE, _CENTRELINE, _CURVE, _TIP, _SCAN = (255, 190, 60), (60, 220, 255), (230, 60, 255), (60, 60, 255), (90, 220, 90)


def own_stages(image: Image, background: Image | None, view: View, curve_px: Array | None) -> Iterator[_Stage]:
    """Titles and pictures: signal, scans, edges, tip contour, centreline and, where there is a curve, reprojection.

    Parameters
    ----------
    image, background
        The photograph, and the scene without the tube or None.
    view
        What was seen in it.
    curve_px
        (N, 2) the curve projected into the photograph, or None.
    """
    width = float(np.median(view.widths_px))
    found = np.vstack([view.edges_px.reshape(-1, 2), view.tip.contour_px])
    tube = _Part(image, found, _TUBE_WIDTHS * width)
    signal = _signal(tube, background, view, width)
    if signal is not None:
        yield "signal", signal
    across = _SCAN_BEYOND * (view.edges_px[:, 0] - view.edges_px[:, 1])
    scans = np.stack([view.edges_px[:, 0] + across, view.edges_px[:, 1] - across], 1)[::_SCANS_DRAWN]
    yield "scans", tube.drawn(lines=[(scan, _SCAN) for scan in scans])
    yield "edges", tube.drawn(dots=[(view.edges_px.reshape(-1, 2), _EDGE)])
    tip = _Part(image, np.vstack([view.tip.contour_px, view.tip_px]), _TIP_WIDTHS * width)
    yield "tip contour", tip.drawn(dots=[(view.tip.contour_px, _EDGE), (view.tip_px[None], _TIP)])
    yield "centreline", tube.drawn(dots=[(view.centreline_px, _CENTRELINE), (view.tip_px[None], _TIP)])
    if curve_px is not None:
        yield "reprojection", tube.drawn(lines=[(curve_px, _CURVE)], dots=[(curve_px[[0, -1]], _TIP)])


class _Part:
    """Part of a photograph around some points, enlarged."""

    def __init__(self, image: Image, points_px: Array, margin_px: float) -> None:
        limits = np.array(image.shape[1::-1])
        self.low = np.clip(np.floor(points_px.min(0) - margin_px), 0, limits - 1).astype(int)
        self.high = np.clip(np.ceil(points_px.max(0) + margin_px), self.low + 1, limits).astype(int)
        self.image = image
        self.scale = _SIDE_PX / float((self.high - self.low).max())

    def drawn(
        self,
        lines: list[tuple[Array, tuple[int, int, int]]] | None = None,
        dots: list[tuple[Array, tuple[int, int, int]]] | None = None,
    ) -> Image:
        """Enlarge it and draw polylines (N, 2) and dots (N, 2) given in pixels of the photograph."""
        part = self.image[self.low[1] : self.high[1], self.low[0] : self.high[0]]
        method = cv2.INTER_CUBIC if self.scale > 1 else cv2.INTER_AREA
        part = np.asarray(cv2.resize(part, None, fx=self.scale, fy=self.scale, interpolation=method), np.uint8)
        picture = np.array(cv2.cvtColor(part, cv2.COLOR_GRAY2BGR) if part.ndim == 2 else part, np.uint8)
        for points, colour in lines or []:
            cv2.polylines(picture, [self._placed(points)], False, colour, 2, cv2.LINE_AA, 4)
        for points, colour in dots or []:
            for x, y in self._placed(points).tolist():
                cv2.circle(picture, (x, y), 3 * 16, colour, cv2.FILLED, cv2.LINE_AA, 4)
        return picture

    def _placed(self, points_px: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
        """Pixels of the enlarged part in sixteenths."""
        good = points_px[np.isfinite(points_px).all(1)]
        return np.asarray(np.rint(((good - self.low + 0.5) * self.scale - 0.5) * 16), np.int32)

    def grid(self) -> Array:
        """Pixels (H, W, 2) of the photograph under those of the enlarged part."""
        size = np.rint((self.high - self.low) * self.scale).astype(int)
        x, y = (self.low[i] + (np.arange(size[i]) + 0.5) / self.scale - 0.5 for i in (0, 1))
        return np.stack(np.meshgrid(x, y), -1)


def _signal(part: _Part, background: Image | None, view: View, width: float) -> Image | None:
    """Likeness to tube with the colours learned at the start of the tube; None where they cannot be told apart."""
    start, ahead = view.centreline_px[0], view.centreline_px[min(3, len(view.centreline_px) - 1)]
    way = (ahead - start) / np.linalg.norm(ahead - start)
    try:
        signal = choose(part.image, background, start, way, width)
    except Unmeasurable:
        return None
    return np.asarray(np.nan_to_num(signal(part.grid())) * 255, np.uint8)
