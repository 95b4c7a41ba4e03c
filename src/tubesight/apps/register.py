"""``tubesight register``: the base frame from board views or points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.apps.calibrate import Outcome, board_of, loaders, naming, refuse_folder, write_report
from tubesight.calibration.quality import Verdict, assess, judge
from tubesight.calibration.record import from_mapping
from tubesight.calibration.registration import Registration, register_points, register_views
from tubesight.calibration.scene import rms
from tubesight.calibration.search import Progress
from tubesight.core import InputError
from tubesight.files.dataset import list_pairs, list_pictures
from tubesight.files.registration import load_points, load_registration
from tubesight.files.rig import RigFile, load_rig, save_rig
from tubesight.geometry.pose import Pose

_FILE = "registration.yaml"
# Residuals of a registration, in pixels, up to which it is good or usable; clicked points reach 0.5, corners 0.1.
_GOOD_PX, _USABLE_PX = 1.0, 3.0


def register_folder(
    folder: Path | None,
    rig_path: Path,
    board_path: Path | None,
    out: Path,
    *,
    registration_path: Path | None = None,
    points_path: Path | None = None,
    report: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Outcome:
    """Register a rig from board views in ``folder/<camera>/`` or from a table of points, and write it.

    Parameters
    ----------
    folder
        Pictures of the board at known poses; not needed with points.
    registration_path
        Where the poses are; ``registration.yaml`` in the folder or beside it when None.
    out
        The rig file to write; may be the one that was read.
    report
        Folder for the report; None for none.

    Raises
    ------
    InputError
        If the pictures or points cannot place the cameras, or something cannot be read or written.
    """
    rig_path, out = Path(rig_path), Path(out)
    refuse_folder(out)
    file = load_rig(rig_path)
    with naming(rig_path):
        past = from_mapping(file.calibration, file.rig)
    paths: dict[str, dict[str, Path]] = {}
    if points_path is not None:
        points = load_points(points_path)
        with naming(points_path):
            made = register_points(file.rig, past, points.names, points.xyz_mm, points.px)
    elif folder is None or board_path is None:
        raise InputError("register needs a folder of board pictures with --board, or --points with a table of points")
    else:
        board = board_of(board_path)
        poses, paths = _views(Path(folder), registration_path, file)
        sizes = {name: camera.size_px for name, camera in file.rig.cameras.items()}
        with naming(Path(folder)):
            made = register_views(file.rig, past, loaders(paths, sizes), poses, board, progress)
    outcome = _outcome(made, past is not None, out)
    kept = {k: v for k, v in (file.calibration or {}).items() if k not in ("parameters", "covariance")}
    save_rig(out, made.rig, {**kept, "registration": _record(made, points_path, paths)})
    if report is None:
        return outcome
    written = write_report(Path(report), "Registration", outcome, made.observations, made.residuals_px, paths)
    return replace(outcome, files=(*outcome.files, *written))


def _views(
    folder: Path, registration_path: Path | None, file: RigFile
) -> tuple[dict[str, Pose], dict[str, dict[str, Path]]]:
    """Poses by view, and pictures by camera and view."""
    where = _find_registration(folder, registration_path)
    listed = load_registration(where)
    folder = _picture_folder(folder, file, listed[0][0])
    cameras = [n for n in file.rig.names if (folder / n).is_dir() and list_pictures(folder / n)]
    if not cameras:
        raise InputError(
            f"{folder}: no subfolder with pictures for {', '.join(file.rig.names)}; put the pictures there"
        )
    pairs = dict(list_pairs(folder, cameras))
    poses: dict[str, Pose] = {}
    for image, pose in listed:
        stem = Path(image).stem
        if stem not in pairs:
            places = " and ".join(str(folder / c) for c in cameras)
            raise InputError(f"{where}: views: {image!r} is not in {places}; mend the name or add the picture")
        if stem in poses:
            raise InputError(f"{where}: views: {image!r} is listed twice; remove one")
        poses[stem] = pose
    return poses, {c: {stem: pairs[stem][c] for stem in poses} for c in cameras}


def _find_registration(folder: Path, given: Path | None) -> Path:
    if given is not None:
        return given / _FILE if given.is_dir() else given
    for place in (folder / _FILE, folder.absolute().parent / _FILE):
        if place.is_file():
            return place
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder that holds one subfolder of pictures per camera")
    raise InputError(
        f"{folder}: no {_FILE} here or in the folder above; write one with the board's poses, or name it with "
        "--registration"
    )


def _picture_folder(folder: Path, file: RigFile, image: str) -> Path:
    """Return the folder itself, or its ``registration`` subfolder when the pictures named are there."""
    inner = folder / "registration"
    stem = Path(image).stem

    def has(place: Path) -> bool:
        return any((place / n).is_dir() and stem in list_pictures(place / n) for n in file.rig.names)

    return inner if not has(folder) and inner.is_dir() and has(inner) else folder


def _record(made: Registration, points: Path | None, paths: Mapping[str, Mapping[str, Path]]) -> dict[str, Any]:
    """Summarise a registration for the rig file."""
    record: dict[str, Any] = {"rms_px": round(made.rms_px, 5), "exact": made.exact}
    if points is not None:
        return record | {"points": points.name, "count": int(sum(len(o.px) for o in made.observations))}
    names = {v: path.name for views in paths.values() for v, path in views.items()}
    return record | {"deviation_mm": {names[v]: round(mm, 5) for v, mm in made.deviation_mm.items()}}


def _outcome(made: Registration, joint: bool, out: Path) -> Outcome:
    quality = None if made.adjusted is None else assess(made.rig, made.adjusted)
    verdict = _judge(made) if quality is None else judge(quality, True)
    level = _level(made.rms_px)
    if quality is not None and level != "good" and verdict.level != "poor":
        sentence = f"{level}: the registration fits within {made.rms_px:.2g} px RMS only; {verdict.sentence}"
        verdict = Verdict(level, sentence, verdict.remarks, verdict.next_step)
    errors: dict[tuple[str, str], list[np.ndarray[Any, np.dtype[np.float64]]]] = {}
    for label, residuals in zip(made.labels, made.residuals_px, strict=True):
        errors.setdefault(label, []).append(residuals)
    figures = {
        "rms_px": made.rms_px,
        "exact": made.exact,
        "joint": joint,
        "deviation_mm": dict(made.deviation_mm),
        "centres_mm": {n: made.rig.centre_mm(n) for n in made.rig.names},
    }
    left_out = tuple(f"{x.camera}/{x.view}: {x.reason}" for x in made.left_out)
    view_px = {label: rms(r) for label, r in errors.items()}
    warnings = made.warnings
    if not joint:
        warnings = (
            *warnings,
            "the rig file holds no observations of its calibration: lenses and relative poses stay as they are, "
            "and there is no covariance",
        )
    return Outcome(made.rig, quality, verdict, view_px, left_out, warnings, figures, (out,))


def _level(px: float) -> str:
    return "good" if px <= _GOOD_PX else "usable" if px <= _USABLE_PX else "poor"


def _judge(made: Registration) -> Verdict:
    """Judge a registration of a rig whose calibration is not known."""
    level = _level(made.rms_px)
    sentence = f"{level}: the registration fits within {made.rms_px:.2g} px RMS"
    if level == "poor":
        return Verdict(level, sentence, (), "check the known places and the rig, then register again")
    return Verdict(level, sentence, (), "measure with `tubesight run`")
