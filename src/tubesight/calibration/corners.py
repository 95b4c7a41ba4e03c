"""Corners of a board in one picture, and the tests both kinds of board share."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubesight.core import Array, Board, Image, readonly

Ids = NDArray[np.intp]

# Distance from a corner at which the four squares around it are sampled, as a share of the square: near the middle of
# a chessboard's squares; on ChArUco the border between corner and marker is (square - marker) / 2 wide.
_CHESSBOARD_SAMPLE = 0.3
# An X corner answers 1 and the corner of a lone black square 0.5 (see `crossing`): halfway is 0.75.
CROSSING = 0.75
# A picture with less contrast than this many gray levels between its black and white squares shows no board.
_MIN_CONTRAST = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Inner corners found in one picture.

    Attributes
    ----------
    ids
        (N,): rows of ``Board.corners_mm``, ascending.
    px
        (N, 2)
    """

    ids: Ids
    px: Array

    def __post_init__(self) -> None:
        ids = np.array(self.ids, dtype=np.intp)
        ids.flags.writeable = False
        object.__setattr__(self, "ids", ids)
        object.__setattr__(self, "px", readonly(self.px, (len(ids), 2), "corners px"))

    def grid(self, board: Board) -> Array:
        """Corners (rows, columns, 2) in their places on the board, NaN where not seen."""
        columns, rows = board.inner_corners
        grid = np.full((rows * columns, 2), np.nan)
        grid[self.ids] = self.px
        return grid.reshape(rows, columns, 2)


def sample(gray: Image, px: Array) -> Array:
    """Gray levels (...,) at pixels (..., 2), bilinear; NaN outside the picture."""
    height, width = gray.shape
    inside = (px >= 0).all(-1) & (px[..., 0] <= width - 1) & (px[..., 1] <= height - 1)
    at = np.where(inside[..., None], px, 0.0)
    x0, y0 = (np.minimum(at[..., i].astype(np.intp), n - 2) for i, n in ((0, width), (1, height)))
    fx, fy = at[..., 0] - x0, at[..., 1] - y0
    g = gray.astype(np.float64) if gray.size < 4 * px.size else gray
    top = g[y0, x0] * (1 - fx) + g[y0, x0 + 1] * fx
    bottom = g[y0 + 1, x0] * (1 - fx) + g[y0 + 1, x0 + 1] * fx
    return np.where(inside, top * (1 - fy) + bottom * fy, np.nan)


def sample_share(board: Board) -> float:
    """Distance from a corner, in squares along both axes, at which its four squares show their own colour."""
    if board.marker_mm is None:
        return _CHESSBOARD_SAMPLE
    return 0.5 * (board.square_mm - board.marker_mm) / (2 * board.square_mm)


def crossing(gray: Image, corner: Array, right: Array, down: Array, share: float) -> Array:
    """Signed answer of X corners: white, black, white, black squares around it from the upper left give +.

    Parameters
    ----------
    corner, right, down
        (N, 2): pixels of the corner; steps of one square along the board's x and y there.
    share
        Distance of the samples in squares.

    Returns
    -------
    Array
        (N,): (upper left + lower right - upper right - lower left) / 2, gray levels; NaN outside the picture.
    """
    levels = _around(gray, corner, right, down, share)
    return np.asarray((levels[0] - levels[1] + levels[2] - levels[3]) / 2)


def _around(gray: Image, corner: Array, right: Array, down: Array, share: float) -> Array:
    """Gray levels (4, N) in the upper left, upper right, lower right and lower left square around corners."""
    a, b = share * right, share * down
    return np.stack([sample(gray, corner + s) for s in (-a - b, a - b, a + b, b - a)])


