"""A calibrated and registered rig, from rendered pictures of boards: what a user's session gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Self

import numpy as np

from tubesight.apps.reproduce.mockup import through_jpeg
from tubesight.calibration.calibrate import calibrate
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.record import Past
from tubesight.calibration.registration import register_points, register_views
from tubesight.core import Array, Board, FramePair, Image
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import Scene, board_views, render_board_pair, rig_around

# A fixture that fills the tube's room, and how well a person clicks on its marks in an enlarged picture.
_FIXTURE_MM = ((-60.0, -60.0, 0.0), (60.0, 60.0, 160.0))
_CLICK_PX = 0.5

Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class PlainCamera:
    """A camera as plain data, see `tubesight.geometry.camera.Camera`."""

    name: str
    size_px: tuple[int, int]
    lens: str
    distortion: tuple[float, ...]
    matrix: Rows
    camera_from_base: Rows


@dataclass(frozen=True, slots=True)
class PlainRig:
    """A registered rig as plain data, to be part of a task."""

    cameras: tuple[PlainCamera, ...]

    @classmethod
    def of(cls, rig: Rig) -> Self:
        """Write down a rig."""
        return cls(
            tuple(
                PlainCamera(
                    name,
                    camera.size_px,
                    camera.lens,
                    tuple(camera.distortion.tolist()),
                    _rows(camera.matrix.tolist()),
                    _rows(rig.camera_from_base[name].matrix.tolist()),
                )
                for name, camera in rig.cameras.items()
            )
        )

    @classmethod
    def from_plain(cls, cameras: list[dict[str, Any]]) -> Self:
        """Read what JSON made of one."""
        return cls(
            tuple(
                PlainCamera(
                    c["name"],
                    (c["size_px"][0], c["size_px"][1]),
                    c["lens"],
                    tuple(c["distortion"]),
                    _rows(c["matrix"]),
                    _rows(c["camera_from_base"]),
                )
                for c in cameras
            )
        )

    def rig(self) -> Rig:
        """Make the rig."""
        cameras = {c.name: Camera(np.array(c.matrix), c.size_px, np.array(c.distortion), c.lens) for c in self.cameras}
        return Rig(cameras, {c.name: Pose.from_matrix(c.camera_from_base) for c in self.cameras})


def _rows(matrix: list[list[float]]) -> Rows:
    return tuple(tuple(row) for row in matrix)


@dataclass(frozen=True, slots=True)
class Session:
    """What is photographed to calibrate and register; the task of `calibrated`.

    Attributes
    ----------
    views, registration_views
        Pairs of pictures of the board anywhere, and at poses known in the base frame.
    squares, square_mm
        Of the chessboard.
    points
        Where not zero, the base frame comes from so many clicked points instead of views of the board.
    spread_mm
        How far the board's middle goes from the middle of the working volume.
    blur_px, noise_levels
        Of the pictures.
    size_px
        Of the cameras.
    seed
        Of the board's poses and the pictures' noise.
    """

    seed: int
    views: int = 20
    registration_views: int = 2
    squares: tuple[int, int] = (10, 7)
    square_mm: float = 13.0
    points: int = 0
    spread_mm: float = 55.0
    blur_px: float = 0.6
    noise_levels: float = 1.5
    size_px: tuple[int, int] = (1920, 1080)


def calibrated(session: Session) -> dict[str, Any]:
    """Photograph boards with the true rig, calibrate and register.

    Returns
    -------
    dict
        ``cameras`` of a `PlainRig`, ``rms_px`` of the adjustment; with a calibration that is refused ``cameras`` is
        empty and ``refused`` says why.
    """
    rig, board = rig_around(size_px=session.size_px), board_of(session)
    scene = Scene(blur_px=session.blur_px, noise_levels=session.noise_levels, seed=session.seed)
    poses = poses_of(session, rig)
    pairs = [through_jpeg(render_board_pair(rig, board, pose, scene, f"{i:03d}")) for i, pose in enumerate(poses)]
    try:
        made = calibrate(_pictures(pairs[: session.views]), board)
        past = Past(made.board, made.adjusted.observations, made.lens)
        if session.points:
            names, xyz_mm, px = _clicked(session, rig)
            base = register_points(made.rig, past, names, xyz_mm, px)
        else:
            known = {f"{i:03d}": pose for i, pose in enumerate(poses) if i >= session.views}
            base = register_views(made.rig, past, _pictures(pairs[session.views :]), known, board)
    except CalibrationError as error:
        return {"cameras": [], "rms_px": float("nan"), "refused": str(error)}
    return {"cameras": asdict(PlainRig.of(base.rig))["cameras"], "rms_px": made.adjusted.rms_px, "refused": ""}


def _clicked(session: Session, rig: Rig) -> tuple[list[str], Array, dict[str, Array]]:
    """Names, places (N, 3) and pixels by camera of points clicked on a fixture around the tube."""
    rng = np.random.default_rng(session.seed)
    xyz_mm = rng.uniform(*_FIXTURE_MM, (session.points, 3))
    px = {name: rig.project(name, xyz_mm) + rng.normal(0, _CLICK_PX, (session.points, 2)) for name in rig.names}
    return [f"p{i}" for i in range(session.points)], xyz_mm, px


def board_of(session: Session) -> Board:
    """Chessboard of a session."""
    return Board("chessboard", session.squares, session.square_mm)


def poses_of(session: Session, rig: Rig) -> list[Pose]:
    """Poses ``base_from_board`` of a session: those to calibrate with, then those to register with."""
    rng = np.random.default_rng(session.seed)
    return board_views(rig, board_of(session), session.views + session.registration_views, rng, session.spread_mm)


def _pictures(pairs: Sequence[FramePair]) -> dict[str, dict[str, Callable[[], Image]]]:
    """Loaders by camera and view, as calibration wants them."""
    return {
        camera: {pair.name: partial(dict.__getitem__, dict(pair.images), camera) for pair in pairs}
        for camera in pairs[0].images
    }
