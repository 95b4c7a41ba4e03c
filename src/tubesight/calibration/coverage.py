"""Where a board has been seen in a camera's pictures, drawn."""

from __future__ import annotations

import cv2
import numpy as np

from tubesight.calibration.quality import CELLS
from tubesight.core import Array, Image

# BGR: cells without a corner, corners kept, corners of this picture; OpenCV draws with so many fractional bits.
_EMPTY = np.array([70.0, 60.0, 150.0])
_KEPT, _NOW = (90.0, 220.0, 90.0), (80.0, 240.0, 255.0)
_SHIFT = 4


def draw_coverage(photograph: Image | None, size_px: tuple[int, int], kept: Array, now: Array, width_px: int) -> Image:
    """Draw corners over a photograph, and tint the cells of the picture that hold none.

    Parameters
    ----------
    photograph
        BGR or gray; None for a plain ground.
    size_px
        (width, height) of the camera's pictures.
    kept, now
        (N, 2) and (M, 2) pixels of corners: those kept, and those of this photograph.
    width_px
        Of the drawing.
    """
    width, height = size_px
    scale = width_px / width
    shape = (max(round(height * scale), 1), width_px)
    picture: Image = np.full((*shape, 3), 40, np.uint8)
    if photograph is not None:
        small = cv2.resize(photograph, shape[::-1], interpolation=cv2.INTER_AREA)
        picture = np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR) if small.ndim == 2 else small, np.uint8)
    tint_empty(picture, kept * scale)
    for corners, colour, radius in ((kept, _KEPT, 2), (now, _NOW, 3)):
        for x, y in np.rint((((corners + 0.5) * scale) - 0.5) * 2**_SHIFT).astype(int).tolist():
            cv2.circle(picture, (x, y), radius << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
    return picture


def tint_empty(picture: Image, px: Array) -> None:
    """Tint the cells of a picture without a corner, the corners (N, 2) being pixels of this picture."""
    size = picture.shape[:2]
    columns, rows = CELLS
    for j in range(rows):
        for i in range(columns):
            x, y = (slice(s * k // n, s * (k + 1) // n) for s, k, n in ((size[1], i, columns), (size[0], j, rows)))
            inside = (px[:, 0] >= x.start) & (px[:, 0] < x.stop) & (px[:, 1] >= y.start) & (px[:, 1] < y.stop)
            if not inside.any():
                picture[y, x] = (0.75 * picture[y, x] + 0.25 * _EMPTY).astype(np.uint8)
