"""What a board looks like: brightness of its pattern at any point, and as a camera should see it."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from tubesight.calibration.find import charuco_board
from tubesight.core import Array, Board
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose

# Samples per pixel and axis where the pattern is averaged over a pixel.
_SAMPLES = 3
# Texture pixels per square: at least this, and at least half again the pixels a square covers in the picture, so that
# the texture's own interpolation blurs less than the camera.
_MIN_CELL, _MAX_CELL = 64, 256
# Pixels between the points at which the lens is inverted; bilinear interpolation in between errs by less than 0.005
# pixels on a board at 45 degrees that fills a picture of 1000 pixels.
_STEP_PX = 4


@lru_cache(maxsize=8)
def _texture(board: Board, cell: int) -> Array:
    """Draw the board with half a square of white margin, `cell` pixels a square: the mean brightness of each pixel.

    The outer corner square at (0, 0) of a chessboard is white, of a ChArUco board black (see the file formats).
    """
    columns, rows = board.squares
    charuco = board.type == "charuco"
    white = (np.add.outer(np.arange(rows), np.arange(columns)) + charuco) % 2 == 0
    squares = np.repeat(np.repeat(white.astype(np.float64), cell, 0), cell, 1)
    if charuco:
        detector_board = charuco_board(board)
        dictionary = detector_board.getDictionary()
        count = dictionary.markerSize + 2
        cover = _cover(cell, count, float(board.marker_mm or 0) / board.square_mm)
        whole = cover.sum(1)
        for marker, corners in zip(np.ravel(detector_board.getIds()), detector_board.getObjPoints(), strict=True):
            bits = dictionary.generateImageMarker(int(marker), count, borderBits=1) > 127
            x, y = np.floor(np.mean(corners, 0)[:2] / board.square_mm).astype(int) * cell
            squares[y : y + cell, x : x + cell] = 1 - np.multiply.outer(whole, whole) + cover @ bits @ cover.T
    return np.pad(squares, cell // 2, constant_values=1.0)


def _cover(cell: int, count: int, share: float) -> Array:
    """Share (cell, count) of each of `cell` pixels along a square that each bit of its marker covers."""
    ends = (1 - share) / 2 + share * np.arange(count + 1) / count
    pixel = np.arange(cell)[:, None] / cell
    overlap = np.minimum(pixel + 1 / cell, ends[1:]) - np.maximum(pixel, ends[:-1])
    return np.asarray(np.maximum(overlap, 0.0) * cell)


def picture_of(
    board: Board, camera: Camera, camera_from_board: Pose, low: tuple[int, int], high: tuple[int, int]
) -> tuple[Array, Array]:
    """Render the pattern as a camera should see it, in a box of its picture.

    Parameters
    ----------
    low, high
        First and last pixel (x, y) of the box, the last excluded.

    Returns
    -------
    Array
        (H, W) brightness averaged over each pixel, 0 to 1.
    Array
        (H, W, 2): the point of the board in each pixel, in squares from its outer corner.
    """
    width, height = high[0] - low[0], high[1] - low[1]
    count = -(-width // _STEP_PX), -(-height // _STEP_PX)
    x, y = (low[k] + (np.arange(count[k]) + 0.5) * _STEP_PX - 0.5 for k in (0, 1))
    rays = camera.unproject(np.stack(np.meshgrid(x, y), -1))
    pose = camera_from_board
    to_board = np.linalg.inv(np.column_stack([pose.rotation[:, :2], pose.translation_mm]))
    at = rays @ to_board.T
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = at[..., :2] / at[..., 2:] / board.square_mm + (0 if board.type == "charuco" else 1)

    # Single precision places a point to a millionth of a square.
    squares = np.nan_to_num(squares, nan=-9.0).astype(np.float32)

    def finer(n: int) -> Array:
        fine = cv2.resize(squares, (count[0] * n, count[1] * n), interpolation=cv2.INTER_LINEAR)
        return np.asarray(fine[: height * n // _STEP_PX, : width * n // _STEP_PX])

    middle = finer(_STEP_PX)
    cell = _cell(middle)
    places = (finer(_STEP_PX * _SAMPLES) + np.float32(0.5)) * np.float32(cell) - np.float32(0.5)
    texture = _texture(board, cell)
    values = cv2.remap(
        texture, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    # An integer factor: the mean over the samples of each pixel.
    return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)), middle


def _cell(squares: Array) -> int:
    """Texture pixels per square for a picture of the board: a power of two."""
    step = np.linalg.norm(np.diff(squares, axis=1), axis=-1)
    px = 1.5 / max(float(np.median(step)), 1e-6)
    return int(np.clip(2 ** np.ceil(np.log2(px)), _MIN_CELL, _MAX_CELL))
