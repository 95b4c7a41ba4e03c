"""First lenses and poses: what the bundle adjustment starts from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from tubesight.calibration.corners import Corners, Ids
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.find import turns
from tubesight.calibration.scene import Scene
from tubesight.core import Array, Board
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose

# Three views fix a lens in theory (Zhang 2000), without any check; the fourth gives one.
MIN_VIEWS = 4
# A view whose RMS exceeds this many times the median of its camera, and this many pixels, was found wrongly.
_BAD_VIEW_RATIO, _BAD_VIEW_PX = 4.0, 1.0
# Proposals closer than this are equal (a single view agrees with each of its own); the board as it was found wins.
_TIE_MM = 1e-6

Found = Mapping[str, Mapping[str, Corners]]
"""Corners by camera and view."""


@dataclass(frozen=True, slots=True, eq=False)
class StartLens:
    """A camera calibrated alone.

    Attributes
    ----------
    camera_from_board
        By view.
    bad_px
        RMS of the views that do not fit, by view.
    """

    camera: Camera
    camera_from_board: Mapping[str, Pose]
    bad_px: Mapping[str, float]


def start_lens(views: Mapping[str, Corners], board: Board, size_px: tuple[int, int]) -> StartLens:
    """Calibrate one camera from its views with OpenCV (Zhang 2000), leaving out views that do not fit.

    The focal lengths are separate and k3 is 0: the choice of parameters comes later, from better corners.

    Raises
    ------
    CalibrationError
        If the views do not fix a lens.
    """
    names = list(views)
    bad: dict[str, float] = {}
    while True:
        points = [board.corners_mm[views[n].ids].astype(np.float32).reshape(-1, 1, 3) for n in names]
        px = [views[n].px.astype(np.float32).reshape(-1, 1, 2) for n in names]
        try:
            _, matrix, distortion, turn, shift, _, _, errors = cv2.calibrateCameraExtended(
                points, px, size_px, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
            )
        except cv2.error as error:
            raise CalibrationError(
                f"the boards in {len(names)} pictures do not fix a lens; add pictures with the board tilted differently"
            ) from error
        view_px = np.ravel(errors)
        worst = int(np.argmax(view_px))
        if len(names) <= MIN_VIEWS or view_px[worst] < max(_BAD_VIEW_RATIO * np.median(view_px), _BAD_VIEW_PX):
            break
        bad[names.pop(worst)] = float(view_px[worst])
    poses = {n: Pose.from_rotvec(r, t) for n, r, t in zip(names, turn, shift, strict=True)}
    coefficients = np.zeros(5)
    coefficients[: min(5, distortion.size)] = distortion.ravel()[:5]
    return StartLens(Camera(np.asarray(matrix), size_px, coefficients), poses, bad)


def start_scene(lenses: Mapping[str, StartLens], found: Found, board: Board) -> tuple[Scene, Found]:
    """Place all cameras and boards in the frame of the first camera.

    Cameras join one by one, the one that shares most views with those placed first. Each shared view proposes a pose
    (several, for a board that looks alike when turned); the proposal that brings the boards of all shared views
    closest together wins, so that a few wrong views do no harm.

    Returns
    -------
    Scene
        Cameras and views with their poses.
    Found
        The corners, renumbered where a camera took the board for a turned one.

    Raises
    ------
    CalibrationError
        If a camera shares no view with the others.
    """
    first = next(iter(lenses))
    placed = {first: Pose.identity()}
    boards = dict(lenses[first].camera_from_board)
    renumbered: dict[str, dict[str, Corners]] = {first: dict(found[first])}
    while len(placed) < len(lenses):
        waiting = [n for n in lenses if n not in placed]
        name = max(waiting, key=lambda n: len(boards.keys() & lenses[n].camera_from_board.keys()))
        poses = lenses[name].camera_from_board
        shared = [v for v in poses if v in boards]
        if not shared:
            raise CalibrationError(
                f"{name}: no picture in which this camera and {' or '.join(placed)} see the board at the same time; "
                "add pictures with the board turned so that both see it"
            )
        placed[name], turned = place_camera({v: boards[v] for v in shared}, {v: poses[v] for v in shared}, board)
        renumbered[name] = {v: _renumber(c, turned.get(v)) for v, c in found[name].items()}
        base_from_camera = placed[name].inverse()
        for view, pose in poses.items():
            boards.setdefault(view, base_from_camera @ pose)
    cameras = {n: lenses[n].camera for n in lenses}
    return Scene(cameras, {n: placed[n] for n in lenses}, boards), {n: renumbered[n] for n in lenses}


def place_camera(
    base_from_board: Mapping[str, Pose], camera_from_board: Mapping[str, Pose], board: Board
) -> tuple[Pose, dict[str, Ids]]:
    """Find ``camera_from_base`` on which most views agree, and the views that have to be renumbered for it.

    Parameters
    ----------
    base_from_board, camera_from_board
        By view, the same views in both.

    Returns
    -------
    Pose
        ``camera_from_base``, of the view that speaks best for all.
    dict
        By view: the order of corners (an entry of `turns`) for the views in which it is not the identity.
    """
    corners = board.corners_mm
    orders = turns(board)
    symmetries = [_symmetry(corners, order) for order in orders]
    views = list(base_from_board)
    seen = np.stack([camera_from_board[v].apply(corners) for v in views])
    best: tuple[float, Pose, Array] | None = None
    for view in views:
        for symmetry in symmetries:
            pose = camera_from_board[view] @ symmetry @ base_from_board[view].inverse()
            distance = np.stack(
                [
                    [np.linalg.norm(pose.apply(base_from_board[v].apply(corners)) - s[order], axis=-1).mean()
                     for order in orders]
                    for v, s in zip(views, seen, strict=True)
                ]
            )  # fmt: skip
            score = float(np.median(distance.min(1)))
            if best is None or score < best[0] - _TIE_MM:
                best = score, pose, distance.argmin(1)
    assert best is not None
    return best[1], {v: orders[i] for v, i in zip(views, best[2], strict=True) if i}


def _symmetry(corners: Array, order: Ids) -> Pose:
    """Rigid turn of the board (in its plane) that takes corner i to where corner ``order[i]`` lies."""
    to, at = corners[order], corners
    x = to[1] - to[0]
    turn = np.arctan2(x[1], x[0])
    pose = Pose.from_rotvec([0, 0, turn], np.zeros(3))
    return Pose(pose.rotation, to[0] - pose.rotate(at[0]))


def _renumber(corners: Corners, order: Ids | None) -> Corners:
    """Give corners the numbers of the other cameras: the one called ``order[i]`` is corner i."""
    if order is None:
        return corners
    ids = np.argsort(order)[corners.ids]
    sequence = np.argsort(ids)
    return Corners(ids[sequence], corners.px[sequence])
