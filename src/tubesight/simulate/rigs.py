"""Rigs and board poses to simulate with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tubesight.core import Array, Board
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# Focal length over picture width of a common webcam (1115 px at 1920, 81 degrees across).
_FOCAL_PER_WIDTH = 1115 / 1920
# A webcam's lens: k1, k2, p1, p2, k3.
_WEBCAM = (0.058, -0.134, 0.0005, -0.0005, 0.044)
# How far principal points lie from the picture's middle, in widths: a few pixels, as real cameras' do.
_OFF_CENTRE = 0.004
# A board seen more obliquely than this is found rarely and measured badly.
_MOST_OBLIQUE_DEG = 68.0
# Margin between board and border, in widths, and draws before a view is given up.
_BORDER, _DRAWS = 0.015, 400


def camera_pose(azimuth_deg: float, distance_mm: float, target_mm: Sequence[float], elevation_deg: float = 0.0) -> Pose:
    """Return ``camera_from_base`` of a camera that looks at a target with the image's y along base +z.

    Azimuth counts about +z from +x to the side the camera stands on; elevation tilts it up from there, towards -z.
    """
    a, e = np.radians([azimuth_deg, elevation_deg])
    toward = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), -np.sin(e)])
    x = np.array([np.sin(a), -np.cos(a), 0.0])
    rotation = np.stack([x, np.cross(-toward, x), -toward])
    return Pose(rotation, -rotation @ (np.asarray(target_mm, float) + distance_mm * toward))


def rig_around(
    angle_deg: float = 90.0,
    distance_mm: float = 310.0,
    focal_px: float | None = None,
    size_px: tuple[int, int] = (1920, 1080),
    distortion: Sequence[float] = _WEBCAM,
    lens: str = "brown",
    target_mm: Sequence[float] = (0.0, 0.0, 80.0),
    elevation_deg: float = 0.0,
    names: Sequence[str] = ("left", "right"),
) -> Rig:
    """Cameras that look horizontally at the middle of a hanging tube, the image's y along base +z.

    Parameters
    ----------
    angle_deg
        Between one camera and the next, about the z axis; the first stands on +x.
    focal_px
        Of all cameras; that of a webcam for the picture's width when absent.
    elevation_deg
        Lifts the cameras; they look down on the target.
    names
        One for each camera.
    """
    width, height = size_px
    focal = _FOCAL_PER_WIDTH * width if focal_px is None else focal_px
    cameras, poses = {}, {}
    for i, name in enumerate(names):
        # Alternating signs and half a percent of focal length: no two real cameras are alike.
        sign = 1 - 2 * (i % 2)
        f = focal * (1 + 0.005 * sign)
        centre = (width - 1) / 2 + sign * _OFF_CENTRE * width, (height - 1) / 2 - sign * _OFF_CENTRE * width
        matrix = np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]])
        cameras[name] = Camera(matrix, size_px, np.asarray(distortion, float), lens)
        poses[name] = camera_pose(i * angle_deg, distance_mm * (1 - 0.01 * sign), target_mm, elevation_deg)
    return Rig(cameras, poses)


def _facing(direction: Array, roll_rad: float) -> Array:
    """Rotation whose z axis points away from the viewer in `direction`."""
    z = -direction / np.linalg.norm(direction)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    y = np.cross(z, x)
    return np.stack([c * x + s * y, -s * x + c * y, z], -1)


def _visible(rig: Rig, name: str, pose: Pose, corners_mm: Array) -> bool:
    """Whether a camera sees the whole board, from the front and not too obliquely."""
    points = pose.apply(corners_mm)
    sight = points.mean(0) - rig.centre_mm(name)
    if pose.rotation[:, 2] @ sight / np.linalg.norm(sight) < np.cos(np.radians(_MOST_OBLIQUE_DEG)):
        return False
    px = rig.project(name, points)
    return bool(rig.cameras[name].contains(px, _BORDER * rig.cameras[name].size_px[0]).all())


def board_views(rig: Rig, board: Board, count: int, rng: np.random.Generator, spread_mm: float = 55.0) -> list[Pose]:
    """Poses ``base_from_board`` to calibrate with: all over the working volume, tilted and turned every way.

    Every view is seen whole by every camera; where the cameras stand too far apart for that, by as many neighbours as
    possible, in turn.

    Parameters
    ----------
    spread_mm
        How far the board's middle goes from the middle of the working volume.

    Raises
    ------
    ValueError
        If no pose shows the whole board to any camera: it is too large or too near.
    """
    margin = board.square_mm
    inner = board.corners_mm
    low, high = inner.min(0)[:2] - 2 * margin, inner.max(0)[:2] + 2 * margin
    outline = np.array([(x, y, 0.0) for x in (low[0], high[0]) for y in (low[1], high[1])])
    middle = outline.mean(0)
    # The point all cameras look at: nearest to their optical axes.
    axes = np.stack([rig.camera_from_base[n].rotation[2] for n in rig.names])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    centres = np.stack([rig.centre_mm(n) for n in rig.names])
    target = np.linalg.lstsq(across.reshape(-1, 3), np.einsum("nij,nj->ni", across, centres).ravel(), rcond=None)[0]

    poses: list[Pose] = []
    for view in range(count):
        groups = [rig.names] + [(n,) for n in np.roll(rig.names, -view).tolist()]
        pose = next(filter(None, (_draw_view(rig, g, outline, middle, target, spread_mm, rng) for g in groups)), None)
        if pose is None:
            raise ValueError("no pose shows the whole board to a camera; use a smaller board or a larger distance")
        poses.append(pose)
    return poses


def _draw_view(
    rig: Rig,
    names: Sequence[str],
    outline_mm: Array,
    middle_mm: Array,
    target_mm: Array,
    spread_mm: float,
    rng: np.random.Generator,
) -> Pose | None:
    """Draw poses at random until one shows the whole board to all of some cameras."""
    toward = np.mean([rig.centre_mm(n) - target_mm for n in names], axis=0)
    for _ in range(_DRAWS):
        tilt = rng.normal(0, 0.35, 3) * np.linalg.norm(toward)
        # Any roll: some boards look alike after half a turn, so half of all turns is enough.
        rotation = _facing(toward + tilt, rng.uniform(-np.pi / 2, np.pi / 2))
        where = target_mm + rng.uniform(-spread_mm, spread_mm, 3)
        # Rounded as a file holds it, so that the written pose is the drawn one.
        pose = Pose(rotation.round(9), (where - rotation @ middle_mm).round(6))
        if all(_visible(rig, n, pose, outline_mm) for n in names):
            return pose
    return None
