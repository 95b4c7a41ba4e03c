"""Whether a rig is still as it was calibrated, from new pictures of a board, and what changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tubesight.calibration.bundle import Adjusted, adjust
from tubesight.calibration.corners import Corners
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.find import turns
from tubesight.calibration.guided import guided_corners
from tubesight.calibration.quality import PairQuality, assess
from tubesight.calibration.resection import camera_poses, resect
from tubesight.calibration.scene import Free, Observation, Scene, rms
from tubesight.calibration.search import LeftOut, Pictures, Progress, gray_of, search
from tubesight.core import Array, Board
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# A rig is right while boards fit within this many times its calibration's RMS, or this many pixels more: new pictures
# lie elsewhere than those the calibration fitted, and renders and photographs of rigs at rest stay below twice its RMS.
# A camera turned by 0.01 degrees shows as 0.1 to 0.2 px.
_RATIO, _MORE_PX = 2.5, 0.1
# RMS of a careful calibration, for rigs that do not say theirs.
UNKNOWN_RMS_PX = 0.1
# An explanation holds where it brings the RMS down to this many times the limit or less, and one is better than another
# where its RMS, or else the shift it takes, is this much smaller.
_EXPLAINS, _BETTER_RMS, _BETTER_SHIFT = 1.2, 0.8, 0.5
# A board that comes out larger or smaller by this share is another one, or the baseline changed; rigs at rest: 1e-5.
_SCALE = 0.0005


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What one camera would have to have done to explain the pictures, and the RMS then left."""

    camera: str
    turned_deg: float
    shifted_mm: float
    rms_px: float


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """What new pictures of a board say of a rig.

    Attributes
    ----------
    view_px
        By camera and view: RMS of its corners with the board placed by all cameras together.
    alone_px
        By camera: RMS with the board placed by that camera alone (its lens).
    pairs
        Epipolar and board errors by pair of cameras.
    rms_px, limit_px
        Median over the views of their RMS, and up to where the rig is right.
    scale
        Size of the board as triangulated over its stated size; NaN for one camera.
    motions
        What each camera would have to have done; empty while the rig is right.
    refocused
        By camera: RMS left when its focal length alone is free; empty while the rig is right.
    odd
        Views that do not fit although the others do.
    """

    view_px: Mapping[tuple[str, str], float]
    alone_px: Mapping[str, float]
    pairs: tuple[PairQuality, ...]
    rms_px: float
    limit_px: float
    scale: float
    motions: tuple[Motion, ...]
    refocused: Mapping[str, float]
    odd: tuple[str, ...]
    left_out: tuple[LeftOut, ...]

    @property
    def right(self) -> bool:
        """Whether the rig is still right."""
        sized = not abs(self.scale - 1) > _SCALE
        return self.rms_px <= self.limit_px and max(self.alone_px.values()) <= self.limit_px and sized


def drift(
    rig: Rig,
    own_rms_px: float,
    pictures: Pictures,
    board: Board,
    progress: Progress = lambda stage, done, total: None,
) -> Drift:
    """Compare a rig with new pictures of a board.

    Parameters
    ----------
    own_rms_px
        RMS of the rig's calibration.

    Raises
    ------
    CalibrationError
        If a camera sees no board.
    """
    looked = search(pictures, board, progress)
    for camera, own in looked.corners.items():
        if not own:
            raise CalibrationError(f"{camera}: the board is in none of its pictures; show it to every camera")
    measured, alone = _measure(rig, pictures, board, looked.corners, progress)
    scene, observations = _placed(rig, board, measured)
    views = tuple(scene.base_from_view)
    adjusted = adjust(scene, observations, Free({}, (), views))
    view_px = {(o.camera, o.view): rms([r]) for o, r in zip(adjusted.observations, adjusted.residuals_px, strict=True)}
    per_view = {v: max(px for (_, w), px in view_px.items() if w == v) for v in views}
    middle = float(np.median(list(per_view.values())))
    limit = max(_RATIO * own_rms_px, own_rms_px + _MORE_PX)
    scale = _scale(rig, adjusted)
    odd = tuple(v for v, px in per_view.items() if px > 2 * limit) if middle <= limit else ()
    wrong = middle > limit or max(alone.values()) > limit
    motions = tuple(_motion(rig, adjusted, c) for c in rig.names) if wrong and len(rig.names) > 1 else ()
    refocused = {c: adjust(adjusted.scene, observations, Free({c: ("f",)}, (), views)).rms_px for c in rig.names
                 if rig.cameras[c].lens == "brown"} if wrong else {}  # fmt: skip
    pairs = assess(Rig(rig.cameras, rig.camera_from_base, rig.base_frame), adjusted).pairs
    return Drift(view_px, alone, pairs, middle, limit, scale, motions, refocused, odd, looked.left_out)


