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

from tubesight.calibration.bundle import Adjusted, adjust
from tubesight.calibration.corners import Corners
from tubesight.calibration.correlation import inflated
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.find import ambiguity, turns
from tubesight.calibration.guided import guided_corners
from tubesight.calibration.record import Past
from tubesight.calibration.resection import FLAT, extents, resect
from tubesight.calibration.scene import Free, Observation, Scene, rms
from tubesight.calibration.search import LeftOut, Pictures, Progress, gray_of, search
from tubesight.core import Array, Board, Mask
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# Name of the frame of everything that is known: the base frame as a view whose pose is the identity.
BASE_VIEW = "base"
# Known places count as exact while their residuals stay within this many times those of the calibration and this many
# pixels; a stated pose wrong by 0.1 mm shows as 0.3 px at 3 px/mm.
_EXACT_RATIO, _EXACT_PX = 2.0, 0.05
# A stated board pose fixes six numbers, however many corners show it: 2 N residuals that deviate together count as 6.
_POSE_NUMBERS = 6
# A point this many times further off than the others, and this many pixels, is probably another point.
_BAD_RATIO, _BAD_PX = 4.0, 2.0
# Points needed: seen by two cameras, or by one alone.
_MIN_SHARED, _MIN_SINGLE = 4, 6


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A rig in the base frame, with what it was registered from.

    Attributes
    ----------
    observations, residuals_px
        Of the registration, points in the base frame.
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
    sights = []
    for camera, views in looked.corners.items():
        for view, corners in views.items():
            sights.append(
                [_in_base(camera, view, base_from_board, board, Corners(order[corners.ids], corners.px))
                 for order in turns(board)]
            )  # fmt: skip
    placed = _place(rig, sights)
    scene = Scene(rig.cameras, placed, base_from_board)
    labels, observations = [], []
    keys = [(c, v) for c in pictures for v in pictures[c] if c in placed]
    for i, (camera, view) in enumerate(keys):
        found = looked.corners[camera].get(view)
        measured = guided_corners(gray_of(pictures[camera][view]), board, scene, camera, view, found)
        if measured is not None:
            labels.append((camera, view))
            observations.append(_in_base(camera, view, base_from_board, board, measured))
        progress("measuring corners", i + 1, len(keys))
    left_out = [x for x in looked.left_out if (x.camera, x.view) not in labels]
    per_view = {v: [o for o, key in zip(observations, labels, strict=True) if key[1] == v] for v in base_from_board}
    result = _solve(rig, past, placed, observations, np.sqrt(2 * board.corners_mm.shape[0] / _POSE_NUMBERS))
    deviation = {v: _deviation_mm(result.rig, o) for v, o in per_view.items() if o}
    worst = max(deviation, key=lambda v: deviation[v])
    if deviation[worst] > board.square_mm:
        raise CalibrationError(
            f"the stated board poses contradict each other or the pictures: {worst} is {deviation[worst]:.0f} mm off; "
            "check base_from_board (millimetres, board frame: see the file formats) and the pictures' names"
        )
    warnings = [ambiguity(board)] if ambiguity(board) else []
    if not result.exact:
        warnings.append(
            f"the stated board poses are off by up to {deviation[worst]:.2f} mm ({worst}); "
            "they were taken as measured, not as exact"
        )
    return replace(
        result,
        labels=tuple(labels),
        deviation_mm=deviation,
        left_out=tuple(left_out),
        warnings=tuple(warnings),
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
            f"the points name a camera {unknown[0]!r} that the rig does not have; it has {_list(rig.names)}"
        )
    seen: dict[str, Mask] = {c: np.asarray(np.isfinite(p).all(1)) for c, p in px.items()}
    for camera, p in px.items():
        outside = seen[camera] & ~rig.cameras[camera].contains(np.nan_to_num(p), margin_px=-0.5)
        if outside.any():
            name = names[int(np.argmax(outside))]
            raise CalibrationError(f"point {name!r} lies outside the picture of {camera}; mend its pixels")
    for group in _groups(rig):
        _require_points(group, {c: seen[c] for c in group if c in seen}, xyz_mm)
    observations = [Observation(c, BASE_VIEW, xyz_mm[s], px[c][s]) for c, s in seen.items() if s.any()]
    labels = [(o.camera, "points") for o in observations]
    placed = _place(rig, [[o] for o in observations])
    result = _solve(rig, past, placed, observations, 1.0)
    return replace(result, labels=tuple(labels), warnings=tuple(_odd_points(result, names, seen)))


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
            f"at least {_MIN_SHARED} seen by two or {_MIN_SINGLE} seen by one are needed"
        )
    size = extents(xyz_mm[counts > 0])
    if size[1] <= FLAT * size[0]:
        raise CalibrationError("the points lie on a line, about which the base frame could turn; add points beside it")


def _groups(rig: Rig) -> list[tuple[str, ...]]:
    """Cameras whose poses relative to each other are known; each camera without a pose stands alone."""
    known = tuple(n for n in rig.names if n in rig.camera_from_base)
    return [*([known] if known else []), *((n,) for n in rig.names if n not in rig.camera_from_base)]


