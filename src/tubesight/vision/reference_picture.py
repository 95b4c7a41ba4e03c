"""The paper's pre-processing: undistort, crop, threshold the background, clean, find the origin.

Dalvand, Nahavandi & Howe 2016, section 3.1, figure 4 (a) and (b). Pixels of this pipeline are those of the undistorted
picture; its camera is the pinhole ``camera.matrix``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tubesight.core import Array, Image, Status, Unmeasurable, readonly
from tubesight.geometry.camera import Camera

Box = tuple[int, int, int, int]

# Half width of the crop over its height below the base. A tube that fits straight into that height bends aside by at
# most max (1 - cos t) / t = 0.72 of its length; bending partly towards the camera makes that 0.78 in the picture where
# the distance is twice the length.
_ASIDE = 0.8
# The tube hangs: its way at the base is within 45 degrees of down, so that its topmost points are its base.
_DOWN_MIN = np.cos(np.radians(45))
# Colour of the background: median over every 16th pixel each way (some 4000 pixels of a tube-free majority).
_STRIDE = 16
# Share of a colour that is not gray above which the background is removed by its colour, else by its brightness.
_COLOURED = 0.25
# Gray levels by which the tube has to stand out: below, Otsu's threshold splits noise (sensor noise and JPEG: 2 to 4).
_CONTRAST_MIN = 12.0
# The threshold over Otsu's, which lies half way to the mean of the tube: the part in the holder's shadow and the
# shaded limb are half as bright as that mean, the cloth stays below a tenth of it.
_OTSU_SHARE = 0.6
# Smallest area of a tube, pixels.
_AREA_MIN = 500.0
# Rows below the topmost point in which the top corners are looked for, and depth below the base at which the tube has
# to start, in widths.
_CORNER_WIDTHS, _HIDDEN_WIDTHS = 0.25, 0.5

FixedMaps = tuple[NDArray[np.int16], NDArray[np.uint16]]


@dataclass(frozen=True, slots=True, eq=False)
class Catheter:
    """The isolated catheter in the crop.

    Attributes
    ----------
    mask
        (H, W) 255 on the catheter, else 0.
    contour_px
        (N, 2) its outer contour, whole pixels.
    origin_px
        (2,) middle between its top left and top right points.
    corners_px
        (2, 2) these points.
    """

    mask: Image
    contour_px: Array
    origin_px: Array
    corners_px: Array

    def __post_init__(self) -> None:
        for name, shape in (("contour_px", (None, 2)), ("origin_px", (2,)), ("corners_px", (2, 2))):
            object.__setattr__(self, name, readonly(getattr(self, name), shape, name))

    @property
    def width_px(self) -> float:
        """Width of the tube at its origin."""
        return float(np.linalg.norm(self.corners_px[1] - self.corners_px[0])) + 1.0


def ideal_px(camera: Camera, points_px: Array) -> Array:
    """Move pixels (..., 2) of the photograph to the undistorted picture."""
    return camera.pixel_from_plane(camera.unproject(points_px)[..., :2])


def rays_of(camera: Camera, points_px: Array) -> Array:
    """Rays ``v = (x, y, 1)`` (..., 3) of pixels (..., 2) of the undistorted picture (equation 1)."""
    homogeneous = np.concatenate([points_px, np.ones((*points_px.shape[:-1], 1))], -1)
    return np.asarray(homogeneous @ np.linalg.inv(camera.matrix).T)


def crop_box(camera: Camera, base_px: Array | None, way: Array | None) -> Box:
    """Crop (x0, y0, x1, y1) of the undistorted picture: from the base down; all of it where no base is known.

    Parameters
    ----------
    base_px, way
        (2,) the base and the tube's way there in the photograph.

    Raises
    ------
    Unmeasurable
        If the tube does not hang down in the picture, or its base is outside.
    """
    width, height = camera.size_px
    if base_px is None:
        return 0, 0, width, height
    base = ideal_px(camera, base_px)
    if way is not None and way[1] < _DOWN_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="the paper's image processing needs a tube that hangs down")
    top = round(float(base[1])) if np.isfinite(base).all() else -1
    aside = _ASIDE * (height - top)
    left, right = max(int(base[0] - aside), 0), min(int(base[0] + aside) + 1, width)
    if not (0 <= top < height - 1 and left < right - 1):
        raise Unmeasurable(Status.BASE_HIDDEN, detail="the base origin projects outside of the picture")
    return left, top, right, height


@lru_cache(maxsize=8)
def undistortion_maps(camera: Camera, box: Box) -> FixedMaps:
    """Fixed-point maps for `cv2.remap` of one crop of the undistorted picture; made once per camera and crop."""
    x0, y0, x1, y1 = box
    grid = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), -1).astype(float)
    source = camera.project(rays_of(camera, grid)).astype(np.float32)
    fixed, fraction = cv2.convertMaps(source[..., 0], source[..., 1], cv2.CV_16SC2)
    return np.asarray(fixed, np.int16), np.asarray(fraction, np.uint16)


def undistort_box(image: Image, camera: Camera, box: Box, whole: bool) -> Image:
    """Undistort a photograph and crop it; `whole` undistorts all of it first, as the paper does."""
    x0, y0, x1, y1 = box
    part = (0, 0, *camera.size_px) if whole else box
    # Replicated, since black beyond the border of the photograph would not be background.
    picture = cv2.remap(image, *undistortion_maps(camera, part), cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    return np.asarray(picture[y0:y1, x0:x1] if whole else picture, np.uint8)


def without_background(picture: Image) -> Image:
    """Gray picture (H, W) in which the background is dark: what remains of each colour without the background's.

    A coloured background (the paper: blue felt) is removed at any brightness, so shadows go with it: gray is projected
    to be perpendicular to the background's colour. From a gray one the difference of brightness remains.
    """
    few = picture[::_STRIDE, ::_STRIDE].reshape(-1, picture.shape[2] if picture.ndim == 3 else 1)
    colour = np.median(few, axis=0)
    if len(colour) == 3 and np.ptp(colour) > _COLOURED * colour.sum():
        unit = colour / np.linalg.norm(colour)
        weights = np.ones(3) - unit.sum() * unit
        # Scaled so that gray keeps its level; three equal rows, for which OpenCV is six times faster than for one.
        rows = np.tile(weights / weights.sum(), (3, 1)).astype(np.float32)
        return np.asarray(cv2.extractChannel(cv2.transform(picture, rows), 0), np.uint8)
    gray = picture if picture.ndim == 2 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    return np.asarray(cv2.absdiff(gray, np.full_like(gray, np.uint8(np.median(gray[::_STRIDE, ::_STRIDE])))), np.uint8)


def threshold(signal: Image) -> Image:
    """Binary picture (figure 4 b) by Otsu's threshold, opened by 3 x 3 pixels against noise.

    Raises
    ------
    Unmeasurable
        If nothing stands out.
    """
    level, _ = cv2.threshold(signal, 0, 255, cv2.THRESH_OTSU)
    if level < _CONTRAST_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="nothing stands out from the background")
    _, binary = cv2.threshold(signal, _OTSU_SHARE * level, 255, cv2.THRESH_BINARY)
    return np.asarray(cv2.morphologyEx(binary, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.uint8)


def isolate(binary: Image, from_base: bool) -> Catheter:
    """Keep the largest white region, without holes, and find the origin at its top.

    Parameters
    ----------
    from_base
        Whether the crop starts at the base, so that the tube has to reach its top.

    Raises
    ------
    Unmeasurable
        If there is no such region, or it starts elsewhere.
    """
    contours, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    areas = [cv2.contourArea(contour) for contour in contours]
    if not areas or max(areas) < _AREA_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no region as large as a tube stands out")
    largest = int(np.argmax(areas))
    mask = np.zeros_like(binary)
    cv2.drawContours(mask, contours, largest, 255, cv2.FILLED)
    contour = contours[largest].reshape(-1, 2).astype(float)
    low, high = contour.min(0), contour.max(0)
    width = areas[largest] / float(np.hypot(*(high - low)))
    if from_base and low[1] > _HIDDEN_WIDTHS * width:
        raise Unmeasurable(Status.BASE_HIDDEN, detail=f"what stands out starts {low[1]:.0f} px below the base")
    corners = _top_corners(contour, low[1] + _CORNER_WIDTHS * width)
    return Catheter(mask, contour, corners.mean(0), corners)


def _top_corners(contour: Array, last_row: float) -> Array:
    """Top left and top right points (2, 2) of a contour: extreme along the two diagonals in its first rows."""
    top = contour[contour[:, 1] <= last_row]
    return top[[int(np.argmin(top.sum(1))), int(np.argmax(top[:, 0] - top[:, 1]))]]
