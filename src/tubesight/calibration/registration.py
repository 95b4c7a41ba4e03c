"""The base frame: from views of a board, or from points, whose places in it are known.

Where the rig still has the observations of its calibration, everything is solved again in one adjustment with the
known places as the gauge; else lenses and relative poses stay as they are and the base frame alone is placed. Known
places are taken as exact as long as the pictures agree with them as well as with the calibration; where they do not,
they count as measured, with the deviation they show, so that they place the base frame without bending the lenses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tubesight.calibration.bundle import Adjusted
from tubesight.calibration.corners import Corners
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.find import ambiguity, turns
from tubesight.calibration.guided import guided_corners
from tubesight.calibration.placing import BASE_VIEW, Placed, alone, groups, place, solve
from tubesight.calibration.record import Past
from tubesight.calibration.resection import FLAT, extents
from tubesight.calibration.scene import Observation, Scene, rms
from tubesight.calibration.search import LeftOut, Pictures, Progress, Search, gray_of, search
from tubesight.core import Array, Board, Mask
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# RMS in pixels of boards placed from the pictures alone beyond which the rig is no longer what was calibrated.
_MOVED_RATIO, _MOVED_PX = 4.0, 0.5
# A point this many times further off than the others, and this many pixels, is probably another point.
_BAD_RATIO, _BAD_PX = 4.0, 2.0
# Points needed: seen by two cameras, or by one alone.
_MIN_SHARED, _MIN_SINGLE = 4, 6


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A rig in the base frame, with what it was registered from.

    Attributes
    ----------
    observations, residuals_px, labels
        Of the registration, points in the base frame; labels are camera and view.
    adjusted
        The adjustment of everything; None where the rig had no observations.
    deviation_mm
        By view: RMS distance between the board's corners as stated and as the pictures place them; empty for points.
    exact
        Whether the known places were taken as exact.
    """

    rig: Rig
    observations: tuple[Observation, ...]
    residuals_px: tuple[Array, ...]
    labels: tuple[tuple[str, str], ...]
    adjusted: Adjusted | None
    deviation_mm: Mapping[str, float]
    exact: bool
    left_out: tuple[LeftOut, ...]
    warnings: tuple[str, ...]

    @property
    def rms_px(self) -> float:
        """RMS of the registration's own observations."""
        return rms(self.residuals_px)


def register_views(
    rig: Rig,
    past: Past | None,
    pictures: Pictures,
    base_from_board: Mapping[str, Pose],
    board: Board,
    progress: Progress = lambda stage, done, total: None,
) -> Registration:
    """Register a rig from views of a board at poses known in the base frame.

    Parameters
    ----------
    past
        What the calibration observed; None where that is not known.
    pictures
        By camera and view.
    base_from_board
        By view.

    Raises
    ------
    CalibrationError
        If no picture shows the board, a camera cannot be placed, or the stated poses contradict each other by more
        than a square.
    """
    looked = search(pictures, board, progress)
    placed = place(rig, _readings(looked, base_from_board, board))
    seen = _measured(pictures, looked, Scene(rig.cameras, placed, base_from_board), board, progress)
    left_out = tuple(x for x in looked.left_out if (x.camera, x.view) not in seen)
    solved = solve(rig, past, placed, list(seen.values()), [view for _, view in seen])
    checks = {v: _check_board(solved.rig, own) for v in base_from_board if (own := _of_view(seen, v))}
    deviation = {v: mm for v, (mm, _) in checks.items()}
    worst = max(deviation, key=lambda v: deviation[v])
    if deviation[worst] > board.square_mm:
        raise CalibrationError(
            f"the stated board poses contradict each other or the pictures: {worst} is {deviation[worst]:.0f} mm off; "
            "check base_from_board (millimetres, board frame: see the file formats) and the pictures' names"
        )
    warnings = [ambiguity(board)] if ambiguity(board) else []
    if not solved.exact:
        warnings.append(
            f"the stated board poses are off by up to {deviation[worst]:.2f} mm ({worst}); "
            "they were taken as measured, not as exact"
        )
    warnings += _moved_since(solved, past, {v: px for v, (_, px) in checks.items()})
    return _registration(solved, seen, deviation, left_out, warnings)


def _readings(looked: Search, base_from_board: Mapping[str, Pose], board: Board) -> list[list[Observation]]:
    """Per picture the ways its corners may be numbered, points in the base frame."""
    return [
        [
            _in_base(camera, base_from_board[view], board, Corners(order[corners.ids], corners.px))
            for order in turns(board)
        ]
        for camera, views in looked.corners.items()
        for view, corners in views.items()
    ]


def _measured(
    pictures: Pictures, looked: Search, scene: Scene, board: Board, progress: Progress
) -> dict[tuple[str, str], Observation]:
    """Measure the corners of all pictures where the placed cameras should see them; by camera and view."""
    keys = [(c, v) for c in pictures for v in pictures[c]]
    seen = {}
    for i, (camera, view) in enumerate(keys):
        gray, found = gray_of(pictures[camera][view]), looked.corners[camera].get(view)
        corners = guided_corners(gray, board, scene, camera, view, found)
        if corners is not None:
            seen[camera, view] = _in_base(camera, scene.base_from_view[view], board, corners)
        progress("measuring corners", i + 1, len(keys))
    return seen


def _of_view(seen: Mapping[tuple[str, str], Observation], view: str) -> list[Observation]:
    return [o for (_, own), o in seen.items() if own == view]


