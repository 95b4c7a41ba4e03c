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


def shade(board: Board, squares: Array) -> Array:
    """Brightness, 0 or 1, of a board at points (..., 2) in squares from its outer corner; white outside.

    The colour of a chessboard's outer corner square at (0, 0) is white (board frames: see the file formats).
    """
    columns, rows = board.squares
    place = np.floor(squares).astype(np.intp)
    i, j = (np.clip(place[..., k], 0, n - 1) for k, n in ((0, columns), (1, rows)))
    inside = (place[..., 0] == i) & (place[..., 1] == j)
    if board.marker_mm is None:
        return np.where(inside, (i + j + 1) % 2, 1.0)
    table = _marker_table(board)
    bits = table.shape[-1]
    share = board.marker_mm / board.square_mm
    cell = (squares - place - (1 - share) / 2) / share * bits
    bit = np.clip(np.floor(cell).astype(np.intp), 0, bits - 1)
    in_marker = ((cell >= 0) & (cell < bits)).all(-1)
    white = table[j, i, 0, 0] != _BLACK_SQUARE
    marked = np.where(in_marker, table[j, i, bit[..., 1], bit[..., 0]] == 1, True)
    return np.where(inside, (white & marked).astype(float), 1.0)


# Stands for "no marker here" among the bits, which are 0 and 1.
_BLACK_SQUARE = 2


@lru_cache(maxsize=8)
def _texture(board: Board, cell: int) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """The board with half a square of margin, `cell` pixels a square; each the mean brightness of its area."""
    fine = 4
    x, y = ((np.arange((n + 1) * cell * fine) + 0.5) / (cell * fine) - 0.5 for n in board.squares)
    rows = [shade(board, np.stack(np.meshgrid(x, part), -1)) for part in np.split(y, board.squares[1] + 1)]
    values = np.concatenate(rows).reshape(len(y) // fine, fine, len(x) // fine, fine)
    return values.mean((1, 3), dtype=np.float32)


def _marker_table(board: Board) -> np.ndarray[tuple[int, ...], np.dtype[np.intp]]:
    """Bits (rows, columns, n, n) of the marker in each white square, border included; 2 in black squares."""
    charuco = charuco_board(board)
    dictionary = charuco.getDictionary()
    bits = dictionary.markerSize + 2
    columns, rows = board.squares
    table = np.full((rows, columns, bits, bits), _BLACK_SQUARE, dtype=np.intp)
    for marker, corners in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True):
        i, j = np.floor(np.mean(corners, 0)[:2] / board.square_mm).astype(int)
        table[j, i] = dictionary.generateImageMarker(int(marker), bits, borderBits=1) > 127
    return table


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

    squares = np.nan_to_num(squares, nan=-9.0)

    def finer(n: int) -> Array:
        fine = cv2.resize(squares, (count[0] * n, count[1] * n), interpolation=cv2.INTER_LINEAR)
        return np.asarray(fine[: height * n // _STEP_PX, : width * n // _STEP_PX])

    middle = finer(_STEP_PX)
    cell = _cell(middle)
    places = ((finer(_STEP_PX * _SAMPLES) + 0.5) * cell - 0.5).astype(np.float32)
    texture = _texture(board, cell)
    values = cv2.remap(texture, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)
    return values.reshape(height, _SAMPLES, width, _SAMPLES).mean((1, 3), dtype=np.float64), middle


def _cell(squares: Array) -> int:
    """Texture pixels per square for a picture of the board: a power of two."""
    step = np.linalg.norm(np.diff(squares, axis=1), axis=-1)
    px = 1.5 / max(float(np.median(step)), 1e-6)
    return int(np.clip(2 ** np.ceil(np.log2(px)), _MIN_CELL, _MAX_CELL))
