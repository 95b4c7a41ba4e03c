"""Rendered board pictures for the calibration tests, and what finding corners in them gives.

The renderer warps the board through the full lens model: every sub-pixel's ray is cut with the board's plane, so corners
lie exactly where `Camera.project` puts them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
import pytest

from tubesight.calibration.find import charuco_board, find_corners
from tubesight.core import Array, Board, Image
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose

CHESSBOARD = Board("chessboard", (10, 7), 13.0)
CHARUCO = Board("charuco", (9, 6), 14.0, 10.0, "DICT_4X4_50")
SAMPLES = 4  # per pixel and axis: area coverage in steps of 1/16, finer than 8-bit noise


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera with the undistorted ray of every pixel, made once."""

    camera: Camera
    rays: Array = field(init=False)

    def __post_init__(self) -> None:
        width, height = self.camera.size_px
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
        object.__setattr__(self, "rays", self.camera.unproject(pixels)[..., :2])


def lens(focal=(900.0, 900.0), size=(960, 720), distortion=(-0.1, 0.05, 0.0005, -0.0003, 0.0), centre=(6.3, -4.7)) -> Lens:
    """Camera of 960 x 720 pixels, slightly off centre."""
    matrix = [[focal[0], 0, size[0] / 2 + centre[0]], [0, focal[1], size[1] / 2 + centre[1]], [0, 0, 1]]
    return Lens(Camera(np.array(matrix), size, np.array(distortion)))


@cache
def _texture(board: Board, cell: int) -> Image:
    """Board with a margin of one square, white = 255; `cell` texture pixels per square."""
    if board.type == "charuco":
        size = (board.squares[0] * cell, board.squares[1] * cell)
        plain = charuco_board(board).generateImage(size, marginSize=0, borderBits=1)
    else:
        parity = np.add.outer(np.arange(board.squares[1]), np.arange(board.squares[0])) % 2
        plain = np.kron(np.where(parity == 0, 255, 0), np.ones((cell, cell))).astype(np.uint8)
    return cv2.copyMakeBorder(plain, cell, cell, cell, cell, cv2.BORDER_CONSTANT, value=255)


def render(
    eye: Lens, board: Board, camera_from_board: Pose, rng: np.random.Generator, *, noise=2.0, blur=0.6, gamma=True
) -> Image:
    """Gray picture of a board (white corner squares at x = 0 for a chessboard of even columns and odd rows)."""
    cell = 84  # whole texture pixels per bit of a 10 mm marker of 6 bits on 14 mm squares
    texture = _texture(board, cell)
    # Board frames: see the file formats. The texture's (0, 0) is one square outside the board's outer corner.
    first = 1.0 if board.type == "chessboard" else 0.0
    corners = np.array([[-1, -1], [board.squares[0] + 1, -1], [board.squares[0] + 1, board.squares[1] + 1], [-1, board.squares[1] + 1]])
    edge = np.concatenate([(corners[i] + np.linspace(0, 1, 20)[:, None] * (corners[(i + 1) % 4] - corners[i])) for i in range(4)])
    outline = camera_from_board.apply(np.c_[(edge - first) * board.square_mm, np.zeros(len(edge))])
    px = eye.camera.project(outline)
    width, height = eye.camera.size_px
    linear = np.full((height, width), 0.12)
    low = np.clip(np.floor(np.nanmin(px, 0)).astype(int) - 2, 0, [width - 2, height - 2])
    high = np.clip(np.ceil(np.nanmax(px, 0)).astype(int) + 3, low + 2, [width, height])
    rays = eye.rays[low[1] : high[1], low[0] : high[0]]
    # The ray map is smooth: linear interpolation between pixel centres is good to 1e-3 of a pixel. (OpenCV's cubic
    # kernel does not even reproduce a straight line.)
    n = SAMPLES
    fine = cv2.resize(rays, None, fx=n, fy=n, interpolation=cv2.INTER_LINEAR)
    homography = np.linalg.inv(np.column_stack([camera_from_board.rotation[:, :2], camera_from_board.translation_mm]))
    plane = np.concatenate([fine, np.ones((*fine.shape[:2], 1))], -1) @ homography.T
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = (plane[..., :2] / plane[..., 2:] / board.square_mm + first + 1) * cell
    inside = (plane[..., 2] > 0) & (uv >= 0).all(-1) & (uv[..., 0] < texture.shape[1]) & (uv[..., 1] < texture.shape[0])
    index = np.where(inside[..., None], uv, 0).astype(int)
    value = np.where(inside, 0.04 + 0.71 * (texture[index[..., 1], index[..., 0]] / 255.0), 0.12)
    box = value.reshape(rays.shape[0], n, rays.shape[1], n).mean((1, 3))
    linear[low[1] : high[1], low[0] : high[0]] = box
    linear = cv2.GaussianBlur(linear, (0, 0), blur) if blur else linear
    levels = 255 * (linear ** (1 / 2.2) if gamma else linear) + rng.normal(0, noise, linear.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def looking(target_mm, distance_mm: float, tilt_x_deg: float, tilt_y_deg: float, roll_deg: float, board: Board) -> Pose:
    """Pose ``camera_from_board`` with the board's centre at a point of the camera frame, turned by three angles."""
    rotation = Pose.from_rotvec(np.radians([tilt_x_deg, 0, 0]), np.zeros(3)) @ Pose.from_rotvec(
        np.radians([0, tilt_y_deg, 0]), np.zeros(3)
    )
    rotation = rotation @ Pose.from_rotvec(np.radians([0, 0, roll_deg]), np.zeros(3))
    centre = board.corners_mm.mean(0)
    return Pose(rotation.rotation, np.array([*target_mm, distance_mm]) - rotation.rotate(centre))
