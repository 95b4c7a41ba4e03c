"""Cameras placed in the base frame by what is known in it, alone or together with the calibration's observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tubesight.calibration.bundle import Adjusted, adjust
from tubesight.calibration.correlation import design_effect, inflated
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.record import Past
from tubesight.calibration.resection import resect
from tubesight.calibration.scene import Free, Observation, Prior, Scene, rms
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# The base frame as a view: everything known is given in it. No picture has a slash in its name.
BASE_VIEW = "/base"
# Known places count as exact while their residuals stay within this many times those of the calibration and this many
# pixels; a stated pose wrong by 0.1 mm shows as 0.3 px at 3 px/mm.
_EXACT_RATIO, _EXACT_PX = 2.0, 0.05
# Stated poses that deviate do so by at least this much in each component; keeps a lucky fit from a division by zero.
_LEAST_RAD, _LEAST_MM = 1e-6, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A rig in the base frame.

    Attributes
    ----------
    adjusted
        The adjustment of everything; None where the rig had no observations.
    exact
        Whether the known places were taken as exact.
    """

    rig: Rig
    adjusted: Adjusted | None
    exact: bool


def groups(rig: Rig) -> list[tuple[str, ...]]:
    """Cameras whose poses relative to each other are known; each camera without a pose stands alone."""
    known = tuple(n for n in rig.names if n in rig.camera_from_base)
    return [*([known] if known else []), *((n,) for n in rig.names if n not in rig.camera_from_base)]


def place(rig: Rig, sights: Sequence[Sequence[Observation]]) -> dict[str, Pose]:
    """Place every camera in the base frame, keeping relative poses that are known."""
    placed: dict[str, Pose] = {}
    for group in groups(rig):
        own = [s for s in sights if s[0].camera in group]
        poses = {n: rig.camera_from_base.get(n, Pose.identity()) for n in group}
        cameras = {n: rig.cameras[n] for n in group}
        found = resect(cameras, poses, own) if own else None
        if found is None:
            raise CalibrationError(
                f"{', '.join(group)}: no picture from which this camera can be placed in the base frame; "
                "add a registration view (or points) that it sees well"
            )
        scene = Scene(cameras, poses, {BASE_VIEW: found[0]})
        solved = adjust(scene, found[1], Free({}, (), (BASE_VIEW,)))
        rig_from_base = solved.scene.base_from_view[BASE_VIEW]
        placed |= {n: poses[n] @ rig_from_base for n in group}
    return {n: placed[n] for n in rig.names}


def solve(
    rig: Rig,
    past: Past | None,
    placed: Mapping[str, Pose],
    observations: Sequence[Observation],
    boards: Sequence[str],
) -> Placed:
    """Refine the placed cameras, with the observations of the calibration where these are known.

    Parameters
    ----------
    boards
        The board each observation shows; empty where points were observed.
    """
    if past is None or len(groups(rig)) > 1:
        again = place(Rig(rig.cameras, placed), [[o] for o in observations])
        return Placed(Rig(rig.cameras, again), None, exact=True)
    first = rig.names[0]
    base_from_rig = placed[first].inverse() @ rig.camera_from_base[first]
    views = {v: base_from_rig @ p for v, p in _place_views(rig, past).items()}
    scene = Scene(rig.cameras, placed, views | {BASE_VIEW: Pose.identity()})
    adjusted = adjust(scene, [*past.observations, *observations], Free(past.lens, rig.names, tuple(views)))
    count = len(past.observations)
    calibration_px, own_px = rms(adjusted.residuals_px[:count]), rms(adjusted.residuals_px[count:])
    exact = own_px <= max(_EXACT_RATIO * calibration_px, _EXACT_PX) or len(set(boards)) == 1
    if not exact and boards:
        adjusted = _with_loose_boards(scene, past, observations, boards, adjusted)
    elif not exact:
        loose = _loose(rig, placed, observations, calibration_px)
        adjusted = adjust(scene, [*past.observations, *loose], adjusted.free)
    new = Rig(adjusted.scene.cameras, adjusted.scene.camera_from_base, "clamp", inflated(adjusted, dict(past.lens)))
    return Placed(new, adjusted, exact)


def _with_loose_boards(
    scene: Scene, past: Past, observations: Sequence[Observation], boards: Sequence[str], strict: Adjusted
) -> Adjusted:
    """Adjust with stated board poses that may be off, by as much as they contradict each other."""
    names = list(dict.fromkeys(boards))
    groups = {b: [o for o, own in zip(observations, boards, strict=True) if own == b] for b in names}
    turns, shifts, pivots = [], [], {}
    for board, own in groups.items():
        off = alone(scene, own)
        pivots[board] = np.concatenate([o.points_mm for o in own]).mean(0)
        turns.append(off.rotvec_rad)
        shifts.append(off.apply(pivots[board]) - pivots[board])
    # Three components each; the base frame itself has taken one board's worth.
    count = 3 * (len(names) - 1)
    sd_rad = max(float(np.sqrt(np.square(turns).sum() / count)), _LEAST_RAD)
    sd_mm = max(float(np.sqrt(np.square(shifts).sum() / count)), _LEAST_MM)
    names_of = [f"{BASE_VIEW} {b}" for b in boards]
    loose = [Observation(o.camera, v, o.points_mm, o.px) for o, v in zip(observations, names_of, strict=True)]
    views = {v: p for v, p in scene.base_from_view.items() if v != BASE_VIEW} | dict.fromkeys(names_of, Pose.identity())
    start = Scene(scene.cameras, scene.camera_from_base, views)
    adjusted = strict
    # Priors are in units of a corner's deviation (as real boards have it: the covariance is scaled by the design effect
    # too), which the strict solution overestimates: the second round corrects it.
    for _ in range(2):
        sigma = adjusted.sigma_px * np.sqrt(design_effect(adjusted, dict(past.lens)))
        priors = [Prior(f"{BASE_VIEW} {b}", pivots[b], sd_rad / sigma, sd_mm / sigma) for b in names]
        free = Free(past.lens, tuple(scene.cameras), tuple(views))
        adjusted = adjust(start, [*past.observations, *loose], free, priors=priors)
    return adjusted


def _loose(
    rig: Rig, placed: Mapping[str, Pose], observations: Sequence[Observation], calibration_px: float
) -> list[Observation]:
    """Give points the standard deviation they show against the rig as it was calibrated."""
    scene = Scene(rig.cameras, placed, {BASE_VIEW: Pose.identity()})
    error = rms([scene.project(o) - o.px for o in observations])
    # The base frame's pose took six of the residuals.
    count = 2 * sum(len(o.px) for o in observations)
    sd = error * np.sqrt(count / max(count - 6, 1)) / max(calibration_px, 1e-3)
    return [Observation(o.camera, o.view, o.points_mm, o.px, max(1.0, sd)) for o in observations]


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


def alone(scene: Scene, observations: Sequence[Observation]) -> Pose:
    """Motion of known points of one board from where they are stated to where the pictures alone place them."""
    only = Scene(scene.cameras, scene.camera_from_base, {BASE_VIEW: Pose.identity()})
    return adjust(only, observations, Free({}, (), (BASE_VIEW,))).scene.base_from_view[BASE_VIEW]
