"""``tubesight export``: a recording's results in the formats of others."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from tubesight.core import InputError
from tubesight.files.packages import require_package
from tubesight.files.recording import RecordedResult, Recording
from tubesight.files.tables import Curves, ShapeRow, write_curves, write_shapes
from tubesight.outputs.ros_bag import write_ros_bag
from tubesight.outputs.rows import CURVE_POINTS
from tubesight.outputs.vtk import write_vtk

_TYPES = {field.name: field.type for field in fields(ShapeRow)}


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written: results, and the files."""

    results: int
    files: tuple[Path, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """All results of a recording: rows with what the live loop adds, and the curves of those that have one."""

    rows: tuple[ShapeRow, ...]
    live: tuple[Mapping[str, Any], ...]
    curves: Curves
    curve_times_s: tuple[float, ...]


def export(path: Path, form: str, out: Path) -> Exported:
    """Write a recording's results.

    Parameters
    ----------
    form
        One of `FORMATS`.
    out
        The file for ``csv``, ``parquet`` and ``npz``, the folder for ``vtk`` and ``ros2``.

    Raises
    ------
    InputError
        If the recording holds no results, a package is missing, or the place cannot be written.
    """
    if form not in FORMATS:
        raise ValueError(f"form: expected one of {', '.join(FORMATS)}, got {form!r}")
    recording = Recording(path)
    if form == "ros2":
        return Exported(write_ros_bag(recording, out), (out,))
    results = read_results(recording)
    if not results.rows:
        raise InputError(f"{path}: holds no results; measure its pictures with `tubesight replay`")
    return Exported(len(results.rows), tuple(_TABLES[form](results, out)))


def read_results(recording: Recording) -> Results:
    """Read rows and curves of a recording; times count from its first result."""
    rows: list[ShapeRow] = []
    live, found = [], []
    start_s = math.nan
    for entry in recording.entries():
        if not isinstance(entry, RecordedResult) or entry.data.get("row") is None:
            continue
        try:
            row = ShapeRow(**{key: _value(key, value) for key, value in entry.data["row"].items()})
            if entry.data.get("xyz_mm") is not None:
                curve = tuple(np.array(entry.data[key], float) for key in ("s_mm", "xyz_mm", "sd_mm"))
                if [a.shape for a in curve] != [(CURVE_POINTS,), (CURVE_POINTS, 3), (CURVE_POINTS,)]:
                    raise ValueError("a curve has the wrong shape")
                found.append((row.frame, row.time_s - (start_s if rows else row.time_s), curve))
        except (TypeError, ValueError, AttributeError, KeyError) as error:
            raise InputError(f"{recording.path}: a result in it is damaged ({error}); record again") from error
        start_s = row.time_s if not rows else start_s
        rows.append(replace(row, time_s=row.time_s - start_s))
        live.append({key: entry.data.get(key) for key in ("state", "skew_s", "latency_s", "late")})
    k = CURVE_POINTS
    curves = Curves(
        tuple(frame for frame, _, _ in found),
        np.array([c[0] for _, _, c in found]).reshape(-1, k),
        np.array([c[1] for _, _, c in found]).reshape(-1, k, 3),
        np.array([c[2] for _, _, c in found]).reshape(-1, k),
    )
    return Results(tuple(rows), tuple(live), curves, tuple(time for _, time, _ in found))


def _value(key: str, value: Any) -> Any:
    if value is None and _TYPES.get(key) == "float":
        return math.nan
    return value


def _csv(results: Results, out: Path) -> list[Path]:
    write_shapes(out, results.rows)
    return [out]


def _npz(results: Results, out: Path) -> list[Path]:
    write_curves(out, results.curves)
    return [out]


def _vtk(results: Results, out: Path) -> list[Path]:
    return write_vtk(out, results.curves, results.curve_times_s)


def _parquet(results: Results, out: Path) -> list[Path]:
    require_package("pyarrow", "tables", f"{out}: Parquet needs the package pyarrow")
    import pyarrow
    import pyarrow.parquet

    columns = {name: [getattr(row, name) for row in results.rows] for name in _TYPES}
    columns |= {name: [extra[name] for extra in results.live] for name in results.live[0]}
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        pyarrow.parquet.write_table(pyarrow.table(columns), out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another place") from error
    return [out]


_TABLES: Mapping[str, Callable[[Results, Path], list[Path]]] = MappingProxyType(
    {"csv": _csv, "parquet": _parquet, "npz": _npz, "vtk": _vtk}
)
#: Names of the formats; ``ros2`` takes the pictures too.
FORMATS = (*_TABLES, "ros2")
