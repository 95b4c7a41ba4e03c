"""Photographs of calibration boards."""

from __future__ import annotations

import cv2
import numpy as np

from tubesight.core import Array, Board, FramePair, Image
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate.backdrop import backdrop, cast_shadow
from tubesight.simulate.rays import Window, coverage, edge_field, plane_points, slopes, windows_around
from tubesight.simulate.render import expose, paint
from tubesight.simulate.scene import Scene, lambert

# Linear reflectance of office paper and of laser print.
_PAPER, _INK = 0.72, 0.035
# White margin around the squares, in squares: as printed boards have.
_MARGIN_SQUARES = 1.3
# Samples across a pixel for the markers of a ChArUco board; only identities are read from them, never positions.
_MARKER_SAMPLES = 3


def _outer(board: Board) -> tuple[float, float]:
    """Board coordinate (both axes) of the outer corner of the first square, and of the first inner corner."""
    return (0.0, board.square_mm) if board.type == "charuco" else (-board.square_mm, 0.0)


def _marker_cells(board: Board) -> Array:
    """White (1) or black (0) cells (rows, columns, n, n) of the markers of every white square; NaN in black squares."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(board.dictionary)))
    cells = dictionary.markerSize + 2
    columns, rows = board.squares
    table = np.full((rows, columns, cells, cells), np.nan)
    number = 0
    for row in range(rows):
        for column in range(columns):
            # OpenCV's board (not the legacy one) starts with a black square; markers count along the rows.
            if (row + column) % 2:
                table[row, column] = cv2.aruco.generateImageMarker(dictionary, number, cells) / 255.0
                number += 1
    return table


def _line_share(value: Array, at: Array | float) -> Array:
    """Share of each pixel beyond the lines ``value = at`` (nearest line given per pixel)."""
    down, across = slopes(value)
    return 1 - coverage(edge_field(value - at, across, down))


def _checker(x: Array, y: Array, board: Board) -> Array:
    """Whiteness (rows, columns) of the squares at board coordinates: exact edges, symmetric about every corner.

    Along each axis a wave of +1 and -1 changes sign at the inner lines, each crossing blurred by the square pixel; the
    product of both waves is the pattern. Around a corner it is odd in each axis, so the corner stays where it is.
    """
    square = board.square_mm
    first = _outer(board)[1]

    def wave(value: Array, lines: int) -> Array:
        nearest = np.clip(np.rint((value - first) / square), 0, lines - 1)
        share = _line_share(value, first + nearest * square)
        return np.asarray((2 * share - 1) * np.where(nearest % 2, -1.0, 1.0))

    columns, rows = board.inner_corners
    product = wave(x, columns) * wave(y, rows)
    # The first square of a chessboard is white, that of a ChArUco board black.
    return np.asarray(0.5 + (0.5 if board.type == "chessboard" else -0.5) * product)


def _markers(x: Array, y: Array, board: Board, paper: Array) -> Array:
    """Multiply the white squares of a ChArUco board by their markers, averaged over each pixel."""
    table = _marker_cells(board)
    rows, columns, cells, _ = table.shape
    square, marker = board.square_mm, float(board.marker_mm or 0.0)
    steps = (np.arange(_MARKER_SAMPLES) + 0.5) / _MARKER_SAMPLES - 0.5
    (x_down, x_across), (y_down, y_across) = slopes(x), slopes(y)
    total = np.zeros(x.shape)
    for down in steps:
        for across in steps:
            u = (x + down * x_down + across * x_across) / square
            v = (y + down * y_down + across * y_across) / square
            column, row = (np.clip(np.floor(a), 0, n - 1).astype(int) for a, n in ((u, columns), (v, rows)))
            margin = (square - marker) / 2
            i, j = (np.floor((a * square - margin) / (marker / cells)).astype(int) for a in (u - column, v - row))
            inside = (i >= 0) & (i < cells) & (j >= 0) & (j < cells)
            value = table[row, column, np.clip(j, 0, cells - 1), np.clip(i, 0, cells - 1)]
            total += np.where(inside & np.isfinite(value), value, 1.0)
    return np.asarray(paper * total / _MARKER_SAMPLES**2)


def _inside(x: Array, y: Array, low: float, size: tuple[float, float]) -> Array:
    """Share of each pixel inside a rectangle of the board."""
    shares = [_line_share(v, low) * (1 - _line_share(v, low + n)) for v, n in ((x, size[0]), (y, size[1]))]
    return np.asarray(shares[0] * shares[1])


def board_outline(board: Board) -> Array:
    """Corners (4, 3) of the printed sheet, board frame, in order around it."""
    margin = _MARGIN_SQUARES * board.square_mm
    low = _outer(board)[0] - margin
    high_x, high_y = (low + n * board.square_mm + 2 * margin for n in board.squares)
    return np.array([[low, low, 0.0], [high_x, low, 0.0], [high_x, high_y, 0.0], [low, high_y, 0.0]])


def _sheet_window(camera: Camera, camera_from_board: Pose, outline: Array) -> Window | None:
    """Window around the sheet: its sides bend under distortion, so points along them count."""
    share = np.linspace(0, 1, 30)[:, None]
    sides = [a + share * (b - a) for a, b in zip(outline, np.roll(outline, -1, 0), strict=True)]
    points = camera_from_board.apply(np.concatenate(sides))
    return windows_around(camera.project(points)[None], 2, camera.size_px)[0]


def render_board(
    camera: Camera, camera_from_base: Pose, board: Board, base_from_board: Pose, scene: Scene, name: str = ""
) -> Image:
    """Photograph a board.

    Parameters
    ----------
    base_from_board
        Pose of the board frame (file formats: z away from the viewer); from behind the sheet is blank.

    Returns
    -------
    Image
        (H, W, 3) BGR.
    """
    levels = backdrop(camera, camera_from_base, scene, None).levels.copy()
    camera_from_board = camera_from_base @ base_from_board
    outline = board_outline(board)
    if scene.shadow:
        middle = base_from_board.apply((outline[[0, 1]] + outline[[3, 2]]) / 2)
        cast_shadow(levels, scene, camera, camera_from_base, middle, float(np.ptp(outline[:, 1])) / 2)
    window = _sheet_window(camera, camera_from_board, outline)
    if window is not None:
        plane = plane_points(camera, window)
        # The plane of the board maps to the image plane by H = (r1, r2, t); its inverse gives board coordinates.
        r, t = camera_from_board.rotation, camera_from_board.translation_mm
        inverse = np.linalg.inv(np.stack([r[:, 0], r[:, 1], t], -1))
        uvw = np.concatenate([plane, np.ones((*plane.shape[:2], 1))], -1) @ inverse.T
        x, y = uvw[..., 0] / uvw[..., 2], uvw[..., 1] / uvw[..., 2]
        low = float(outline[0, 0])
        alpha = _inside(x, y, low, (float(np.ptp(outline[:, 0])), float(np.ptp(outline[:, 1]))))
        facing = r[:, 2] @ t > 0
        white = _printed(x, y, board) if facing else np.ones(x.shape)
        normal = -np.sign(r[:, 2] @ t) * base_from_board.rotation[:, 2]
        albedo = np.array([1.0, 1.0, 1.0])
        lit = lambert(scene, albedo, np.array(normal @ scene.light_direction))
        light = (_INK + (_PAPER - _INK) * white)[..., None] * lit
        paint(levels, camera, scene, window, alpha, light)
    return expose(levels, scene, scene.random("noise", name, *camera.matrix.ravel()))


def _printed(x: Array, y: Array, board: Board) -> Array:
    """Whiteness (rows, columns) of the sheet at board coordinates."""
    white = _checker(x, y, board)
    if board.type == "charuco":
        white = _markers(x, y, board, white)
    size = (board.squares[0] * board.square_mm, board.squares[1] * board.square_mm)
    inside = _inside(x, y, _outer(board)[0], size)
    return np.asarray(1 - inside * (1 - white))


def render_board_pair(
    rig: Rig, board: Board, base_from_board: Pose, scene: Scene | None = None, name: str = ""
) -> FramePair:
    """Photograph a board with every camera of a rig."""
    look = scene or Scene()
    images = {
        camera: render_board(
            rig.cameras[camera], rig.camera_from_base[camera], board, base_from_board, look, f"{name}/{camera}"
        )
        for camera in rig.names
    }
    return FramePair(images, name=name)
