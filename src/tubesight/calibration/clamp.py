"""The base frame from a straight rod in the clamp: origin where it leaves the clamp, +z along it.

Everything follows from pixels and the rig alone, so the frame can be worked out again with a rig a little off: that is
how the covariance of the calibration is carried over to the registered rig.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.scene import POSE
from tubesight.calibration.straight import Axis, fit_axis
from tubesight.core import Array, Unmeasurable
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig, RigCovariance
from tubesight.vision.rod import RodView, end_contour, leaves_picture, step_ahead

# The clamp is where what lies ahead of the rod's end differs from its surroundings this many times more than at the
# other end, and by this much (relative light); photographs of clamps give 0.1 to 0.8, free ends 0.00 to 0.05.
_CLEARER, _DIFFERS = 2.0, 0.06
# Marks of one place by hand are a few pixels off; rays of marks farther apart belong to different places.
_MARK_PX = 8.0
# A place marked by hand is known to about this much.
_MARK_SD_PX = 1.0
# Share of a deviation by which calibrated parameters are moved: small against the curvature, large against rounding.
_SHARE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """Where the rod leaves its clamp.

    Attributes
    ----------
    axis
        Of the rod.
    origin_mm
        (3,) on the axis, in the frame of the rig.
    heading
        (3,) unit direction of the axis away from the clamp.
    places_mm
        Where each picture puts the origin along the heading, from the mean.
    sd_along_mm
        Standard deviation of the origin along the axis, from the pictures.
    """

    axis: Axis
    origin_mm: Array
    heading: Array
    places_mm: Array
    sd_along_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What the pictures of a rod say of its base: pixels, and nothing that depends on the rig.

    Attributes
    ----------
    views
        By instant; every view starts at the clamp.
    contours
        By instant and view: (K, 2) contour at the clamp, empty where none stands out.
    marks
        By camera: (2,) the base marked by hand; where there are any they place the origin.
    """

    views: tuple[tuple[RodView, ...], ...]
    contours: tuple[tuple[Array, ...], ...]
    marks: Mapping[str, Array]


def from_clamp(
    views: Sequence[Sequence[RodView]], rig: Rig, marks: Mapping[str, Array]
) -> tuple[Seen, tuple[str, ...]]:
    """Turn every view so that it starts at the clamp, and measure the contour there.

    Returns
    -------
    Seen
        For `locate`.
    tuple
        Warnings.

    Raises
    ------
    CalibrationError
        If the base cannot be found.
    """
    axis = fit_axis(views, rig)
    aligned = [tuple(_along(v, axis, rig) for v in own) for own in views]
    flat = [v for own in aligned for v in own]
    warnings: list[str] = []
    if marks:
        mark = float(axis.place(marked_point(marks, rig)))
        ends = [float(np.median([_reach(w, axis, rig) for w in ways])) for ways in
                ([v.reversed() for v in flat], flat)]  # fmt: skip
        forward = abs(mark - ends[0]) <= abs(mark - ends[1])
    else:
        forward = _clamp_first(flat, rig, warnings)
    if not forward:
        aligned = [tuple(v.reversed() for v in own) for own in aligned]
    contours = tuple(tuple(_contour(v.reversed(), rig) for v in own) for own in aligned)
    if not marks and not any(len(c) for own in contours for c in own):
        raise CalibrationError(
            "no picture shows where the rod leaves its clamp; mark the place with --base left:X,Y right:X,Y"
        )
    return Seen(tuple(aligned), contours, marks), tuple(warnings)


def _along(view: RodView, axis: Axis, rig: Rig) -> RodView:
    """Turn a view so that it runs along the direction of the axis."""
    ends = rig.project(view.camera, np.stack([axis.point_mm, axis.point_mm + axis.direction]))
    middle = view.edges_px.mean(1)
    return view if (middle[-1] - middle[0]) @ (ends[1] - ends[0]) >= 0 else view.reversed()


def _reach(view: RodView, axis: Axis, rig: Rig) -> float:
    """Place along the axis of the last scan of a view."""
    middle = rig.cameras[view.camera].unproject(view.edges_px[-1].mean(0)[None])
    return float(_on_rod(middle, view.camera, axis, rig)[0])


def _contour(view: RodView, rig: Rig) -> Array:
    """Contour (K, 2) at the end of a view; empty where the rod leaves the picture or none stands out."""
    if leaves_picture(view, rig.cameras[view.camera]):
        return np.empty((0, 2))
    try:
        return end_contour(view)
    except Unmeasurable:
        return np.empty((0, 2))


