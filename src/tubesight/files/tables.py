"""Results on disk: ``shapes.csv``, ``curves.npz`` and ``run.json``."""

from __future__ import annotations

import csv
import io
import json
import math
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.core import Array, InputError
from tubesight.files.nested import plain
from tubesight.files.safe import load_csv, number, read_bytes, unknown_name, write_atomic

# 200000 rows.
_SHAPES_BYTES = 64 << 20
# 100000 curves of 101 points, also after unpacking: a small npz can declare gigabytes.
_CURVES_BYTES = 512 << 20

_NAN = float("nan")


@dataclass(frozen=True, slots=True)
class ShapeRow:
    """One row of ``shapes.csv``; the fields are its columns, in order. Numbers that are not known are NaN."""

    frame: str
    tube: int = 0
    time_s: float = _NAN
    status: str = "ok"
    notes: str = ""
    tip_x_mm: float = _NAN
    tip_y_mm: float = _NAN
    tip_z_mm: float = _NAN
    bending_deg: float = _NAN
    orientation_deg: float = _NAN
    length_mm: float = _NAN
    curvature_per_mm: float = _NAN
    tip_x_sd_mm: float = _NAN
    tip_y_sd_mm: float = _NAN
    tip_z_sd_mm: float = _NAN
    bending_sd_deg: float = _NAN
    orientation_sd_deg: float = _NAN
    length_sd_mm: float = _NAN
    curvature_sd_per_mm: float = _NAN
    fit_rms_px: float = _NAN
    model: str = ""
    method: str = ""
    total_ms: float = _NAN


COLUMNS = tuple(field.name for field in fields(ShapeRow))
#: Columns of standard deviations.
SD_COLUMNS = tuple(name for name in COLUMNS if "_sd_" in name)
_TEXT = ("frame", "status", "notes", "model", "method")


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Centrelines of the frames that have one.

    Attributes
    ----------
    frame
        (n,) names.
    s_mm
        (n, k) arc lengths from the base.
    xyz_mm
        (n, k, 3), base frame.
    sd_mm
        (n, k) standard deviation of the position; NaN where not known.
    """

    frame: tuple[str, ...]
    s_mm: Array
    xyz_mm: Array
    sd_mm: Array


def write_shapes(path: Path, rows: Iterable[ShapeRow]) -> None:
    """Write ``shapes.csv``: seven significant digits, empty cells for NaN."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        writer.writerow([_cell(value) for value in astuple(row)])
    write_atomic(path, text.getvalue())


def _cell(value: str | float) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.7g}"
    return str(value)


def read_shapes(path: Path) -> list[ShapeRow]:
    """Read ``shapes.csv``; raise `InputError` where columns or numbers are not those of the format."""
    header, rows = load_csv(path, _SHAPES_BYTES)
    for column in header:
        if column not in COLUMNS:
            raise InputError(f"{path}: {unknown_name('column', column, COLUMNS)}")
    for column in COLUMNS:
        if column not in header:
            raise InputError(f"{path}: the column {column!r} is missing; write the table again with `tubesight run`")
    table = []
    for row in rows:
        where = f"frame {row['frame'][:40]!r}"
        values: dict[str, Any] = {
            name: cell if name in _TEXT else number(cell, path, f"{where}, {name}") for name, cell in row.items()
        }
        if math.isnan(values["tube"]):
            raise InputError(f"{path}: {where}, tube: the number of the tube is missing; write 0")
        values["tube"] = int(values["tube"])
        table.append(ShapeRow(**values))
    return table


def write_curves(path: Path, curves: Curves) -> None:
    """Write ``curves.npz``."""
    data = io.BytesIO()
    names = np.array(curves.frame, dtype=np.str_) if curves.frame else np.zeros(0, "U1")
    np.savez_compressed(data, frame=names, s_mm=curves.s_mm, xyz_mm=curves.xyz_mm, sd_mm=curves.sd_mm)
    write_atomic(path, data.getvalue())


def read_curves(path: Path) -> Curves:
    """Read ``curves.npz``: never unpickled, and no larger unpacked than results can be."""
    data = read_bytes(path, _CURVES_BYTES)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if sum(member.file_size for member in members) > _CURVES_BYTES:
                raise InputError(f"{path}: larger unpacked than results can be; write it again with `tubesight run`")
            arrays = {}
            for name in ("frame", "s_mm", "xyz_mm", "sd_mm"):
                # Reading from memory bounds what a header that lies about its shape can allocate.
                arrays[name] = _array(archive.read(f"{name}.npy"))
    except InputError:
        raise
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{path}: not a table of curves ({error}); write it again with `tubesight run`") from error
    n, k = arrays["s_mm"].shape if arrays["s_mm"].ndim == 2 else (-1, -1)
    shapes = {"frame": (n,), "s_mm": (n, k), "xyz_mm": (n, k, 3), "sd_mm": (n, k)}
    for name, shape in shapes.items():
        numeric = arrays[name].dtype.kind == ("U" if name == "frame" else "f")
        if arrays[name].shape != shape or not numeric:
            raise InputError(f"{path}: {name} has the wrong shape or type; write it again with `tubesight run`")
    names = tuple(str(name) for name in arrays["frame"])
    return Curves(names, arrays["s_mm"], arrays["xyz_mm"], arrays["sd_mm"])


def _array(data: bytes) -> np.ndarray[Any, Any]:
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError("the header does not match the data")
    return np.asarray(np.lib.format.read_array(io.BytesIO(data), allow_pickle=False))


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write JSON for people and programs: indented, NaN as null."""
    write_atomic(path, to_json(data) + "\n")


def to_json(data: Mapping[str, Any]) -> str:
    """Write data as JSON text; numbers that are not finite become null, which JSON has instead."""
    return json.dumps(_finite(plain(data)), indent=2, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return value
