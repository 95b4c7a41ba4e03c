"""Corners measured where a first calibration projects them: the corner finder is the largest error of a calibration.

The board as the camera should see it (full lens model, pattern, blur) is laid over the picture, and every corner's
surroundings are shifted until they fit: ``I(p + d) = a + b S(p)``, linear least squares in (a, b, b d), two steps. All
edges within half a square of the corner take part, so a ChArUco board's markers help instead of disturbing. Measured on
renders with known corners: 0.01 to 0.03 px, where windows of `cornerSubPix` at the same places gave 0.04 to 0.12 px.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tubesight.calibration.corners import Corners
from tubesight.calibration.pattern import picture_of
from tubesight.calibration.scene import Scene
from tubesight.core import Array, Board, Image

Box = NDArray[np.float32]

# Chebyshev distance from the corner, in squares, of the pixels that take part: short of the neighbouring corners, and
# within the outer squares also where these are cut narrower than the others.
_REACH = 0.45
# Largest distance in pixels: on large squares more pixels add little, and the board's own bend begins to count.
_MAX_REACH_PX = 20
# Fewer pixels than this (a square 5 pixels wide) do not fix a corner.
_MIN_PIXELS = 20
# Standard deviations in pixels of the blur tried: sharp to badly out of focus. The one that explains the board best is
# taken; a wrong one costs precision, not bias.
_BLURS_PX = (0.6, 1.0, 1.6, 2.5)
# Share of the brightness's variance around a corner that the pattern may leave unexplained: it is 0.01 to 0.1 on good
# pictures, 0.2 with blur misjudged by a factor of two, near 1 on a finger or beside the board.
_MAX_UNEXPLAINED = 0.3
# Half a finger shifts a corner by half a pixel and leaves several times more unexplained than the view's other corners
# have; less than this share is left by noise.
_UNEXPLAINED_RATIO, _UNEXPLAINED = 4.0, 0.06
# Determinant of the scaled normal equations below which the surroundings do not fix the corner (a plain patch).
_MIN_FIXED = 1e-6
# Gray levels between black and white below which there is nothing to measure but noise.
_MIN_CONTRAST = 8.0
# A corner this far from its projection is another one, or hidden.
_MAX_SHIFT_PX = 2.0
# Border of the box that keeps shifted windows inside it: the largest shift, and one for the interpolation.
_BORDER_PX = 4
# Share of corners that have to appear: of those the finder saw, or of the whole board where it saw none.
_MIN_SHARE = 0.4


def guided_corners(
    gray: Image, board: Board, scene: Scene, camera: str, view: str, found: Corners | None
) -> Corners | None:
    """Measure all corners of a board at their projected places.

    Parameters
    ----------
    found
        What the finder saw; None where it saw nothing but another camera knows where the board is.

    Returns
    -------
    Corners or None
        Also corners the finder missed; None where the board cannot be seen in the picture.
    """
    pose = scene.camera_from_base[camera] @ scene.base_from_view[view]
    projected = scene.cameras[camera].project(pose.apply(board.corners_mm))
    # Corners behind the camera or outside the picture by more than it is wide do not bound the box.
    size = np.array(gray.shape[::-1])
    near = (np.abs(projected - size / 2) < 1.5 * size).all(-1)
    if not near.any():
        return None
    low = np.maximum(np.floor(projected[near].min(0)).astype(int) - _MAX_REACH_PX - 5, 0)
    high = np.minimum(np.ceil(projected[near].max(0)).astype(int) + _MAX_REACH_PX + 6, size)
    if (high - low < 8).any():
        return None
    pattern, squares = picture_of(board, scene.cameras[camera], pose, tuple(low), tuple(high))
    box: Box = gray[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    model = _best_blur(box, pattern, squares, board)
    slopes = np.gradient(model, axis=1), np.gradient(model, axis=0)
    places = board.corners_mm[:, :2] / board.square_mm + (0 if board.type == "charuco" else 1)
    fits = {i: _shift(box, model, slopes, squares, projected[i] - low, places[i]) for i in np.flatnonzero(near)}
    good = {i: fit for i, fit in fits.items() if fit is not None}
    limit = max(_UNEXPLAINED_RATIO * float(np.median([u for _, u in good.values()])), _UNEXPLAINED) if good else 0.0
    ids = [i for i, (_, unexplained) in good.items() if unexplained < limit]
    px = [projected[i] + good[i][0] for i in ids]
    if found is not None and len(ids) < _MIN_SHARE * len(found.ids):
        # The print does not look like the pattern (another marker size, inverted): the finder's corners stand.
        return found
    if found is None and len(ids) < _MIN_SHARE * len(places):
        return None
    return Corners(np.array(ids), np.array(px))


def _best_blur(box: Box, pattern: Array, squares: Array, board: Board) -> Array:
    """Pattern blurred as much as explains the brightness of the whole board best."""
    inside = ((squares > 0.5) & (squares < np.array(board.squares) - 0.5)).all(-1)
    levels = box[inside]
    best, best_score = pattern, -np.inf
    for sigma in _BLURS_PX:
        blurred = cv2.GaussianBlur(pattern, (0, 0), sigma)
        values = blurred[inside]
        spread = float(values.std() * levels.std())
        score = float(np.mean((values - values.mean()) * (levels - levels.mean())) / spread) if spread > 0 else -np.inf
        if score > best_score:
            best, best_score = np.asarray(blurred), score
    return best


def _shift(
    box: Box, model: Array, slopes: tuple[Array, Array], squares: Array, at: Array, place: Array
) -> tuple[Array, float] | None:
    """Shift (2,) that lays the model over the picture around one corner, and the share of variance it leaves.

    None where the model does not fit.

    Parameters
    ----------
    at
        The corner's projected pixel in the box.
    place
        The corner on the board, in squares from its outer corner.
    """
    size = np.array(box.shape[::-1])
    first = np.clip(np.rint(at).astype(int) - _MAX_REACH_PX, _BORDER_PX, size)
    last = np.clip(np.rint(at).astype(int) + _MAX_REACH_PX + 1, 0, size - _BORDER_PX)
    if (last <= first).any():
        return None
    window = (slice(first[1], last[1]), slice(first[0], last[0]))
    taken = np.asarray((np.abs(squares[window] - place) < _REACH).all(-1))
    if taken.sum() < _MIN_PIXELS or not (first + 1 < at).all() or not (at < last - 2).all():
        return None
    values = model[window][taken]
    columns = np.stack([np.ones_like(values), values, -slopes[0][window][taken], -slopes[1][window][taken]], -1)
    normal = columns.T @ columns
    if np.linalg.det(normal / np.maximum(np.sqrt(np.multiply.outer(*2 * [normal.diagonal()])), 1e-9)) < _MIN_FIXED:
        return None
    solve = np.linalg.inv(normal) @ columns.T
    shift = np.zeros(2)
    for _ in range(2):
        levels = _shifted(box, window, shift)[taken]
        fit = solve @ levels
        if fit[1] < _MIN_CONTRAST:
            return None
        shift = shift + fit[2:] / fit[1]
        if np.abs(shift).max() > _MAX_SHIFT_PX:
            return None
    unexplained = float(((levels - columns @ fit) ** 2).sum() / max(((levels - levels.mean()) ** 2).sum(), 1e-9))
    return (shift, unexplained) if unexplained < _MAX_UNEXPLAINED else None


def _shifted(box: Box, window: tuple[slice, slice], shift: Array) -> Array:
    """Window of the box displaced by a shift (x, y), bilinear; OpenCV 4's own is in steps of 1/32 pixel."""
    x, y = np.floor(shift).astype(int)
    fx, fy = shift - (x, y)

    def at(dx: int, dy: int) -> Array:
        rows, columns = (slice(w.start + d, w.stop + d) for w, d in zip(window, (y + dy, x + dx), strict=True))
        return np.asarray(box[rows, columns], dtype=np.float64)

    upper = (1 - fx) * at(0, 0) + fx * at(1, 0)
    return np.asarray((1 - fy) * upper + fy * ((1 - fx) * at(0, 1) + fx * at(1, 1)))
