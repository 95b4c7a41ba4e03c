"""Corners searched where a first calibration projects them: the corner finder is the largest error of a calibration."""

from __future__ import annotations

import numpy as np

from tubesight.calibration.bundle import Scene
from tubesight.calibration.corners import CROSSING, Corners, contrast, refine, sample_share
from tubesight.calibration.find import window
from tubesight.core import Array, Board, Image

# ChArUco: share of the square the window may reach without touching the markers.
_CHARUCO_SHARE = 0.16
# A refined corner further than this from its projection, in pixels or in half windows, slid to something else.
_MAX_SLIDE_PX, _MAX_SLIDE_WINDOWS = 1.5, 0.5
# A board the finder missed in this camera counts where at least this share of its corners appears.
_MIN_SHARE = 0.5


def guided_corners(gray: Image, board: Board, scene: Scene, camera: str, view: str, found: Corners | None) -> Corners | None:
    """Refine the corners of a board at their projected places.

    On a chessboard every corner starts from its projection, since the finder's own are up to 0.17 px off on oblique
    views. On ChArUco the detector's corners stay and the missing ones are completed with a window that keeps off the
    markers.

    Parameters
    ----------
    found
        What the finder saw; None where it saw nothing but another camera knows where the board is.

    Returns
    -------
    Corners or None
        None where the board cannot be seen in the picture.
    """
    columns, rows = board.inner_corners
    pose = scene.camera_from_base[camera] @ scene.base_from_view[view]
    projected = scene.cameras[camera].project(pose.apply(board.corners_mm)).reshape(rows, columns, 2)
    if not np.isfinite(projected).all():
        return found
    half = window(projected, 2) if board.type == "chessboard" else window(projected, 2, _CHARUCO_SHARE)
    flat, half = projected.reshape(-1, 2), half.ravel()
    refined = refine(gray, flat, half)
    slide = np.linalg.norm(refined - flat, axis=1)
    good = (slide > 0) & (slide < np.minimum(_MAX_SLIDE_PX, np.maximum(_MAX_SLIDE_WINDOWS * half, 1.0)))
    median, answers = contrast(gray, refined.reshape(rows, columns, 2), sample_share(board))
    good &= np.nan_to_num(answers.ravel(), nan=0.0) > CROSSING
    if median <= 0 and board.type == "chessboard" and found is None:
        return None
    if board.type == "charuco" and found is not None:
        refined[found.ids] = found.px
        good[found.ids] = True
    if good.mean() < _MIN_SHARE and found is None:
        return None
    return Corners(np.flatnonzero(good), refined[good]) if good.any() else None


def slide_px(a: Corners, b: Corners) -> Array:
    """Distances between corners both have."""
    _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
    return np.asarray(np.linalg.norm(a.px[i] - b.px[j], axis=1))
