"""Calibration of all cameras from pictures of a board: find, start, adjust, measure again, choose lenses, adjust."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tubesight.calibration.bundle import Adjusted, adjust
from tubesight.calibration.corners import Corners
from tubesight.calibration.correlation import inflated
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.find import ambiguity
from tubesight.calibration.guided import guided_corners
from tubesight.calibration.resection import resect
from tubesight.calibration.scene import Free, Observation, Scene, rms
from tubesight.calibration.search import LeftOut, Pictures, Progress, Search, gray_of, search
from tubesight.calibration.selection import BASE, select_lens
from tubesight.calibration.start import MIN_VIEWS, Found, start_lens, start_scene
from tubesight.core import Board
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# Focal lengths are separate until the data have been asked (see `selection`).
_OPEN = ("fx", "fy", *BASE[1:])
# A picture is left out when its RMS exceeds this many times the median of all and this many pixels: measured corners
# scatter by 0.01 to 0.2 px, a board that moved between the cameras' pictures or bent shows as more.
_BAD_RATIO, _BAD_PX = 4.0, 0.5
# Corners found lie within a pixel of where a first calibration projects them, unless the cameras disagree on the board.
_DISAGREE_PX = 3.0
# Corners of the right board fit a first lens to a pixel or two even on cheap wide-angle cameras, those of another board
# by tens of pixels; relative to the picture's width.
_WRONG_BOARD = 0.01
# Marks a view whose board each camera places for itself.
ALONE = "@"


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A calibrated rig with what it was made from.

    Attributes
    ----------
    rig
        Base frame: the first camera's.
    adjusted
        The bundle adjustment; its views are named by picture, with ``@camera`` where a camera's board stands alone.
    lens
        Free lens parameters by camera.
    left_out
        Pictures not used, or not fully, with the reason.
    warnings
        What the user should know about the board.
    """

    rig: Rig
    board: Board
    adjusted: Adjusted
    lens: Mapping[str, tuple[str, ...]]
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]


def calibrate(pictures: Pictures, board: Board, progress: Progress = lambda stage, done, total: None) -> Calibration:
    """Calibrate lenses and relative poses.

    Parameters
    ----------
    pictures
        By camera and view; views of one name were taken at one instant.
    progress
        Called as the work goes on.

    Raises
    ------
    CalibrationError
        If the pictures do not show the board, too few do, or cameras share no view.
    """
    looked = search(pictures, board, progress)
    left_out = list(looked.left_out)
    scene, found = _start(looked, board, left_out)
    adjusted = _adjust_all(scene, found, board, dict.fromkeys(found, _OPEN))
    found = _measure(pictures, board, adjusted.scene, found, progress)
    left_out = [x for x in left_out if x.view not in found[x.camera]]
    adjusted, found = _without_bad_views(adjusted.scene, found, board, left_out)
    progress("choosing lens parameters", 0, len(found))
    lens = {}
    for i, camera in enumerate(found):
        own = [o for o in adjusted.observations if o.camera == camera]
        lens[camera] = select_lens(adjusted.scene, own)
        progress("choosing lens parameters", i + 1, len(found))
    adjusted = _adjust_all(adjusted.scene, found, board, lens)
    first = next(iter(found))
    rig = Rig(adjusted.scene.cameras, adjusted.scene.camera_from_base, first, inflated(adjusted, lens))
    warning = ambiguity(board)
    return Calibration(rig, board, adjusted, lens, tuple(left_out), (warning,) if warning else ())


def _start(looked: Search, board: Board, left_out: list[LeftOut]) -> tuple[Scene, Found]:
    """Calibrate each camera alone and place all of them."""
    lenses = {}
    for camera, views in looked.corners.items():
        _require_views(camera, len(views))
        start = start_lens(views, board, looked.sizes_px[camera])
        error = rms([start.camera.project(p.apply(board.corners_mm[views[v].ids])) - views[v].px
                     for v, p in start.camera_from_board.items()])  # fmt: skip
        if not error < _WRONG_BOARD * looked.sizes_px[camera][0]:
            raise CalibrationError(
                f"{camera}: the corners found do not fit a board of {board.squares[0]} x {board.squares[1]} squares "
                f"(RMS {error:.1f} px); check `squares`, and for ChArUco that the print is not OpenCV's legacy pattern"
            )
        lenses[camera] = start
        left_out += [LeftOut(camera, v, f"its corners are {px:.1f} px off") for v, px in start.bad_px.items()]
    used = {c: {v: k for v, k in looked.corners[c].items() if v in lenses[c].camera_from_board} for c in lenses}
    return start_scene(lenses, used, board)


