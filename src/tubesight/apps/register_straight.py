"""``tubesight register --straight``: the base frame from pictures of a straight rod in the clamp."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.apps.calibrate import Outcome, naming, refuse_folder
from tubesight.calibration.clamp import Base, frame, from_clamp, locate, registered
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.quality import Verdict
from tubesight.calibration.search import Progress
from tubesight.core import Array, FramePair, InputError, Tube, Unmeasurable
from tubesight.files.rig import RigFile, load_rig, save_rig
from tubesight.files.tube import load_tube
from tubesight.geometry.arcs import bending_plane
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods.agreement import triangulate_tip
from tubesight.sensor import ShapeSensor
from tubesight.sources.folder import FolderSource, read_backgrounds
from tubesight.vision.rod import RodView, see_rod

# A rod that turns by 0.2 degrees from end to end misplaces the axis by 0.1; straight rods in photographs seem to turn
# by up to 0.06 degrees (0.09 where they are blurred by 2 px).
_STRAIGHT_RAD, _BENT_RAD = np.radians(0.2), np.radians(0.5)
# Edges that leave more than this from a cylinder belong to something else: rods leave 0.03 to 0.2 px.
_RMS_MAX_PX = 0.6
# Pictures that place the end of the clamp farther apart than this do not see the same end.
_PLACES_MM = 0.5
# A tube whose tip is nearer to the base axis than this share of its length gives no direction, and planes of several
# bent tubes that differ by more than this many degrees contradict each other.
_SIDEWAYS, _PLANES_DEG = 0.1, 1.0
# Deviations up to which a base is good or usable.
_GOOD_MM, _USABLE_MM = 0.1, 0.3


@dataclass(frozen=True, slots=True)
class StraightOptions:
    """What `register_straight` needs to know.

    Attributes
    ----------
    rod
        Pictures of a straight rod in the clamp, a subfolder per camera; ``background/`` in it is used, where there is
        one.
    rig_path, out
        The rig file to read and the one to write; may be the same.
    bent
        Pictures of a tube in the same clamp whose bending plane gives +x; None for a camera.
    toward
        Name of the camera that lies in the half plane of +x; None for the first one.
    tube_path
        What is known of the bent tube.
    base_px
        By camera: the base marked by hand; empty where the pictures show it.
    """

    rod: Path
    rig_path: Path
    out: Path
    bent: Path | None = None
    toward: str | None = None
    tube_path: Path | None = None
    base_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Plus:
    """Where +x is: a direction for a rig and the rod in it, its deviation (rad) from the pictures, and in words."""

    toward: Callable[[Rig, Base], Array]
    sd_rad: float
    words: str


def register_straight(options: StraightOptions, progress: Progress = lambda stage, done, total: None) -> Outcome:
    """Register a rig by a straight rod and write it.

    Raises
    ------
    InputError
        If the pictures do not show a straight rod, do not show where it leaves the clamp, or cannot be read.
    """
    refuse_folder(options.out)
    file = load_rig(options.rig_path)
    rig = file.rig
    _refuse(options, rig)
    marks = {name: np.array(px, float) for name, px in options.base_px.items()}
    views = _see_all(options.rod, rig, marks, progress)
    with naming(options.rod):
        seen, warnings = from_clamp(views, rig, marks)
        base = locate(seen, rig)
        _refuse_bent(base)
    plus = _plus_x(options, rig, base, progress)
    with naming(options.rod):
        new, base = registered(rig, seen, plus.toward, plus.sd_rad)
    outcome = _outcome(options, new, base, plus, (*warnings, *_warnings(base, file)))
    kept = {k: v for k, v in (file.calibration or {}).items() if k not in ("parameters", "covariance")}
    save_rig(options.out, new, {**kept, "registration": {"straight": _record(base, plus)}})
    return outcome


def _refuse(options: StraightOptions, rig: Rig) -> None:
    lacking = [n for n in rig.names if n not in rig.camera_from_base]
    if lacking or len(rig.names) < 2:
        raise InputError(
            f"{options.rig_path}: a rod needs two cameras whose relative pose is known; run `tubesight calibrate` on "
            "pictures both took of one board"
        )
    named = ([options.toward] if options.toward else []) + list(options.base_px)
    for name in named:
        if name not in rig.names:
            raise InputError(f"{options.rig_path}: there is no camera {name!r}; the rig has {', '.join(rig.names)}")


def _see_all(folder: Path, rig: Rig, marks: Mapping[str, Array], progress: Progress) -> list[list[RodView]]:
    source = FolderSource(folder, rig)
    backgrounds = read_backgrounds(folder / "background", rig)
    views: list[list[RodView]] = []
    for index, stem in enumerate(source.stems):
        pair = source.read(index)
        own = []
        for name, image in pair.images.items():
            try:
                own.append(see_rod(name, image, backgrounds.get(name), rig.cameras[name], marks.get(name)))
            except Unmeasurable as failure:
                raise InputError(
                    f"{source.paths[index][name]}: no rod is seen ({failure.detail}); give a plain or a background "
                    f"picture, or mark the base with --base"
                ) from failure
        views.append(own)
        progress("seeing the rod", index + 1, len(source))
        _refuse_odd(folder, stem, own, rig)
    return views


def _refuse_odd(folder: Path, stem: str, own: list[RodView], rig: Rig) -> None:
    """Refuse a pair whose views are not of one cylinder, before it spoils the others."""
    from tubesight.calibration.straight import fit_axis

    with naming(folder):
        axis = fit_axis([own], rig)
        if axis.rms_px > _RMS_MAX_PX:
            raise CalibrationError(
                f"pair {stem} does not show one straight rod (rms {axis.rms_px:.1f} px): it is bent, or something else "
                "was followed; take a plain background, or mark the base with --base"
            )


def _refuse_bent(base: Base) -> None:
    worst = int(np.argmax(base.axis.bend_rad))
    bend = float(base.axis.bend_rad[worst])
    if bend > _BENT_RAD:
        raise CalibrationError(
            f"the rod is not straight: it turns by {np.degrees(bend):.1f} degrees from end to end "
            f"({base.axis.sagitta_mm[worst]:.2f} mm off a straight line); take a straighter one"
        )


def _plus_x(options: StraightOptions, rig: Rig, base: Base, progress: Progress) -> _Plus:
    if options.bent is not None:
        return _from_bent(options, options.bent, rig, base, progress)
    name = options.toward or rig.names[0]
    words = f"the half plane of +x holds camera {name}"

    def toward(moved: Rig, there: Base) -> Array:
        return moved.centre_mm(name) - there.origin_mm

    return _Plus(toward, 0.0, words)


def _from_bent(options: StraightOptions, folder: Path, rig: Rig, base: Base, progress: Progress) -> _Plus:
    """Direction of +x from the plane in which tubes in the clamp bend, signed as the first of them."""
    rig_from_base = frame(base, rig.centre_mm(rig.names[0]) - base.origin_mm)
    placed = Rig(rig.cameras, {n: p @ rig_from_base for n, p in rig.camera_from_base.items()})
    # Nothing is known of the tube: it may be as thick as the rod, or else has to be found without its clamp.
    tubes = [Tube(2 * base.axis.radius_mm, clamped=True), Tube()]
    if options.tube_path is not None:
        tubes = [replace(load_tube(options.tube_path), clamped=True)]
    source = FolderSource(folder, placed)
    backgrounds = read_backgrounds(folder / "background", placed)
    sensors = [ShapeSensor(placed, tube, backgrounds=backgrounds) for tube in tubes]
    found = []
    for index, pair in enumerate(source):
        found.append(_bend_of(sensors, pair, folder))
        progress("seeing the bent tube", index + 1, len(source))
    planes, weights = np.array([f[0] for f in found]), np.array([f[1] for f in found])
    # Planes are directions up to their sign: doubled angles.
    double = float(np.angle(np.sum(weights * np.exp(2j * planes))))
    azimuth = double / 2
    if np.cos(planes[0] - azimuth) < 0:
        azimuth += np.pi
    off = np.degrees(np.abs(np.angle(np.exp(2j * (planes - azimuth)))) / 2)
    if off.max() > _PLANES_DEG:
        raise InputError(
            f"{folder}: the tubes bend in planes {off.max():.1f} degrees apart ({source.stems[int(off.argmax())]}); "
            "leave only pictures of one bending plane there"
        )
    best = int(np.argmax(weights))
    tip_px: dict[str, Array] = found[best][2]
    tip = _tip(tip_px, placed)
    turn = azimuth - float(np.arctan2(tip[1], tip[0]))
    sd = float(np.sqrt(np.mean([f[3] ** 2 for f in found]) / len(found)))
    count = f"{len(found)} pictures" if len(found) > 1 else "a picture"

    def toward(moved: Rig, there: Base) -> Array:
        across = _tip(tip_px, moved) - there.origin_mm
        return np.asarray(Pose.from_rotvec(turn * there.heading, np.zeros(3)).rotate(across))

    return _Plus(toward, sd, f"+x is where the tube in {count} of {folder.name} bends to")


def _tip(tip_px: Mapping[str, Array], rig: Rig) -> Array:
    return np.asarray(rig.triangulate({n: rig.cameras[n].unproject(px)[None] for n, px in tip_px.items()})[0])


def _bend_of(
    sensors: Sequence[ShapeSensor], pair: FramePair, folder: Path
) -> tuple[float, float, dict[str, Array], float]:
    """Azimuth (rad) of the bending plane, weight, tip in the pictures, deviation (rad) of one bent tube."""
    result = next(filter(None, (sensor(pair) for sensor in sensors[:-1])), None) or sensors[-1](pair)
    if result.curve is None or result.shape is None:
        raise InputError(f"{folder}: pair {pair.name}: the bent tube is not measured: {'; '.join(result.notes)}")
    curve = result.curve
    points = curve.at(np.linspace(0, curve.length_mm, 60))
    direction = bending_plane(points, np.ones(len(points)))
    rig = sensors[0].rig
    tip = triangulate_tip(result.views, rig)
    sideways = float(np.hypot(tip[0], tip[1]))
    if sideways < _SIDEWAYS * curve.length_mm:
        raise InputError(
            f"{folder}: pair {pair.name}: the tube hardly bends (its tip is {sideways:.1f} mm beside the rod's axis); "
            "bend it more, or use --x-towards CAMERA"
        )
    sd = float(result.shape.sd.get("orientation", float("nan")))
    # Where the method gives no deviation: a tenth of a millimetre at the tip.
    sd = sd if np.isfinite(sd) else 0.1 / sideways
    tip_px = {name: rig.project(name, tip) for name in result.views}
    return float(np.arctan2(direction[1], direction[0])), sideways**2, tip_px, sd


def _warnings(base: Base, file: RigFile) -> list[str]:
    warnings = []
    bend = float(base.axis.bend_rad.max())
    if bend > _STRAIGHT_RAD:
        warnings.append(
            f"the rod turns by {np.degrees(bend):.2f} degrees from end to end; take several pairs and turn it in the "
            "clamp between them, or take a straighter one"
        )
    if np.ptp(base.places_mm) > _PLACES_MM:
        warnings.append(
            f"the pictures place the end of the clamp {np.ptp(base.places_mm):.1f} mm apart: a rim may hide it in one "
            "of them; mark it with --base"
        )
    if file.rig.covariance is None:
        warnings.append("the rig has no covariance: deviations of results cover the pictures alone")
    return warnings


def _figures(base: Base) -> dict[str, Any]:
    place = float(base.axis.place(base.origin_mm))
    across = base.axis.covariance[:2, :2] + place * (base.axis.covariance[:2, 2:] + base.axis.covariance[2:, :2])
    across = across + place**2 * base.axis.covariance[2:, 2:]
    return {
        "rms_px": round(base.axis.rms_px, 4),
        "rod_diameter_mm": round(2 * base.axis.radius_mm, 4),
        "bend_deg": round(float(np.degrees(base.axis.bend_rad.max())), 4),
        "sagitta_mm": round(float(base.axis.sagitta_mm.max()), 4),
        "origin_sd_mm": round(float(np.sqrt(np.trace(across) + base.sd_along_mm**2)), 4),
        "axis_sd_deg": round(float(np.degrees(np.sqrt(np.trace(base.axis.covariance[2:, 2:])))), 4),
    }


def _record(base: Base, plus: _Plus) -> dict[str, Any]:
    """Summarise the registration for the rig file."""
    return _figures(base) | {"x": plus.words, "x_sd_deg": round(float(np.degrees(plus.sd_rad)), 4)}


def _outcome(options: StraightOptions, rig: Rig, base: Base, plus: _Plus, warnings: tuple[str, ...]) -> Outcome:
    figures = _figures(base) | {
        "places_mm": base.places_mm.round(4),
        "x": plus.words,
        "x_sd_deg": float(np.degrees(plus.sd_rad)),
        "centres_mm": {n: rig.centre_mm(n) for n in rig.names},
    }
    off = figures["origin_sd_mm"]
    level = "good" if off <= _GOOD_MM else "usable" if off <= _USABLE_MM else "poor"
    sentence = (
        f"{level}: the rod ({figures['rod_diameter_mm']:.2f} mm) fits a straight line within {figures['rms_px']:.2f} "
        f"px RMS, bend {figures['bend_deg']:.2f} degrees; the pictures place the base within {off:.2f} mm and its axis "
        f"within {figures['axis_sd_deg']:.2f} degrees; {plus.words}"
    )
    step = "measure with `tubesight run`" if level != "poor" else "take sharper pictures, nearer, and register again"
    return Outcome(rig, None, Verdict(level, sentence, (), step), {}, (), warnings, figures, (options.out,))