def _in_base(
    camera: str, view: str, base_from_board: Mapping[str, Pose], board: Board, corners: Corners
) -> Observation:
    return Observation(camera, BASE_VIEW, base_from_board[view].apply(board.corners_mm[corners.ids]), corners.px)


def _place(rig: Rig, sights: Sequence[Sequence[Observation]]) -> dict[str, Pose]:
    """Place every camera in the base frame, keeping relative poses that are known."""
    placed: dict[str, Pose] = {}
    for group in _groups(rig):
        own = [s for s in sights if s[0].camera in group]
        poses = {n: rig.camera_from_base.get(n, Pose.identity()) for n in group}
        cameras = {n: rig.cameras[n] for n in group}
        found = resect(cameras, poses, own) if own else None
        if found is None:
            raise CalibrationError(
                f"{_list(group)}: no picture from which this camera can be placed in the base frame; "
                "add a registration view (or points) that it sees well"
            )
        scene = Scene(cameras, poses, {BASE_VIEW: found[0]})
        solved = adjust(scene, found[1], Free({}, (), (BASE_VIEW,)))
        rig_from_base = solved.scene.base_from_view[BASE_VIEW]
        placed |= {n: poses[n] @ rig_from_base for n in group}
    return {n: placed[n] for n in rig.names}


def _solve(
    rig: Rig, past: Past | None, placed: Mapping[str, Pose], observations: Sequence[Observation], loosen: float
) -> Registration:
    """Refine the placed cameras, with the observations of the calibration where these are known.

    Parameters
    ----------
    loosen
        Factor on the standard deviation of known places that turn out not to be exact.
    """
    if past is None or len(_groups(rig)) > 1:
        again = _place(Rig(rig.cameras, placed), [[o] for o in observations])
        new = Rig(rig.cameras, again)
        return _result(new, observations, None, exact=True)
    views = _place_views(rig, past)
    first = rig.names[0]
    base_from_rig = placed[first].inverse() @ rig.camera_from_base[first]
    scene = Scene(rig.cameras, placed, {v: base_from_rig @ p for v, p in views.items()} | {BASE_VIEW: Pose.identity()})
    free = Free(past.lens, rig.names, tuple(views))
    adjusted = adjust(scene, [*past.observations, *observations], free)
    count = len(past.observations)
    calibration_px, own_px = rms(adjusted.residuals_px[:count]), rms(adjusted.residuals_px[count:])
    exact = own_px <= max(_EXACT_RATIO * calibration_px, _EXACT_PX)
    if not exact:
        loose = _loose(rig, placed, observations, calibration_px, loosen)
        adjusted = adjust(scene, [*past.observations, *loose], free)
    new = Rig(adjusted.scene.cameras, adjusted.scene.camera_from_base, "clamp", inflated(adjusted, dict(past.lens)))
    return _result(new, observations, adjusted, exact)


def _loose(
    rig: Rig, placed: Mapping[str, Pose], observations: Sequence[Observation], calibration_px: float, loosen: float
) -> list[Observation]:
    """Give observations the standard deviation they show against the rig as it was calibrated."""
    scene = Scene(rig.cameras, placed, {BASE_VIEW: Pose.identity()})
    error = rms([scene.project(o) - o.px for o in observations])
    sd = max(1.0, loosen * error / max(calibration_px, 1e-3))
    return [Observation(o.camera, o.view, o.points_mm, o.px, sd) for o in observations]


def _place_views(rig: Rig, past: Past) -> dict[str, Pose]:
    """Poses ``rig_from_board`` of the calibration's views."""
    views: dict[str, list[Observation]] = {}
    for o in past.observations:
        views.setdefault(o.view, []).append(o)
    poses = {}
    for view, own in views.items():
        found = resect(rig.cameras, rig.camera_from_base, [[o] for o in own])
        if found is None:
            raise CalibrationError(f"the rig file's observations of view {view} do not show a board; calibrate again")
        poses[view] = found[0]
    return poses


def _result(rig: Rig, observations: Sequence[Observation], adjusted: Adjusted | None, exact: bool) -> Registration:
    scene = Scene(rig.cameras, rig.camera_from_base, {BASE_VIEW: Pose.identity()})
    residuals = tuple(o.px - scene.project(o) for o in observations)
    return Registration(rig, tuple(observations), residuals, (), adjusted, {}, exact, (), ())


def _deviation_mm(rig: Rig, observations: Sequence[Observation]) -> float:
    """RMS distance between known points of one board and where the pictures alone place them."""
    scene = Scene(rig.cameras, rig.camera_from_base, {BASE_VIEW: Pose.identity()})
    alone = adjust(scene, observations, Free({}, (), (BASE_VIEW,))).scene.base_from_view[BASE_VIEW]
    points = np.concatenate([o.points_mm for o in observations])
    return float(np.sqrt(((alone.apply(points) - points) ** 2).sum(1).mean()))


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