def _clamp_first(views: Sequence[RodView], rig: Rig, warnings: list[str]) -> bool:
    """Whether the clamp is where the views start: there something else than the surroundings lies ahead."""
    evidence = []
    for ways in ([v.reversed() for v in views], views):
        contours = [_contour(v, rig) for v in ways]
        evidence.append(
            float(np.mean([step_ahead(v, c) if len(c) else 0.0 for v, c in zip(ways, contours, strict=True)]))
        )
    first, last = evidence
    if max(first, last) > max(_DIFFERS, _CLEARER * min(first, last)):
        return first > last
    warnings.append(
        "both ends of the rod look alike: the upper one was taken for the clamp; name it with --base if it is the other"
    )
    rise = np.mean([v.edges_px[-1].mean(0)[1] - v.edges_px[0].mean(0)[1] for v in views])
    return bool(rise > 0)


def marked_point(marks: Mapping[str, Array], rig: Rig) -> Array:
    """Triangulate a place marked in two or more pictures.

    Raises
    ------
    CalibrationError
        If it is marked in fewer, or the marks belong to different places.
    """
    if len(marks) < 2:
        raise CalibrationError("--base has to mark the base in two cameras, left:X,Y right:X,Y")
    point = rig.triangulate({n: rig.cameras[n].unproject(px)[None] for n, px in marks.items()})[0]
    for name, px in marks.items():
        off = float(np.linalg.norm(rig.project(name, point) - px))
        if not off <= _MARK_PX:
            raise CalibrationError(
                f"the places marked with --base miss each other by {off:.0f} px in {name}; mark one and the same place"
            )
    return np.asarray(point)


def locate(seen: Seen, rig: Rig) -> Base:
    """Fit the axis and place the origin on it.

    The contour at the clamp lies on the rod: each of its rays meets the rod's surface at a place along the axis, and
    the median is the origin.
    """
    views = [[_undistorted(v, rig) for v in own] for own in seen.views]
    axis = fit_axis(views, rig)
    if _runs_backwards(views, axis, rig):
        axis = replace(axis, direction=-axis.direction, side=axis.side * np.array([[1.0], [-1.0]]),
                       covariance=_flipped(axis.covariance))  # fmt: skip
    if seen.marks:
        place = float(axis.place(marked_point(seen.marks, rig)))
        origin = axis.point_mm + place * axis.direction
        return Base(axis, origin, axis.direction, np.zeros(1), _MARK_SD_PX * _mm_per_px(origin, rig))
    places, doubts = [], []
    for own, contours in zip(views, seen.contours, strict=True):
        for view, contour in zip(own, contours, strict=True):
            if len(contour):
                rays = rig.cameras[view.camera].unproject(contour)
                on_rod = _on_rod(rays, view.camera, axis, rig)
                places.append(float(np.nanmedian(on_rod)))
                doubts.append(
                    max(float(np.nanstd(on_rod)), float(view.row_sd_px.mean()) * _mm_per_px(axis.point_mm, rig))
                )
    measured = np.array(places)
    place = float(measured.mean())
    spread = float(measured.std(ddof=1)) if len(measured) > 1 else 0.0
    sd = max(spread, float(np.mean(doubts))) / np.sqrt(len(measured))
    return Base(axis, axis.point_mm + place * axis.direction, axis.direction, measured - place, float(sd))


def _flipped(covariance: Array) -> Array:
    """Covariance for the reversed direction with sides (first, -second): turns change sign with the direction."""
    sign = np.diag([1.0, -1.0, -1.0, 1.0])
    return np.asarray(sign @ covariance @ sign)