def steps(grid: Array) -> tuple[Array, Array]:
    """Return a grid's steps of one square along columns and rows (rows, columns, 2); NaN where both neighbours lack."""
    pairs = []
    for axis in (1, 0):
        n = grid.shape[axis]
        middle = np.take(grid, np.arange(n), axis)
        after = np.take(grid, np.minimum(np.arange(n) + 1, n - 1), axis)
        before = np.take(grid, np.maximum(np.arange(n) - 1, 0), axis)
        forward, backward = after - middle, middle - before
        forward[_at(axis, -1)] = np.nan
        backward[_at(axis, 0)] = np.nan
        both = np.stack([forward, backward])
        known = np.isfinite(both)
        total, count = np.where(known, both, 0.0).sum(0), known.sum(0)
        pairs.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    return pairs[0], pairs[1]


def _at(axis: int, index: int) -> tuple[slice | int, ...]:
    return (slice(None),) * axis + (index,)


def contrast(gray: Image, grid: Array, share: float) -> tuple[float, Array]:
    """Sign and answers of a grid's corners as X corners of alternating sign.

    Returns
    -------
    float
        Median answer, gray levels: half the contrast; positive where the first inner square is white.
    Array
        (rows, columns) answers divided by the median: about 1 at every true corner.
    """
    right, down = steps(grid)
    answers = crossing(gray, grid, right, down, share)
    rows, columns = answers.shape
    # The square to the lower right of corner (0, 0) is the first inner square: white there gives + at even corners.
    parity = 1 - 2 * (np.add.outer(np.arange(rows), np.arange(columns)) % 2)
    signed = answers * parity
    median = float(np.nanmedian(signed)) if np.isfinite(signed).any() else 0.0
    return median, signed / median if abs(median) > _MIN_CONTRAST / 2 else np.full_like(signed, np.nan)


def purity(gray: Image, grid: Array, share: float) -> float:
    """Share of the picture's contrast that the four squares around a grid's corners show (median), 0 to 1.

    A grid laid diagonally over a board, as a finder makes it of a larger board, samples edges and shows half.
    """
    levels = _around(gray, grid, *steps(grid), share)
    if not np.isfinite(levels).any():
        return 0.0
    black, white = np.nanpercentile(levels, [10, 90])
    median, _ = contrast(gray, grid, share)
    return abs(median) / max(float(white - black), _MIN_CONTRAST)


def continues_beyond(gray: Image, board: Board, corners: Corners) -> bool:
    """Tell whether the pattern goes on past the grid found: it is part of a larger board.

    Extrapolates one row or column on each side and asks whether most of those points are X corners too.
    """
    grid = corners.grid(board)
    share = sample_share(board)
    median, _ = contrast(gray, grid, share)
    if abs(median) <= _MIN_CONTRAST / 2:
        return False
    for turned in (grid, grid[::-1], grid.transpose(1, 0, 2), grid[:, ::-1].transpose(1, 0, 2)):
        # Quadratic through the three outer rows: exact for a board in perspective up to third order.
        beyond = 3 * turned[0] - 3 * turned[1] + turned[2]
        along = np.gradient(beyond, axis=0)
        outwards = beyond - turned[0]
        answers = np.abs(crossing(gray, beyond, along, outwards, share)) / abs(median)
        known = answers[np.isfinite(answers)]
        if len(known) >= 0.5 * len(answers) and np.mean(known > CROSSING) > 0.5:
            return True
    return False


def refine(gray: Image, px: Array, half_window_px: Ids) -> Array:
    """Refine corners (N, 2) to sub-pixels, each within its own window (N,); those too near the border stay."""
    refined = np.array(px, dtype=np.float64)
    height, width = gray.shape
    border = np.minimum(px, np.array([width, height]) - 1 - px).min(-1)
    for half in np.unique(half_window_px):
        chosen = (half_window_px == half) & (border > half + 1)
        if chosen.any():
            start = px[chosen].astype(np.float32).reshape(-1, 1, 2)
            # 40 iterations down to a thousandth of a pixel, a tenth of what the corner is known to.
            criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-3)
            refined[chosen] = cv2.cornerSubPix(gray, start, (int(half), int(half)), (-1, -1), criteria).reshape(-1, 2)
    return refined