def _measure(
    rig: Rig, pictures: Pictures, board: Board, found: Mapping[str, Mapping[str, Corners]], progress: Progress
) -> tuple[dict[str, dict[str, Corners]], dict[str, float]]:
    """Measure all corners guided by each camera's own view of the board, and how well these fit its lens."""
    keys = [(c, v) for c, views in found.items() for v in views]
    measured: dict[str, dict[str, Corners]] = {c: {} for c in found}
    errors: dict[str, list[float]] = {c: [] for c in found}
    for done, (camera, view) in enumerate(keys, start=1):
        corners = found[camera][view]
        scene = _alone(rig, camera, view, board, corners)
        if scene is not None:
            guided = guided_corners(gray_of(pictures[camera][view]), board, scene, camera, view, corners)
            corners = guided if guided is not None and len(guided.ids) >= len(corners.ids) / 2 else corners
            o = Observation(camera, view, board.corners_mm[corners.ids], corners.px)
            errors[camera].append(adjust(scene, [o], Free({}, (), (view,))).rms_px)
            measured[camera][view] = corners
        progress("measuring corners", done, len(keys))
    return measured, {c: float(np.median(e)) if e else float("inf") for c, e in errors.items()}


def _alone(rig: Rig, camera: str, view: str, board: Board, corners: Corners) -> Scene | None:
    """Place a board from one picture alone, in the frame of its camera; None where it cannot be."""
    points = board.corners_mm[corners.ids]
    best: Adjusted | None = None
    for pose in camera_poses(rig.cameras[camera], points, corners.px):
        scene = Scene({camera: rig.cameras[camera]}, {camera: Pose.identity()}, {view: pose})
        solved = adjust(scene, [Observation(camera, view, points, corners.px)], Free({}, (), (view,)))
        best = solved if best is None or solved.rms_px < best.rms_px else best
    return None if best is None else best.scene


def _placed(rig: Rig, board: Board, measured: Mapping[str, Mapping[str, Corners]]) -> tuple[Scene, list[Observation]]:
    """Place every board from all cameras that see it."""
    poses: dict[str, Pose] = {}
    observations: list[Observation] = []
    for view in dict.fromkeys(v for views in measured.values() for v in views):
        sights = [
            [
                Observation(camera, view, board.corners_mm[order[views[view].ids]], views[view].px)
                for order in turns(board)
            ]
            for camera, views in measured.items()
            if view in views
        ]
        found = resect(rig.cameras, rig.camera_from_base, sights)
        if found is not None:
            poses[view] = found[0]
            observations += found[1]
    if not poses:
        raise CalibrationError("the boards found cannot be placed; check the board file")
    return Scene(rig.cameras, rig.camera_from_base, poses), observations


