"""``tubesight calibrate``: lenses and relative poses from pictures of a board."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from tubesight.calibration.calibrate import ALONE, Calibration, calibrate
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.find import check_board
from tubesight.calibration.quality import Quality, Verdict, assess, judge
from tubesight.calibration.record import to_mapping
from tubesight.calibration.report import Label, coverage_picture, page
from tubesight.calibration.scene import Observation, rms
from tubesight.calibration.search import Progress
from tubesight.core import Array, Board, Image, InputError
from tubesight.files.board import load_board
from tubesight.files.dataset import camera_folders, list_pairs
from tubesight.files.images import read_image
from tubesight.files.rig import save_rig
from tubesight.files.safe import refuse, write_atomic
from tubesight.geometry.lens import LENSES
from tubesight.geometry.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What `calibrate` and `register` made and think of it.

    Attributes
    ----------
    quality
        None where the rig had no observations to judge it by.
    view_px
        RMS by camera and picture: of the calibration, or of the registration's own pictures.
    left_out, warnings
        Lines for the user.
    registration
        Figures of the registration; empty for a calibration.
    files
        What was written.
    """

    rig: Rig
    quality: Quality | None
    verdict: Verdict
    view_px: Mapping[Label, float]
    left_out: tuple[str, ...]
    warnings: tuple[str, ...]
    registration: Mapping[str, Any]
    files: tuple[Path, ...]

    def as_dict(self) -> dict[str, Any]:
        """Plain data for ``--json``; lenses and poses are in the rig file."""
        cameras: dict[str, dict[str, Any]] = {}
        for name, camera in self.rig.cameras.items():
            m = camera.matrix
            cameras[name] = {
                "fx": m[0, 0],
                "fy": m[1, 1],
                "cx": m[0, 2],
                "cy": m[1, 2],
                "distortion": camera.distortion,
            }
            if self.quality is not None:
                q = self.quality.cameras[name]
                cameras[name] |= {"views": q.views, "rms_px": q.rms_px, "coverage": q.covered, "sd": q.sd}
        views: dict[str, dict[str, float]] = {}
        for (camera_name, view), px in self.view_px.items():
            views.setdefault(camera_name, {})[view] = px
        return {
            "rms_px": None if self.quality is None else self.quality.rms_px,
            "point_sd_mm": None if self.quality is None else self.quality.point_sd_mm,
            "cameras": cameras,
            "pairs": [] if self.quality is None else [asdict(pair) for pair in self.quality.pairs],
            "views": views,
            "left_out": self.left_out,
            "warnings": self.warnings,
            "registration": self.registration,
            "verdict": asdict(self.verdict),
            "files": self.files,
        }


