"""One method on one case: its errors, its time, and the reason where it fails."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from math import nan
from typing import Any

import numpy as np

from tubesight.apps.compare.cases import Case, Shot
from tubesight.apps.evaluate import distance_to_polyline
from tubesight.core import Array, Status
from tubesight.files.truth import TrueShape
from tubesight.geometry.curve import Curve3D
from tubesight.methods import METHODS, Method
from tubesight.sensor import Reconstruction, ShapeSensor

# Status of a row whose method raised what no method may raise.
CRASHED = "crashed"
# Points by which the distance of a measured centreline from the true one is told.
_POINTS = 101


@dataclass(frozen=True, slots=True)
class Row:
    """A method on a case; numbers are NaN where there is none.

    Attributes
    ----------
    method, case, kind
        Names; kind of the true curve.
    width_px
        Of the pictures.
    cameras
        How many were used.
    status, reason
        ``ok`` or the code of the failure, and the failure in words.
    tip_mm
        Distance of the measured tip from the true one.
    bending_deg, orientation_deg, length_mm
        Measured minus true.
    curve_mean_mm, curve_max_mm
        Distances of the measured centreline from the true one.
    true_length_mm
        Length of the true centreline.
    ms
        Processor time from pictures to curve, whether it failed or not.
    """

    method: str
    case: str
    kind: str
    width_px: int
    cameras: int
    status: str
    reason: str = ""
    tip_mm: float = nan
    bending_deg: float = nan
    orientation_deg: float = nan
    length_mm: float = nan
    curve_mean_mm: float = nan
    curve_max_mm: float = nan
    true_length_mm: float = nan
    ms: float = nan

    @property
    def ok(self) -> bool:
        """Whether it gave a shape."""
        return self.status == Status.OK


COLUMNS = tuple(column.name for column in fields(Row))


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A row with the pictures and the result it came from."""

    row: Row
    shot: Shot
    result: Reconstruction | None


def measured(case: Case, names: Sequence[str]) -> Iterator[Measured]:
    """Measure a case with methods; those that need the same pictures see the same ones."""
    variants = dict.fromkeys(METHODS[name].scene for name in names)
    for variant in variants:
        shot = case.shot(variant)
        for name in names:
            if METHODS[name].scene == variant:
                yield measure(METHODS[name], case, shot)


def measure(method: Method, case: Case, shot: Shot) -> Measured:
    """Measure one case with one method, whatever it raises."""
    width = next(iter(shot.pair.images.values())).shape[1]
    known = {"method": method.name, "case": case.name, "kind": case.true.kind, "width_px": width}
    start = time.thread_time()
    try:
        result = ShapeSensor(shot.rig, case.tube, method.name, shot.backgrounds)(shot.pair)
    # Of a method from elsewhere nothing is known: what it raises is its row, not the end of the comparison.
    except Exception as error:
        row = Row(**known, cameras=len(shot.rig.names), status=CRASHED, reason=f"{type(error).__name__}: {error}")
        return Measured(row, shot, None)
    ms = 1e3 * (time.thread_time() - start)
    row = Row(
        **known,
        cameras=len(shot.rig.names),
        status=str(result.status),
        reason="" if result else "; ".join(result.notes),
        ms=ms,
        **(_errors(result, case.true) if result else {}),
    )
    return Measured(row, shot, result)


def _errors(result: Reconstruction, true: TrueShape) -> dict[str, Any]:
    shape, curve = result.shape, result.curve
    assert shape is not None and curve is not None
    return errors(curve, true, np.degrees(shape.bending_rad), np.degrees(shape.orientation_rad))


def errors(curve: Curve3D, true: TrueShape, bending_deg: float, orientation_deg: float) -> dict[str, float]:
    """Errors of a curve, by column."""
    points = curve.at(np.linspace(0.0, curve.length_mm, _POINTS))
    off = distance_to_polyline(points, true.centreline_mm)
    # A curve that ends early lies on the true one all the way: what it misses counts as well.
    missed = distance_to_polyline(true.centreline_mm, points)
    return {
        "tip_mm": float(np.linalg.norm(points[-1] - true.tip_mm)),
        "bending_deg": float(bending_deg - true.bending_deg),
        "orientation_deg": float((orientation_deg - true.orientation_deg + 180.0) % 360.0 - 180.0),
        "length_mm": float(curve.length_mm - true.length_mm),
        "curve_mean_mm": float(max(off.mean(), missed.mean())),
        "curve_max_mm": float(max(off.max(), missed.max())),
        "true_length_mm": float(true.length_mm),
    }


def of(rows: Iterable[Row], column: str) -> Array:
    """Absolute values of a column that are known."""
    values = np.abs([getattr(row, column) for row in rows])
    return np.asarray(values[np.isfinite(values)], float)


def mean(rows: Iterable[Row], column: str) -> float:
    """Mean absolute value of a column; NaN where there is none."""
    values = of(rows, column)
    return float(values.mean()) if len(values) else nan


def largest(rows: Iterable[Row], column: str) -> float:
    """Largest absolute value of a column; NaN where there is none."""
    values = of(rows, column)
    return float(values.max()) if len(values) else nan
