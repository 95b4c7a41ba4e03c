"""``registration.yaml`` and point tables: where things lie in the base frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from tubesight.core import Array, InputError, readonly
from tubesight.files.safe import Strict, load_csv, load_yaml, number, unknown_name
from tubesight.geometry.pose import Pose

_Row4 = tuple[float, float, float, float]


class _View(Strict):
    image: str
    base_from_board: tuple[_Row4, _Row4, _Row4, _Row4]


class _RegistrationFile(Strict):
    units: Literal["mm"]
    views: list[_View] = Field(min_length=1)


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points known in the base frame, and where the cameras see them.

    Attributes
    ----------
    names
        One a point.
    xyz_mm
        (N, 3), base frame.
    px
        By camera name: (N, 2), NaN where the camera does not see the point.
    """

    names: tuple[str, ...]
    xyz_mm: Array
    px: Mapping[str, Array]


def load_registration(path: Path) -> list[tuple[str, Pose]]:
    """Read ``registration.yaml``: per view the name of its picture and ``base_from_board``."""
    views = []
    for view in load_yaml(path, _RegistrationFile).views:
        if Path(view.image).name != view.image:
            raise InputError(f"{path}: views: {view.image[:60]!r} has to be a file name without a folder")
        try:
            views.append((view.image, Pose.from_matrix(view.base_from_board)))
        except ValueError as error:
            raise InputError(f"{path}: views: {view.image}: base_from_board: {error}; mend it") from error
    return views


def load_points(path: Path) -> Points:
    """Read a table ``name, x_mm, y_mm, z_mm, left_x_px, left_y_px, ...``; empty cells where a point is not seen."""
    header, rows = load_csv(path)
    fixed = ["name", "x_mm", "y_mm", "z_mm"]
    cameras = list(dict.fromkeys(column[:-5] for column in header if column.endswith(("_x_px", "_y_px"))))
    known = fixed + [f"{camera}_{axis}_px" for camera in cameras for axis in "xy"]
    for column in header:
        if column not in known:
            raise InputError(f"{path}: {unknown_name('column', column, [*fixed, 'left_x_px', 'left_y_px'])}")
    for column in known:
        if column not in header:
            raise InputError(f"{path}: the column {column!r} is missing; add it")
    if not rows or not cameras:
        raise InputError(
            f"{path}: there are no points seen by a camera; add columns such as left_x_px, left_y_px, and rows"
        )

    def cells(name: str) -> list[float]:
        return [number(row[name], path, f"point {row['name'][:40]!r}, {name}") for row in rows]

    xyz = np.array([cells(f"{axis}_mm") for axis in "xyz"]).T
    if not np.isfinite(xyz).all():
        missing = rows[int(np.argmin(np.isfinite(xyz).all(1)))]["name"]
        raise InputError(f"{path}: point {missing[:40]!r} has no position; fill in x_mm, y_mm and z_mm")
    px = {}
    for camera in cameras:
        seen = np.array([cells(f"{camera}_{axis}_px") for axis in "xy"]).T
        half = np.isnan(seen).any(1) & ~np.isnan(seen).all(1)
        if half.any():
            name = rows[int(np.argmax(half))]["name"][:40]
            raise InputError(f"{path}: point {name!r} has half a position in {camera}; fill it in or clear it")
        px[camera] = readonly(seen, (None, 2), f"{camera} px")
    return Points(tuple(row["name"] for row in rows), readonly(xyz, (None, 3), "xyz_mm"), px)
