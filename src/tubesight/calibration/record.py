"""What a calibration leaves in the rig file, so that a registration can solve everything again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubesight.calibration.calibrate import ALONE, Calibration
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.scene import POSE, Observation, rms
from tubesight.core import Array, Board
from tubesight.geometry.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """What a calibration observed.

    Attributes
    ----------
    lens
        Free lens parameters by camera.
    """

    board: Board
    observations: tuple[Observation, ...]
    lens: Mapping[str, tuple[str, ...]]


def to_mapping(
    calibration: Calibration, files: Mapping[str, Mapping[str, str]], hashes: Mapping[str, str], date: str
) -> dict[str, Any]:
    """Describe a calibration for the rig file (`parameters` and `covariance` are the rig's own).

    Parameters
    ----------
    files
        By camera and view: the picture's file name.
    hashes
        By ``camera/file name``.
    """
    board = calibration.board
    adjusted = calibration.adjusted
    views: dict[str, dict[str, float]] = {}
    observations = []
    for o, residuals in zip(adjusted.observations, adjusted.residuals_px, strict=True):
        view, _, alone = o.view.partition(ALONE)
        name = files[o.camera][view]
        views.setdefault(o.camera, {})[name] = round(rms([residuals]), 4)
        entry = {"picture": f"{o.camera}/{name}", "corners": _ranges(_ids(o, board)), "px": _numbers(o.px)}
        observations.append(entry | ({"alone": True} if alone else {}))
    return {
        "rms_px": round(adjusted.rms_px, 5),
        "date": date,
        "board": {k: getattr(board, k) for k in ("type", "squares", "square_mm", "marker_mm", "dictionary")
                  if getattr(board, k) is not None},
        "views": views,
        "left_out": [f"{x.camera}/{files[x.camera][x.view]}: {x.reason}" for x in calibration.left_out],
        "image_hashes": dict(hashes),
        "observations": observations,
    }  # fmt: skip


def from_mapping(mapping: Mapping[str, Any] | None, rig: Rig) -> Past | None:
    """Read back what `to_mapping` wrote; None where there are no observations.

    Raises
    ------
    CalibrationError
        If the observations are there but cannot be read; the message lacks the file's name.
    """
    if not mapping or "observations" not in mapping:
        return None
    try:
        keys = mapping["board"]
        columns, rows = keys["squares"]
        board = Board(keys["type"], (columns, rows), keys["square_mm"], keys.get("marker_mm"), keys.get("dictionary"))
        observations = tuple(_observation(entry, board) for entry in mapping["observations"])
        names = [str(n) for n in mapping["parameters"]]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise CalibrationError(f"calibration: cannot read the observations ({error!r:.80}); calibrate again") from error
    lens: dict[str, tuple[str, ...]] = {}
    for camera in rig.names:
        own = [n.removeprefix(f"{camera}.") for n in names if n.rpartition(".")[0] == camera]
        lens[camera] = tuple(n for n in own if n not in POSE)
    strangers = {o.camera for o in observations} - set(rig.names)
    if strangers or set(rig.camera_from_base) != set(rig.names):
        raise CalibrationError("calibration: the observations are not of the file's cameras; calibrate again")
    return Past(board, observations, lens)


def _observation(entry: Mapping[str, Any], board: Board) -> Observation:
    camera, _, name = str(entry["picture"]).partition("/")
    view = PurePosixPath(name).stem
    ids: list[int] = []
    for part in str(entry["corners"]).split():
        first, _, last = part.partition("-")
        ids += range(int(first), int(last or first) + 1)
    px = np.array(str(entry["px"]).split(), dtype=float).reshape(-1, 2)
    if not np.isfinite(px).all():
        raise ValueError("a pixel is not finite")
    return Observation(camera, f"{view}{ALONE}{camera}" if entry.get("alone") else view, board.corners_mm[ids], px)


def _ids(o: Observation, board: Board) -> NDArray[np.intp]:
    """Rows of the board's corners that an observation holds."""
    columns = board.inner_corners[0]
    first = board.corners_mm[0]
    place = np.rint((o.points_mm - first)[:, :2] / board.square_mm).astype(np.intp)
    return np.asarray(place[:, 0] + columns * place[:, 1])


def _ranges(ids: NDArray[np.intp]) -> str:
    """Ascending numbers as ranges: "0-4 7-7"."""
    groups = np.split(ids, np.flatnonzero(np.diff(ids) != 1) + 1)
    return " ".join(f"{g[0]}-{g[-1]}" for g in groups if len(g))


def _numbers(px: Array) -> str:
    # A ten-thousandth of a pixel is a hundredth of what a corner is known to.
    return " ".join(f"{value:.4f}" for value in px.ravel())