def _undistorted(view: RodView, rig: Rig) -> RodView:
    rays = rig.cameras[view.camera].unproject(view.edges_px)
    return replace(view, edge_rays=rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _runs_backwards(views: Sequence[Sequence[RodView]], axis: Axis, rig: Rig) -> bool:
    view = views[0][0]
    return _reach(view, axis, rig) < _reach(view.reversed(), axis, rig)


def _mm_per_px(point_mm: Array, rig: Rig) -> float:
    return float(np.mean([p.apply(point_mm)[2] / rig.cameras[n].focal_px for n, p in rig.camera_from_base.items()]))


def _on_rod(rays: Array, camera: str, axis: Axis, rig: Rig) -> Array:
    """Places (N,) along the axis where camera rays (N, 3) meet the near side of the rod, or come nearest to it."""
    d, direction = rig.directions(camera, rays), axis.direction
    offset = rig.centre_mm(camera) - axis.point_mm
    across, away = d - np.outer(d @ direction, direction), offset - (offset @ direction) * direction
    a, b, c = (across**2).sum(1), across @ away, float(away @ away) - axis.radius_mm**2
    reach = (-b - np.sqrt(np.maximum(b * b - a * c, 0.0))) / a
    return np.asarray((offset + reach[:, None] * d) @ direction)


def frame(base: Base, toward: Array) -> Pose:
    """Pose ``rig_from_base``: origin and +z of the rod, +x towards a direction (3,) of the rig's frame.

    Raises
    ------
    CalibrationError
        If the direction is along the rod.
    """
    x = toward - (toward @ base.heading) * base.heading
    size = float(np.linalg.norm(x))
    # Three degrees: nearer to the axis the azimuth depends on fractions of a millimetre.
    if not size > 0.05 * float(np.linalg.norm(toward)):
        raise CalibrationError("the direction for +x lies along the rod; name another camera or use a tube that bends")
    x /= size
    return Pose(np.stack([x, np.cross(base.heading, x), base.heading], -1), base.origin_mm)


def registered(rig: Rig, seen: Seen, toward: Callable[[Rig, Base], Array], roll_sd_rad: float) -> tuple[Rig, Base]:
    """Move a rig into the base frame of the rod, its covariance too.

    Parameters
    ----------
    toward
        Direction (3,) of +x in the frame of a rig, given where the rod is in it.
    roll_sd_rad
        Deviation of that direction about the rod, from the pictures.
    """
    base = locate(seen, rig)
    rig_from_base = frame(base, toward(rig, base))
    poses = {name: pose @ rig_from_base for name, pose in rig.camera_from_base.items()}
    new = Rig(rig.cameras, poses)
    if rig.covariance is None:
        return new, base

    def placed(moved: Rig) -> dict[str, Pose]:
        there = locate(seen, moved)
        pose = frame(there, toward(moved, there))
        return {name: old @ pose for name, old in moved.camera_from_base.items()}

    return replace(new, covariance=_carried(rig, rig.covariance, new, base, placed, roll_sd_rad)), base


def _carried(
    rig: Rig,
    covariance: RigCovariance,
    new: Rig,
    base: Base,
    placed: Callable[[Rig], Mapping[str, Pose]],
    roll_sd_rad: float,
) -> RigCovariance:
    """Covariance of the registered rig: ``G S G^T`` of the calibration plus that of the frame from the pictures."""
    names = []
    for camera in rig.names:
        names += [n for n in covariance.names if n.rpartition(".")[0] == camera and n.rpartition(".")[2] not in POSE]
        names += [f"{camera}.{p}" for p in POSE]
    row = {name: k for k, name in enumerate(names)}
    by_old = np.zeros((len(names), len(covariance.names)))
    for k, (name, variance) in enumerate(zip(covariance.names, covariance.matrix.diagonal(), strict=True)):
        step = max(_SHARE * float(np.sqrt(variance)), 1e-9)
        poses = placed(rig.perturbed(name, step))
        for camera, pose in poses.items():
            start = row[f"{camera}.rx"]
            by_old[start : start + 6, k] = _motion(new.camera_from_base[camera], pose) / step
        if name in row and name.rpartition(".")[2] not in POSE:
            by_old[row[name], k] = 1.0
    by_frame = np.zeros((len(names), 6))
    for camera, pose in new.camera_from_base.items():
        start = row[f"{camera}.rx"]
        by_frame[start : start + 3, 3:] = pose.rotation
        by_frame[start + 3 : start + 6, :3] = pose.rotation
    own = _frame_covariance(rig, base, new, roll_sd_rad)
    return RigCovariance(tuple(names), by_old @ covariance.matrix @ by_old.T + by_frame @ own @ by_frame.T)


def _motion(before: Pose, after: Pose) -> Array:
    """Rotation vector and shift (6,) in the sense of `RigCovariance` from one pose to another."""
    turn = Pose(after.rotation @ before.rotation.T, np.zeros(3)).rotvec_rad
    return np.concatenate([turn, after.translation_mm - before.translation_mm])


def _frame_covariance(rig: Rig, base: Base, new: Rig, roll_sd_rad: float) -> Array:
    """Covariance (6, 6) of a shift (mm) and a turn (rad) of the base frame in its own axes, from the pictures."""
    name = next(iter(new.camera_from_base))
    rig_from_base = rig.camera_from_base[name].inverse() @ new.camera_from_base[name]
    axis = base.axis
    to_xy = (axis.side @ rig_from_base.rotation[:, :2]).T
    place = float(axis.place(base.origin_mm))
    # Shift of the origin across the axis, then turn about x and y: a turn w moves z by (w_y, -w_x).
    by_axis = np.zeros((6, 4))
    by_axis[:2, :2], by_axis[:2, 2:] = to_xy, place * to_xy
    by_axis[3, 2:], by_axis[4, 2:] = -to_xy[1], to_xy[0]
    covariance = by_axis @ axis.covariance @ by_axis.T
    covariance[2, 2] += base.sd_along_mm**2
    covariance[5, 5] += roll_sd_rad**2
    return np.asarray(covariance)
