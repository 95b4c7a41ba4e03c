"""Rendered board pictures for the calibration tests.

The renderer warps the board through the full lens model: every sub-pixel's ray is cut with the board's plane, so
corners lie exactly where `Camera.project` puts them. It shares nothing with the pattern that measuring the corners lays
over the picture: the ChArUco texture is OpenCV's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np

from tubesight.calibration.corners import Corners
from tubesight.calibration.find import charuco_board
from tubesight.core import Array, Board, Image
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose, register_rigid
from tubesight.geometry.rig import Rig

CHESSBOARD = Board("chessboard", (10, 7), 13.0)
CHARUCO = Board("charuco", (9, 6), 14.0, 10.0, "DICT_4X4_50")
SIZE = (800, 600)
SAMPLES = 3  # per pixel and axis: with blur, edges are right to a hundredth of a pixel
CELL = 42  # texture pixels per square: whole ones per bit of a 10 mm marker of 6 bits on 14 mm squares


@dataclass(frozen=True, eq=False)
class Eye:
    """A camera with the undistorted ray of every pixel, made once."""

    camera: Camera
    rays: Array = field(init=False)

    def __post_init__(self) -> None:
        width, height = self.camera.size_px
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
        object.__setattr__(self, "rays", self.camera.unproject(pixels)[..., :2].astype(np.float32))


@cache
def eye(fx: float = 640.0, fy: float = 640.0, k: tuple[float, ...] = (-0.1, 0.05, 0.0005, -0.0003, 0.0)) -> Eye:
    """Camera of 800 x 600 pixels, slightly off centre."""
    matrix = [[fx, 0, SIZE[0] / 2 + 6.3], [0, fy, SIZE[1] / 2 - 4.7], [0, 0, 1]]
    return Eye(Camera(np.array(matrix), SIZE, np.array(k)))


@cache
def texture(board: Board) -> Image:
    """Board with a margin of one square, white = 255."""
    if board.type == "charuco":
        size = (board.squares[0] * CELL, board.squares[1] * CELL)
        plain = charuco_board(board).generateImage(size, marginSize=0, borderBits=1)
    else:
        parity = np.add.outer(np.arange(board.squares[1]), np.arange(board.squares[0])) % 2
        plain = np.kron(np.where(parity == 0, 255, 0), np.ones((CELL, CELL))).astype(np.uint8)
    return cv2.copyMakeBorder(plain, CELL, CELL, CELL, CELL, cv2.BORDER_CONSTANT, value=255)


def render(
    seen_by: Eye, board: Board, camera_from_board: Pose, rng: np.random.Generator, noise: float = 2.0, blur: float = 0.6
) -> Image:
    """Gray picture of a board before a dark ground; nothing but ground where the camera looks at its back.

    The outer corner square at the origin is white on chessboards: so the board frame of the file formats.
    """
    width, height = SIZE
    linear = np.full((height, width), 0.12, np.float32)
    if camera_from_board.inverse().translation_mm[2] < 0:
        _paint(linear, seen_by, board, camera_from_board)
    linear = cv2.GaussianBlur(linear, (0, 0), blur)
    levels = 255 * linear ** (1 / 2.2) + rng.normal(0, noise, linear.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _paint(linear: Array, seen_by: Eye, board: Board, camera_from_board: Pose) -> None:
    first = 1.0 if board.type == "chessboard" else 0.0
    columns, rows = board.squares
    u, v = np.meshgrid(np.linspace(-1, columns + 1, 9), np.linspace(-1, rows + 1, 9))
    sheet = np.stack([u - first, v - first, 0 * u], -1).reshape(-1, 3) * board.square_mm
    px = seen_by.camera.project(camera_from_board.apply(sheet))
    low = np.clip(np.floor(np.nanmin(px, 0)).astype(int) - 9, 0, np.array(SIZE) - 2)
    high = np.clip(np.ceil(np.nanmax(px, 0)).astype(int) + 9, low + 2, SIZE)
    rays = seen_by.rays[low[1] : high[1], low[0] : high[0]]
    # The ray map is smooth: linear interpolation between pixel centres is good to 1e-3 of a pixel. (OpenCV's cubic
    # kernel does not even reproduce a straight line.)
    fine = cv2.resize(rays, None, fx=SAMPLES, fy=SAMPLES, interpolation=cv2.INTER_LINEAR)
    pose = camera_from_board
    back = np.linalg.inv(np.column_stack([pose.rotation[:, :2], pose.translation_mm])).astype(np.float32)
    plane = cv2.transform(fine, np.ascontiguousarray(back))
    squares = plane[..., :2] / plane[..., 2:] / np.float32(board.square_mm) + np.float32(first + 1)
    at = squares * CELL - 0.5
    picture = texture(board)
    value = cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_NEAREST, borderValue=1)
    reflected = np.where(value == 1, 0.12, 0.04 + 0.71 / 255 * value).astype(np.float32)
    linear[low[1] : high[1], low[0] : high[0]] = cv2.resize(
        reflected, (rays.shape[1], rays.shape[0]), interpolation=cv2.INTER_AREA
    )


def facing(
    board: Board, centre_mm: Array, viewer_mm: Array, tilt_deg: float, spin_deg: float, rng: np.random.Generator
) -> Pose:
    """Pose of a board at a place, turned to a viewer, then tilted about a random axis and spun in its plane."""
    z = (centre_mm - viewer_mm) / np.linalg.norm(centre_mm - viewer_mm)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    axis = rng.normal(size=3)
    tilt = Pose.from_rotvec(np.radians(tilt_deg) * axis / np.linalg.norm(axis), np.zeros(3))
    spin = Pose.from_rotvec([0, 0, np.radians(spin_deg)], np.zeros(3))
    turned = tilt.rotation @ np.stack([x, np.cross(z, x), z], 1) @ spin.rotation
    return Pose(turned, centre_mm - turned @ board.corners_mm.mean(0))


def looking_at(centre_mm: Array, target_mm: Array, roll_rad: float = 0.0) -> Pose:
    """Pose ``camera_from_base`` of a camera at a place that looks at a target, image y along base +z at zero roll."""
    z = (target_mm - centre_mm) / np.linalg.norm(target_mm - centre_mm)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    rotation = Pose.from_rotvec([0, 0, roll_rad], np.zeros(3)).rotation @ np.stack([x, np.cross(z, x), z])
    return Pose(rotation, -rotation @ centre_mm)


TARGET = np.array([0.0, 0.0, 80.0])


@dataclass(frozen=True, eq=False)
class Stage:
    """Cameras around a working volume and a board shown to them at known poses."""

    rig: Rig
    eyes: dict[str, Eye]
    board: Board
    poses: dict[str, Pose]
    seed: int = 0
    blur: float = 0.6

    def picture(self, camera: str, view: str) -> Image:
        rng = np.random.default_rng([self.seed, list(self.rig.names).index(camera), list(self.poses).index(view)])
        pose = self.rig.camera_from_base[camera] @ self.poses[view]
        return render(self.eyes[camera], self.board, pose, rng, blur=self.blur)

    def pictures(self, views: list[str] | None = None) -> dict[str, dict[str, Callable[[], Image]]]:
        """Loaders by camera and view; each picture is rendered once."""
        made = {c: {v: self.picture(c, v) for v in views or self.poses} for c in self.rig.names}
        return {c: {v: (lambda p=p: p) for v, p in own.items()} for c, own in made.items()}


def stage(
    board: Board,
    angles_deg: list[float],
    eyes: list[Eye],
    views: int,
    seed: int,
    distance_mm: float = 300.0,
    tilt_deg: float = 35.0,
    rolls_rad: tuple[float, ...] = (),
    spread_mm: float = 40.0,
) -> Stage:
    """Cameras on a circle, boards in the middle turned to the middle camera and tilted."""
    rng = np.random.default_rng(seed)
    names = ["left", "right", "top"][: len(angles_deg)]
    rolls = rolls_rad or (0.0,) * len(names)

    def place(angle_deg: float) -> Array:
        angle = np.radians(angle_deg)
        return TARGET + distance_mm * np.array([np.cos(angle), np.sin(angle), 0.05])

    cameras = {n: e.camera for n, e in zip(names, eyes, strict=True)}
    poses = {n: looking_at(place(a), TARGET, r) for n, a, r in zip(names, angles_deg, rolls, strict=True)}
    middle = place(float(np.mean(angles_deg)))
    shown = {
        f"{i:03d}": facing(
            board,
            TARGET + rng.uniform(-spread_mm, spread_mm, 3),
            middle,
            rng.uniform(5, tilt_deg),
            rng.uniform(0, 360),
            rng,
        )
        for i in range(views)
    }
    return Stage(Rig(cameras, poses), dict(zip(names, eyes, strict=True)), board, shown, seed)


def volume_mm(rig: Rig, true: Rig, aligned: bool = False) -> Array:
    """Errors of points of the working volume, projected with the true rig and triangulated with another.

    With `aligned` after the best rigid motion: what is wrong with a rig that is not registered. (Pose numbers trade off
    against principal points and say little.)
    """
    x = np.linspace(-60, 60, 5)
    points = np.stack(np.meshgrid(x, x, np.linspace(0, 160, 7), indexing="ij"), -1).reshape(-1, 3)
    rays = {}
    for name in true.names:
        px = true.project(name, points)
        px[~true.cameras[name].contains(px)] = np.nan
        rays[name] = rig.cameras[name].unproject(px)
    found = rig.triangulate(rays)
    known = np.isfinite(found).all(1)
    assert known.sum() > 50
    found, points = found[known], points[known]
    if aligned:
        found = register_rigid(points, found).apply(found)
    return np.asarray(np.linalg.norm(found - points, axis=1))


def errors_px(corners: Corners, board: Board, seen_by: Eye, pose: Pose) -> Array:
    """Distances of corners from where they truly are."""
    truth = seen_by.camera.project(pose.apply(board.corners_mm))
    return np.asarray(np.linalg.norm(corners.px - truth[corners.ids], axis=1))


def shown(board: Board, tilt_deg: float, spin_deg: float, seed: int = 0) -> tuple[Eye, Pose, Image]:
    """One picture of a board 300 mm before a camera at the origin that looks along +x of the base."""
    rng = np.random.default_rng(seed)
    camera_from_base = looking_at(np.zeros(3), np.array([1.0, 0, 0]))
    base = facing(board, np.array([300.0, 5, -8]), np.zeros(3), tilt_deg, spin_deg, rng)
    pose = camera_from_base @ base
    return eye(), pose, render(eye(), board, pose, rng)
