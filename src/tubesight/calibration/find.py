"""Finding the board in one picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from tubesight.calibration.corners import CROSSING, Corners, Ids, contrast, purity, refine, sample_share, steps
from tubesight.core import Array, Board, Image

# Longest side of the picture searched first: a failing search at 1920 pixels takes 0.8 s, at 960 0.2 s, and of 32
# pictures of 1920 x 1080 all were found at this size. Larger pictures are searched at 1920 at most.
_FIRST_SIDE_PX = 960
_LAST_SIDE_PX = 1920
# Fewer corners of a ChArUco board than this do not fix its pose well enough to be of use.
_MIN_CHARUCO_CORNERS = 6
# Share of the corners of each row and column that have to look like X corners: a finger hides a few, but where the
# finder took the outline of a smaller board for corners a whole row or column fails.
_MIN_TRUE_CORNERS = 0.5


def find_corners(gray: Image, board: Board, *, again: bool = False) -> Corners | None:
    """Find the board in a gray picture.

    Parameters
    ----------
    again
        Try what was left out to save time at first: pictures of more than 960 pixels at full size. A failing search
        takes about 0.4 s, the second one about a second more.

    Returns
    -------
    Corners or None
        In the board frame of the file formats; chessboards whole, ChArUco also in part.
    """
    if board.type == "charuco":
        return None if again else _find_charuco(gray, board)
    return _find_chessboard(gray, board, again)


def _find_chessboard(gray: Image, board: Board, again: bool) -> Corners | None:
    columns, rows = board.inner_corners
    for search, scale in _searches(gray, again):
        found, px = search(_scaled(gray, scale), (columns, rows))
        if not found:
            continue
        # Pixel centres are at integers: pixel 0 of the small picture covers pixels 0 to 1 / scale - 1.
        grid = (px.reshape(rows, columns, 2).astype(np.float64) + 0.5) / scale - 0.5
        grid = refine(gray, grid.reshape(-1, 2), _window(grid, 2).ravel()).reshape(grid.shape)
        oriented = _oriented(gray, grid, board)
        if oriented is not None:
            return Corners(np.arange(rows * columns), oriented.reshape(-1, 2))
    return None


def _scaled(gray: Image, scale: float) -> Image:
    if scale == 1:
        return gray
    return np.asarray(cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


_Search = Callable[[Image, tuple[int, int]], tuple[bool, Array]]


def _searches(gray: Image, again: bool) -> Iterator[tuple[_Search, float]]:
    """Finders and scales, cheap before dear."""
    scale = min(1.0, _FIRST_SIDE_PX / max(gray.shape))
    if not again:
        yield _classic, scale
        yield _sectors, scale
    elif scale < 1:
        yield _classic, min(1.0, _LAST_SIDE_PX / max(gray.shape))


def _classic(gray: Image, inner: tuple[int, int]) -> tuple[bool, Array]:
    found, px = cv2.findChessboardCorners(
        gray, inner, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    return bool(found), np.asarray(px)


def _sectors(gray: Image, inner: tuple[int, int]) -> tuple[bool, Array]:
    found, px = cv2.findChessboardCornersSB(gray, inner, flags=0)
    return bool(found), np.asarray(px)


def _oriented(gray: Image, grid: Array, board: Board) -> Array | None:
    """Turn a grid (rows, columns, 2) into the board frame; None where it is no chessboard.

    The frame is right-handed with z away from the viewer, so x to y turns clockwise in the picture. Where half a turn
    (or a quarter, on a square grid) would change the colours, the first inner square is white: that is the format's
    rule, and the order of OpenCV's sector-based finder.
    """
    right, down = grid[:, -1] - grid[:, 0], grid[-1] - grid[0]
    across, along = right.mean(0), down.mean(0)
    if across[0] * along[1] - across[1] * along[0] < 0:
        grid = grid[:, ::-1]
    median, answers = contrast(gray, grid, sample_share(board))
    true = answers > CROSSING
    pure = purity(gray, grid, sample_share(board)) > CROSSING
    if not pure or min(true.mean(0).min(), true.mean(1).min()) < _MIN_TRUE_CORNERS:
        return None
    if median > 0:
        return grid
    columns, rows = board.squares
    if (columns + rows) % 2 == 1:
        return grid[::-1, ::-1]
    if columns == rows and columns % 2 == 0:
        return grid.transpose(1, 0, 2)[:, ::-1]
    return grid


def turns(board: Board) -> list[Ids]:
    """Orders of the corners that no picture of a chessboard can tell apart, the identity first.

    Each is an index array: corner ``i`` of the board may be corner ``turn[i]`` of another picture of it.
    """
    columns, rows = board.inner_corners
    grid = np.arange(rows * columns).reshape(rows, columns)
    orders = [grid]
    if board.type == "chessboard":
        if (sum(board.squares)) % 2 == 0:
            orders.append(grid[::-1, ::-1])
        if columns == rows and columns % 2 == 0:
            orders += [np.rot90(grid), np.rot90(grid, -1)]
    return [order.ravel() for order in orders]


def ambiguity(board: Board) -> str:
    """Say in a sentence why the board frame is OpenCV's own choice; empty where the colours fix it."""
    columns, rows = board.squares
    if board.type == "charuco" or (columns % 2 == 0 and rows % 2 == 1):
        return ""
    return (
        f"both sides of a board of {columns} x {rows} squares look alike, so the board frame is OpenCV's own order; "
        "take an even number of columns and an odd number of rows (for example 10 x 7)"
    )


def _window(grid: Array, least_px: int) -> Ids:
    """Half windows (rows, columns) for refining: 0.45 of the square's smaller height, `least_px` to 7 pixels.

    A window that reaches the neighbouring corners drags the corner; a larger one averages more noise.
    """
    right, down = steps(grid)
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    longest = np.maximum(np.linalg.norm(right, axis=-1), np.linalg.norm(down, axis=-1))
    height = np.nan_to_num(area / np.maximum(longest, 1e-9), nan=0.0)
    return np.asarray(np.clip(0.45 * height, least_px, 7), dtype=np.intp)


def _find_charuco(gray: Image, board: Board) -> Corners | None:
    detector = cv2.aruco.CharucoDetector(charuco_board(board))
    px, ids, _, _ = detector.detectBoard(gray)
    if ids is None or len(ids) < _MIN_CHARUCO_CORNERS:
        return None
    numbers = np.ravel(ids).astype(np.intp)
    order = np.argsort(numbers)
    corners = Corners(numbers[order], np.reshape(px, (-1, 2)).astype(np.float64)[order])
    spread = np.linalg.matrix_rank(board.corners_mm[corners.ids, :2] - board.corners_mm[corners.ids[0], :2])
    return corners if spread == 2 else None


def check_board(board: Board) -> None:
    """Raise `ValueError` for a board that cannot be searched."""
    if board.type == "charuco":
        charuco_board(board)
    elif min(board.squares) < 4:
        raise ValueError(f"squares: a chessboard needs at least 4 columns and 4 rows, got {list(board.squares)}")


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """OpenCV's ChArUco board; raises `ValueError` where the dictionary is unknown or too small."""
    name = str(board.dictionary)
    if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        raise ValueError(f"dictionary: OpenCV has no {name!r}; use the one the board was printed with")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    markers = board.squares[0] * board.squares[1] // 2
    if markers > len(dictionary.bytesList):
        raise ValueError(f"{name} has {len(dictionary.bytesList)} markers, the board needs {markers}")
    return cv2.aruco.CharucoBoard(board.squares, board.square_mm, float(board.marker_mm or 0), dictionary)