def calibrate_folder(
    folder: Path,
    board_path: Path,
    out: Path,
    report: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Outcome:
    """Calibrate from ``folder/<camera>/`` and write the rig file.

    Parameters
    ----------
    out
        The rig file.
    report
        Folder for ``report.html`` and the coverage pictures; None for no report.

    Raises
    ------
    InputError
        If the pictures cannot give a calibration, or something cannot be read or written.
    """
    folder, out = Path(folder), Path(out)
    board = board_of(board_path)
    refuse_folder(out)
    cameras = camera_folders(folder)
    if not cameras:
        raise InputError(f"{folder}: no subfolder with pictures; put the pictures of each camera into its own")
    pairs = list_pairs(folder, cameras)
    paths = {c: {stem: files[c] for stem, files in pairs} for c in cameras}
    with naming(folder):
        made = calibrate(loaders(paths), board, progress)
    quality = assess(made.rig, made.adjusted)
    outcome = _outcome(made, quality, out)
    names = {c: {v: path.name for v, path in views.items()} for c, views in paths.items()}
    hashes = {f"{c}/{p.name}": f"sha256:{_hash(p)}" for c, views in paths.items() for p in views.values()}
    record = to_mapping(made, names, hashes, datetime.now(UTC).date().isoformat())
    save_rig(out, made.rig, record)
    if report is None:
        return outcome
    written = write_report(
        Path(report), "Calibration", outcome, made.adjusted.observations, made.adjusted.residuals_px, paths
    )
    return replace(outcome, files=(*outcome.files, *written))


def board_of(path: Path) -> Board:
    """Read a board file and check that such a board can be searched."""
    board = load_board(Path(path))
    try:
        check_board(board)
    except ValueError as error:
        refuse(Path(path), error)
    return board


def refuse_folder(out: Path) -> None:
    """Refuse, before the work, to write a file where a folder is."""
    if out.is_dir():
        raise InputError(f"{out}: this is a folder; name the rig file to write, for example {out / 'rig.yaml'}")


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Put a path before what calibration says, which knows pictures but no paths."""
    try:
        yield
    except CalibrationError as error:
        raise InputError(f"{path}: {error}") from error


def loaders(
    paths: Mapping[str, Mapping[str, Path]], sizes_px: Mapping[str, tuple[int, int]] | None = None
) -> dict[str, dict[str, Callable[[], Image]]]:
    """Functions that load pictures by camera and view, of the camera's size where that is given."""
    sizes = sizes_px or {}
    return {c: {v: partial(read_image, path, sizes.get(c)) for v, path in views.items()} for c, views in paths.items()}


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _outcome(made: Calibration, quality: Quality, out: Path) -> Outcome:
    pairs = zip(made.adjusted.observations, made.adjusted.residuals_px, strict=True)
    view_px = {(o.camera, o.view.partition(ALONE)[0]): rms([r]) for o, r in pairs}
    left_out = tuple(f"{x.camera}/{x.view}: {x.reason}" for x in made.left_out)
    return Outcome(made.rig, quality, judge(quality, False), view_px, left_out, made.warnings, {}, (out,))


def camera_rows(outcome: Outcome) -> list[list[str]]:
    """Table of the cameras: heading, then a row each."""
    rows = [["camera", "views", "RMS [px]", "fx, fy [px]", "cx, cy [px]", "cover"]]
    for name, camera in outcome.rig.cameras.items():
        m = camera.matrix
        figures = ["-", "-"]
        cover = "-"
        if outcome.quality is not None:
            q = outcome.quality.cameras[name]
            figures, cover = [str(q.views), f"{q.rms_px:.3f}"], f"{100 * q.covered:.0f} %"
        rows.append([name, *figures, f"{m[0, 0]:.2f}, {m[1, 1]:.2f}", f"{m[0, 2]:.2f}, {m[1, 2]:.2f}", cover])
    return rows


def lens_rows(outcome: Outcome) -> list[list[str]]:
    """Table of the lenses: heading, then a row per parameter with its standard deviation where that is known."""
    rows = [["camera", "parameter", "value", "standard deviation"]]
    for name, camera in outcome.rig.cameras.items():
        m = camera.matrix
        values = {"fx": m[0, 0], "fy": m[1, 1], "cx": m[0, 2], "cy": m[1, 2], "skew": m[0, 1]}
        values |= dict(zip(LENSES[camera.lens].coefficients, camera.distortion, strict=True))
        sd = dict(outcome.quality.cameras[name].sd) if outcome.quality else {}
        sd |= {"fx": sd["f"], "fy": sd["f"]} if "f" in sd else {}
        rows += [[name, p, f"{v:.6g}", f"{sd[p]:.2g}" if p in sd else "-"] for p, v in values.items()]
    return rows


def coverage_lines(outcome: Outcome) -> list[str]:
    """Where the corners of each camera lie, in words."""
    if outcome.quality is None:
        return []
    return [f"{name}: corners cover {q.coverage_words}" for name, q in outcome.quality.cameras.items()]


def pair_rows(outcome: Outcome) -> list[list[str]]:
    """Table of the pairs of cameras: heading, then a row each."""
    rows = [["cameras", "shared", "baseline [mm]", "angle [deg]", "epipolar [px]", "board [mm]"]]
    for p in outcome.quality.pairs if outcome.quality else ():
        figures = [f"{p.baseline_mm:.2f}", f"{p.angle_deg:.1f}", _known(p.epipolar_px, 3), _known(p.board_mm, 4)]
        rows.append([", ".join(p.cameras), str(p.shared), *figures])
    return rows


def _known(value: float, digits: int) -> str:
    return "-" if value != value else f"{value:.{digits}f}"


def write_report(
    folder: Path,
    title: str,
    outcome: Outcome,
    observations: Sequence[Observation],
    residuals_px: Sequence[Array],
    paths: Mapping[str, Mapping[str, Path]],
) -> list[Path]:
    """Write ``report.html`` and a coverage picture per camera; return their paths."""
    pictures, written = {}, []
    for name, camera in outcome.rig.cameras.items():
        own = [(o, r) for o, r in zip(observations, residuals_px, strict=True) if o.camera == name]
        if not own:
            continue
        first = next(iter(paths.get(name, {}).values()), None)
        photograph = None if first is None else read_image(first)
        drawn = coverage_picture(camera.size_px, [o for o, _ in own], [r for _, r in own], photograph)
        data = cv2.imencode(".png", drawn)[1].tobytes()
        pictures[f"{name}: corners used, and how they fit; tinted cells of the picture have none"] = data
        written.append(folder / f"coverage_{name}.png")
        write_atomic(written[-1], data)
    tables = {"Cameras": camera_rows(outcome)}
    if len(outcome.rig.names) > 1 and outcome.quality is not None:
        tables["Pairs of cameras"] = pair_rows(outcome)
    tables["Lenses"] = lens_rows(outcome)
    notes = [*outcome.left_out, *outcome.warnings, *coverage_lines(outcome)]
    written.append(folder / "report.html")
    write_atomic(written[-1], page(title, outcome.verdict, tables, outcome.view_px, notes, pictures))
    return written
