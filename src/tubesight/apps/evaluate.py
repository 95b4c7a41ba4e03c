"""``tubesight evaluate``: results against the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.core import Array, InputError, Status
from tubesight.files.tables import ShapeRow, read_curves, read_shapes
from tubesight.files.truth import TrueShape, load_truth


@dataclass(frozen=True, slots=True)
class FrameError:
    """Errors of one frame, measured minus true; NaN where there is nothing to compare.

    Attributes
    ----------
    status
        Of the row; only ``ok`` rows have errors.
    tip_x_mm, tip_y_mm, tip_z_mm
        Signed, `tip_mm` their length.
    bending_deg, orientation_deg
        Signed, wrapped to +-180; a straight tube has no orientation to compare.
    length_mm
        Signed.
    curve_mm
        Mean distance of the measured centreline from the true one.
    """

    status: str
    tip_x_mm: float = math.nan
    tip_y_mm: float = math.nan
    tip_z_mm: float = math.nan
    tip_mm: float = math.nan
    bending_deg: float = math.nan
    orientation_deg: float = math.nan
    length_mm: float = math.nan
    curve_mm: float = math.nan


QUANTITIES = tuple(name for name in FrameError.__slots__ if name != "status")


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Results judged by the truth.

    Attributes
    ----------
    frames
        Errors by frame, for every frame that has both a row and a truth.
    without_row, without_truth
        Frames of the truth that have no row, and the other way round.
    """

    frames: Mapping[str, FrameError]
    without_row: tuple[str, ...]
    without_truth: tuple[str, ...]

    @property
    def failures(self) -> int:
        """Rows that are not ``ok``."""
        return sum(error.status != Status.OK for error in self.frames.values())

    def mean(self, quantity: str) -> float:
        """Mean absolute error of a quantity; NaN where there is none."""
        values = self._absolute(quantity)
        return float(values.mean()) if len(values) else math.nan

    def max(self, quantity: str) -> float:
        """Largest absolute error of a quantity; NaN where there is none."""
        values = self._absolute(quantity)
        return float(values.max()) if len(values) else math.nan

    def _absolute(self, quantity: str) -> Array:
        values = np.abs([getattr(error, quantity) for error in self.frames.values()])
        return np.asarray(values[np.isfinite(values)], float)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data: counts, ``mean`` and ``max`` by quantity, errors by frame."""
        return {
            "n": len(self.frames),
            "failures": self.failures,
            "mean": {name: self.mean(name) for name in QUANTITIES},
            "max": {name: self.max(name) for name in QUANTITIES},
            "frames": {name: asdict(error) for name, error in self.frames.items()},
            "without_row": list(self.without_row),
            "without_truth": list(self.without_truth),
        }


def evaluate(out: Path, truth_path: Path) -> Evaluation:
    """Compare ``shapes.csv`` and ``curves.npz`` of a run with ``truth.json``.

    Raises
    ------
    InputError
        If a file cannot be used, a frame has more than one row, or no frame is in both.
    """
    if not out.is_dir():
        raise InputError(f"{out}: no such folder; name the folder that `tubesight run` wrote")
    truth = load_truth(truth_path)
    rows: dict[str, ShapeRow] = {}
    for row in read_shapes(out / "shapes.csv"):
        if row.frame in rows:
            raise InputError(f"{out / 'shapes.csv'}: frame {row.frame!r} has two rows; evaluate one tube at a time")
        rows[row.frame] = row
    curves = read_curves(out / "curves.npz")
    measured = dict(zip(curves.frame, curves.xyz_mm, strict=True))
    both = [name for name in truth if name in rows]
    if not both:
        raise InputError(f"{truth_path}: no frame of it is in {out / 'shapes.csv'}; name the truth of these pictures")
    return Evaluation(
        {name: _frame_error(rows[name], truth[name], measured.get(name)) for name in both},
        tuple(name for name in truth if name not in rows),
        tuple(name for name in rows if name not in truth),
    )


def _frame_error(row: ShapeRow, true: TrueShape, curve_mm: Array | None) -> FrameError:
    if row.status != Status.OK:
        return FrameError(row.status)
    tip = np.array([row.tip_x_mm, row.tip_y_mm, row.tip_z_mm]) - true.tip_mm
    return FrameError(
        row.status,
        float(tip[0]),
        float(tip[1]),
        float(tip[2]),
        float(np.linalg.norm(tip)),
        row.bending_deg - true.bending_deg,
        _wrapped(row.orientation_deg - true.orientation_deg),
        row.length_mm - true.length_mm,
        float(distance_to_polyline(curve_mm, true.centreline_mm).mean()) if curve_mm is not None else math.nan,
    )


def _wrapped(angle_deg: float) -> float:
    """Turn an angle difference into [-180, 180)."""
    return (angle_deg + 180.0) % 360.0 - 180.0


def distance_to_polyline(points_mm: Array, line_mm: Array) -> Array:
    """Distances (N,) of points (N, 3) from the nearest place on a polyline (M, 3)."""
    start, step = line_mm[:-1], np.diff(line_mm, axis=0)
    squared = (step**2).sum(1)
    offset = points_mm[:, None] - start
    along = np.clip((offset * step).sum(-1) / np.where(squared > 0, squared, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - along[..., None] * step, axis=-1).min(1))