def _require_views(camera: str, count: int) -> None:
    if count < MIN_VIEWS:
        raise CalibrationError(
            f"{camera}: the board was found in {count} pictures, {MIN_VIEWS} are needed and 15 recommended; "
            "take more with the board at different places, distances and tilts"
        )


def observations_of(found: Found, board: Board) -> list[Observation]:
    """Observations of a board from its corners, by camera and view."""
    return [
        Observation(camera, view, board.corners_mm[c.ids], c.px)
        for camera, views in found.items()
        for view, c in views.items()
    ]


def _adjust_all(scene: Scene, found: Found, board: Board, lens: Mapping[str, tuple[str, ...]]) -> Adjusted:
    """Bundle adjustment of everything, in the frame of the first camera."""
    used = dict.fromkeys(view for views in found.values() for view in views)
    scene = Scene(scene.cameras, scene.camera_from_base, {v: scene.base_from_view[v] for v in used})
    return adjust(scene, observations_of(found, board), Free(lens, tuple(found)[1:], tuple(used)))


def _measure(pictures: Pictures, board: Board, scene: Scene, found: Found, progress: Progress) -> Found:
    """Measure the corners of all pictures again, guided by a first calibration."""
    keys = [(c, v) for c in found for v in pictures[c] if v in scene.base_from_view]
    result: dict[str, dict[str, Corners]] = {camera: {} for camera in found}
    for i, (camera, view) in enumerate(keys):
        gray, seen = gray_of(pictures[camera][view]), found[camera].get(view)
        corners = guided_corners(gray, board, _guide(scene, board, camera, view, seen), camera, view, seen)
        if corners is not None:
            result[camera][view] = corners
        progress("measuring corners", i + 1, len(keys))
    return result


def _guide(scene: Scene, board: Board, camera: str, view: str, seen: Corners | None) -> Scene:
    """Scene that projects the board to where the finder saw it, even if the other cameras say otherwise."""
    if seen is None:
        return scene
    o = Observation(camera, view, board.corners_mm[seen.ids], seen.px)
    off = np.linalg.norm(scene.project(o) - o.px, axis=1)
    if np.median(off) < _DISAGREE_PX:
        return scene
    return Scene(scene.cameras, scene.camera_from_base, {view: _alone(scene, seen, board, camera)[0]})


def _without_bad_views(
    scene: Scene, found: Found, board: Board, left_out: list[LeftOut]
) -> tuple[Adjusted, dict[str, dict[str, Corners]]]:
    """Adjust, leaving out pictures that do not fit until all do.

    A picture that fits when its board is placed from it alone is good for its lens: the cameras then disagree about
    where the board was, so each of them places the board for itself.
    """
    kept = {camera: dict(views) for camera, views in found.items()}
    while True:
        for camera, views in kept.items():
            _require_views(camera, len(views))
        adjusted = _adjust_all(scene, kept, board, dict.fromkeys(kept, _OPEN))
        errors = {
            (o.camera, o.view): rms([r]) for o, r in zip(adjusted.observations, adjusted.residuals_px, strict=True)
        }
        limit = max(_BAD_RATIO * float(np.median(list(errors.values()))), _BAD_PX)
        camera, view = max(errors, key=lambda key: errors[key])
        if errors[camera, view] <= limit:
            return adjusted, kept
        scene = adjusted.scene
        sharing = [c for c in kept if view in kept[c]]
        alone = {c: _alone(scene, kept[c][view], board, c) for c in sharing}
        if len(sharing) > 1 and max(px for _, px in alone.values()) <= limit:
            views_of = dict(scene.base_from_view)
            for c in sharing:
                kept[c][f"{view}{ALONE}{c}"] = kept[c].pop(view)
                views_of[f"{view}{ALONE}{c}"] = alone[c][0]
                reason = f"used for its lens only: the cameras place the board {errors[c, view]:.1f} px apart; it moved"
                left_out.append(LeftOut(c, view, reason))
            scene = Scene(scene.cameras, scene.camera_from_base, views_of)
        else:
            del kept[camera][view]
            reason = f"its corners are {errors[camera, view]:.2f} px off where others are {limit / _BAD_RATIO:.2f}"
            left_out.append(LeftOut(camera, view.partition(ALONE)[0], reason))


def _alone(scene: Scene, corners: Corners, board: Board, camera: str) -> tuple[Pose, float]:
    """Pose ``base_from_board`` from one picture alone, and the RMS it leaves; infinite where there is no pose."""
    o = Observation(camera, "", board.corners_mm[corners.ids], corners.px)
    found = resect(scene.cameras, scene.camera_from_base, [[o]])
    if found is None:
        return Pose.identity(), float("inf")
    only = Scene(scene.cameras, scene.camera_from_base, {"": found[0]})
    solved = adjust(only, [o], Free({}, (), ("",)))
    return solved.scene.base_from_view[""], solved.rms_px
