"""``tubesight check``: whether a rig is still as it was calibrated."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.apps.calibrate import board_of, loaders, naming
from tubesight.calibration.drift import UNKNOWN_RMS_PX, Drift, drift, explain
from tubesight.calibration.record import from_mapping
from tubesight.calibration.search import Progress
from tubesight.core import Board, InputError
from tubesight.files.dataset import list_pairs
from tubesight.files.rig import RigFile, load_rig
from tubesight.files.tube import load_tube
from tubesight.geometry.rig import Rig
from tubesight.sensor import ShapeSensor
from tubesight.sources.folder import FolderSource, read_backgrounds

# Tips are seen to 0.02 to 0.1 px; rays of the same tip that miss each other by more than this
# (median) say that a camera moved.
_TIP_PX = 0.5
# Fewer pairs than this leave room for chance.
_FEW = 3


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """Outcome of a check.

    Attributes
    ----------
    right
        Whether the rig is still right.
    sentence, reason, next_step
        The verdict, what probably changed (empty where nothing did), and what to do.
    figures
        Plain data for ``--json``.
    rows
        Table for the screen: heading, then a row per pair.
    remarks
        What else there is to know.
    """

    right: bool
    sentence: str
    reason: str
    next_step: str
    figures: dict[str, Any]
    rows: list[list[str]]
    remarks: tuple[str, ...]


def check_board(
    folder: Path, rig_path: Path, board_path: Path | None, progress: Progress = lambda stage, done, total: None
) -> Checked:
    """Check a rig by new pictures of a board.

    Parameters
    ----------
    board_path
        None for the board that the rig was calibrated with.

    Raises
    ------
    InputError
        If no board is known or found, or something cannot be read.
    """
    file, rig = _rig(rig_path)
    board = board_of(board_path) if board_path is not None else _own_board(file, rig_path)
    pairs = list_pairs(folder, rig.names)
    paths = {c: {stem: files[c] for stem, files in pairs} for c in rig.names}
    sizes = {name: camera.size_px for name, camera in rig.cameras.items()}
    own = (file.calibration or {}).get("rms_px")
    own_px = float(own) if isinstance(own, int | float) else UNKNOWN_RMS_PX
    with naming(folder):
        found = drift(rig, own_px, loaders(paths, sizes), board, progress)
    return _judged(found, rig, own_px, isinstance(own, int | float))


def _rig(path: Path) -> tuple[RigFile, Rig]:
    file = load_rig(path)
    lacking = [n for n in file.rig.names if n not in file.rig.camera_from_base]
    if lacking:
        raise InputError(f"{path}: the pose of {', '.join(lacking)} is not known; there is nothing to check yet")
    return file, file.rig


def _own_board(file: RigFile, path: Path) -> Board:
    with naming(path):
        past = from_mapping(file.calibration, file.rig)
    if past is None:
        raise InputError(
            f"{path}: does not say with which board it was calibrated; name it with --board, or use --tube"
        )
    return past.board


def _judged(found: Drift, rig: Rig, own_px: float, known: bool) -> Checked:
    stems = list(dict.fromkeys(v for _, v in found.view_px))
    rows = [["pair", *(f"{c} [px]" for c in rig.names)]]
    for stem in stems:
        rows.append(
            [stem, *(f"{found.view_px[c, stem]:.3f}" if (c, stem) in found.view_px else "-" for c in rig.names)]
        )
    against = f"its calibration's {own_px:.2g} px" if known else f"{own_px:g} px, which a careful calibration has"
    state = "the rig is still right" if found.right else "the rig is no longer right"
    epipolar = max((p.epipolar_px for p in found.pairs), default=float("nan"))
    lines = f", corners miss their epipolar lines by {epipolar:.2g} px" if np.isfinite(epipolar) else ""
    sentence = f"{state}: boards fit within {found.rms_px:.2g} px (limit {found.limit_px:.2g}, from {against}){lines}"
    remarks = [f"{x.camera}/{x.view}: {x.reason}" for x in found.left_out]
    remarks += [f"pair {v} alone does not fit: the board moved between its pictures" for v in found.odd]
    if len(stems) < _FEW:
        remarks.append(f"only {len(stems)} pairs; {_FEW} or more, at different places, say more")
    step = "measure with `tubesight run`" if found.right else (
        "put it back and check again, or calibrate and register again"
    )  # fmt: skip
    figures = {
        "right": found.right,
        "rms_px": found.rms_px,
        "limit_px": found.limit_px,
        "calibration_rms_px": own_px if known else None,
        "scale": found.scale,
        "alone_px": found.alone_px,
        "pairs": [asdict(p) for p in found.pairs],
        "views": {v: {c: px for (c, w), px in found.view_px.items() if w == v} for v in stems},
        "motions": [asdict(m) for m in found.motions],
        "odd": found.odd,
    }
    return Checked(found.right, sentence, explain(found), step, figures, rows, tuple(remarks))


def check_tube(
    folder: Path, rig_path: Path, tube_path: Path, progress: Progress = lambda stage, done, total: None
) -> Checked:
    """Check a rig by pictures of the tube: rays of its tip have to meet.

    Sees motions across the epipolar lines alone; a board says more.

    Raises
    ------
    InputError
        If no tip is seen by two cameras, or something cannot be read.
    """
    _, rig = _rig(rig_path)
    tube = load_tube(tube_path)
    source = FolderSource(folder, rig)
    sensor = ShapeSensor(rig, tube, backgrounds=read_backgrounds(folder / "background", rig))
    rows, gaps, fits = [["pair", "tip [px]", "fit [px]"]], [], []
    for index, pair in enumerate(source):
        result = sensor(pair)
        if len(result.views) > 1:
            rays = {n: (v.tip.axis / v.tip.axis[2])[None] for n, v in result.views.items()}
            tip = rig.triangulate(rays)[0]
            gap = max(float(np.linalg.norm(rig.project(n, tip) - v.tip.px)) for n, v in result.views.items())
            gaps.append(gap if np.isfinite(gap) else float("inf"))
            fits.append(result.fit_rms_px)
            rows.append([pair.name, f"{gap:.2f}", f"{result.fit_rms_px:.2f}" if result else "-"])
        progress("seeing the tube", index + 1, len(source))
    if not gaps:
        raise InputError(
            f"{folder}: no tip is seen by two cameras; check tube.yaml, or check with pictures of a board (--board)"
        )
    middle = float(np.median(gaps))
    right = middle <= _TIP_PX
    state = "the rig seems still right" if right else "the rig is no longer right"
    sentence = (
        f"{state}: the rays of the tip miss each other by {middle:.2g} px (median of {len(gaps)}, limit {_TIP_PX:g})"
    )
    reason = "" if right else "a camera moved, or the pictures are not of one instant; a board tells which"
    remarks = ["a tip shows motions across the epipolar lines alone; pictures of a board (--board) say more"]
    if len(gaps) < _FEW:
        remarks.append(f"only {len(gaps)} tips; {_FEW} or more, at different places, say more")
    step = "measure with `tubesight run`" if right else "check with a board, or calibrate and register again"
    figures = {"right": right, "tip_px": middle, "limit_px": _TIP_PX, "pairs": len(gaps),
               "fit_rms_px": float(np.nanmedian(fits)) if np.isfinite(fits).any() else None}  # fmt: skip
    return Checked(right, sentence, reason, step, figures, rows, tuple(remarks))