def _motion(rig: Rig, adjusted: Adjusted, camera: str) -> Motion:
    """Free the pose of one camera and see where it goes."""
    views = tuple(adjusted.scene.base_from_view)
    solved = adjust(adjusted.scene, adjusted.observations, Free({}, (camera,), views))
    old, new = rig.camera_from_base[camera], solved.scene.camera_from_base[camera]
    turned = Pose(new.rotation @ old.rotation.T, np.zeros(3)).rotvec_rad
    shift = new.inverse().translation_mm - old.inverse().translation_mm
    return Motion(camera, float(np.degrees(np.linalg.norm(turned))), float(np.linalg.norm(shift)), solved.rms_px)


def _scale(rig: Rig, adjusted: Adjusted) -> float:
    """Size of the boards as triangulated over their stated size, median over the views two cameras share."""
    by_view: dict[str, dict[str, Observation]] = {}
    for o in adjusted.observations:
        by_view.setdefault(o.view, {})[o.camera] = o
    ratios = []
    for seen in by_view.values():
        points = np.unique(np.concatenate([o.points_mm for o in seen.values()]), axis=0)
        index = {tuple(p): i for i, p in enumerate(points)}
        rays = {c: np.full((len(points), 3), np.nan) for c in seen}
        for camera, o in seen.items():
            rays[camera][[index[tuple(p)] for p in o.points_mm]] = rig.cameras[camera].unproject(o.px)
        placed: Array = rig.triangulate(rays) if len(seen) > 1 else np.full((len(points), 3), np.nan)
        known = np.isfinite(placed).all(1)
        if known.sum() >= 6:
            ratios.append(_spread(placed[known]) / _spread(points[known]))
    return float(np.median(ratios)) if ratios else float("nan")


def _spread(points: Array) -> float:
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def explain(found: Drift) -> str:
    """Say in a sentence what probably changed; of a rig that is right, an empty one."""
    if found.right:
        return ""
    lenses = [c for c, px in found.alone_px.items() if px > found.limit_px]
    if lenses:
        return (
            f"the pictures of {' and '.join(lenses)} no longer fit its own lens ({found.alone_px[lenses[0]]:.2f} px): "
            "focus, zoom or picture size changed, or the board is not flat or not the one stated"
        )
    epipolar = max((p.epipolar_px for p in found.pairs), default=0.0)
    if epipolar <= found.limit_px and abs(found.scale - 1) > _SCALE:
        return (
            f"all lines fit, but sizes come out {100 * (found.scale - 1):+.2f} %: square_mm is not that of this board, "
            "or the cameras moved apart or together"
        )
    best = min(m.rms_px for m in found.motions) if found.motions else float("inf")
    focus = min(found.refocused, key=lambda c: found.refocused[c]) if found.refocused else ""
    if focus and found.refocused[focus] < min(found.limit_px, best * 1.05):
        return f"the focal length of {focus} changed: focus or zoom were touched"
    if not best <= _EXPLAINS * found.limit_px:
        return "no motion of a single camera explains it: several moved, or the board is not the one stated"
    return _mover([m for m in found.motions if m.rms_px * _BETTER_RMS <= best])


def _mover(candidates: Sequence[Motion]) -> str:
    """Which of the cameras whose motion explains the pictures probably moved.

    Two cameras tell their relative motion alone. A camera that is knocked turns in its mount: about another camera's
    centre it would have had to travel too. So the one that need hardly shift is taken.
    """
    ordered = sorted(candidates, key=lambda m: m.shifted_mm)
    first = ordered[0]
    how = f"turned by {first.turned_deg:.2f} degrees and shifted by {first.shifted_mm:.1f} mm"
    if len(ordered) == 1:
        return f"{first.camera} moved: it is {how}"
    second = ordered[1]
    if first.shifted_mm < _BETTER_SHIFT * second.shifted_mm:
        return (
            f"{first.camera} probably moved: it is {how} (otherwise {second.camera} would have to have shifted by "
            f"{second.shifted_mm:.1f} mm)"
        )
    return f"{first.camera} or {second.camera} moved: one is {how} against the other"