def _in_base(camera: str, base_from_board: Pose, board: Board, corners: Corners) -> Observation:
    return Observation(camera, BASE_VIEW, base_from_board.apply(board.corners_mm[corners.ids]), corners.px)


def _registration(
    solved: Placed,
    seen: Mapping[tuple[str, str], Observation],
    deviation_mm: Mapping[str, float],
    left_out: tuple[LeftOut, ...],
    warnings: Sequence[str],
) -> Registration:
    scene = Scene(solved.rig.cameras, solved.rig.camera_from_base, {BASE_VIEW: Pose.identity()})
    return Registration(
        solved.rig,
        tuple(seen.values()),
        tuple(o.px - scene.project(o) for o in seen.values()),
        tuple(seen),
        solved.adjusted,
        deviation_mm,
        solved.exact,
        left_out,
        tuple(warnings),
    )


def register_points(
    rig: Rig, past: Past | None, names: Sequence[str], xyz_mm: Array, px: Mapping[str, Array]
) -> Registration:
    """Register a rig from points known in the base frame.

    Parameters
    ----------
    names, xyz_mm
        N names, and (N, 3) in the base frame.
    px
        By camera: (N, 2), NaN where not seen.

    Raises
    ------
    CalibrationError
        If fewer than four points are seen by two cameras and fewer than six by one, or they lie on a line.
    """
    unknown = [c for c in px if c not in rig.cameras]
    if unknown:
        raise CalibrationError(
            f"the points name a camera {unknown[0]!r}; the rig has {_list(rig.names)}; mend the columns"
        )
    seen: dict[str, Mask] = {c: np.asarray(np.isfinite(p).all(1)) for c, p in px.items()}
    for camera, p in px.items():
        outside = seen[camera] & ~rig.cameras[camera].contains(np.nan_to_num(p), margin_px=-0.5)
        if outside.any():
            name = names[int(np.argmax(outside))]
            raise CalibrationError(f"point {name!r} lies outside the picture of {camera}; mend its pixels")
    for group in groups(rig):
        _require_points(group, {c: seen[c] for c in group if c in seen}, xyz_mm)
    observed = {(c, "points"): Observation(c, BASE_VIEW, xyz_mm[s], px[c][s]) for c, s in seen.items() if s.any()}
    placed = place(rig, [[o] for o in observed.values()])
    solved = solve(rig, past, placed, list(observed.values()), [])
    made = _registration(solved, observed, {}, (), [])
    return replace(made, warnings=tuple(_odd_points(made, names, seen)))


def _list(names: Sequence[str]) -> str:
    return ", ".join(names)


def _require_points(group: Sequence[str], seen: Mapping[str, Mask], xyz_mm: Array) -> None:
    counts = np.sum(list(seen.values()), axis=0) if seen else np.zeros(len(xyz_mm))
    shared = counts >= 2
    enough = shared.sum() >= _MIN_SHARED or any(s.sum() >= _MIN_SINGLE for s in seen.values())
    if not enough:
        raise CalibrationError(
            f"too few points for {_list(group)}: {int(shared.sum())} are seen by two cameras "
            f"and at most {max((int(s.sum()) for s in seen.values()), default=0)} by one; "
            f"add points: at least {_MIN_SHARED} seen by two or {_MIN_SINGLE} seen by one are needed"
        )
    size = extents(xyz_mm[counts > 0])
    if size[1] <= FLAT * size[0]:
        raise CalibrationError("the points lie on a line, about which the base frame could turn; add points beside it")


def _check_board(rig: Rig, observations: Sequence[Observation]) -> tuple[float, float]:
    """RMS length in mm of the motion of one board's points (`alone`), and the RMS in pixels that then remains."""
    motion = alone(Scene(rig.cameras, rig.camera_from_base, {}), observations)
    points = np.concatenate([o.points_mm for o in observations])
    placed = Scene(rig.cameras, rig.camera_from_base, {BASE_VIEW: motion})
    moved_mm = np.linalg.norm(motion.apply(points) - points, axis=1)
    return float(np.sqrt((moved_mm**2).mean())), rms([placed.project(o) - o.px for o in observations])


def _moved_since(solved: Placed, past: Past | None, remaining_px: Mapping[str, float]) -> list[str]:
    """Warn where the cameras disagree on a board by more than when they were calibrated."""
    if past is None or solved.adjusted is None:
        return []
    usual = rms(solved.adjusted.residuals_px[: len(past.observations)])
    return [
        f"{board}: the cameras place the board {off:.1f} px apart; if a camera or its focus moved since the "
        "calibration, calibrate again"
        for board, off in remaining_px.items()
        if off > max(_MOVED_RATIO * usual, _MOVED_PX)
    ]


def _odd_points(result: Registration, names: Sequence[str], seen: Mapping[str, Mask]) -> list[str]:
    """Name points that fit much worse than the others."""
    errors = [np.linalg.norm(r, axis=1) for r in result.residuals_px]
    limit = max(_BAD_RATIO * float(np.median(np.concatenate(errors))), _BAD_PX)
    warnings = []
    for o, e in zip(result.observations, errors, strict=True):
        places = np.flatnonzero(seen[o.camera])
        for i in np.flatnonzero(e > limit):
            warnings.append(f"point {names[places[i]]!r} is {e[i]:.1f} px off in {o.camera}; check it")
    if not result.exact:
        warnings.append("the points were taken as measured, not as exact: they fit less well than the calibration")
    return warnings
