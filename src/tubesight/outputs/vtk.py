"""Centrelines as VTK polylines, for ParaView, 3D Slicer and PyVista."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from tubesight.core import Array
from tubesight.files.safe import write_atomic
from tubesight.files.tables import Curves


def write_vtk(out: Path, curves: Curves, times_s: Sequence[float]) -> list[Path]:
    """Write a polyline a curve, ``curve_FRAME.vtk``, and ``curves.vtk.series``, which ParaView opens as one in time.

    Points are millimetres; ``s_mm`` and ``sd_mm`` are their data.
    """
    files = []
    for frame, s, xyz, sd in zip(curves.frame, curves.s_mm, curves.xyz_mm, curves.sd_mm, strict=True):
        path = out / f"curve_{frame}.vtk"
        write_atomic(path, polyline(xyz, {"s_mm": s, "sd_mm": sd}))
        files.append(path)
    series = {
        "file-series-version": "1.0",
        "files": [{"name": path.name, "time": time} for path, time in zip(files, times_s, strict=True)],
    }
    write_atomic(out / "curves.vtk.series", json.dumps(series, indent=1))
    return [*files, out / "curves.vtk.series"]


def polyline(points: Array, data: Mapping[str, Array]) -> str:
    """Text of a legacy VTK file: one line through points (N, 3) with numbers (N,) at each; NaN where not known."""
    count = len(points)
    lines = [
        "# vtk DataFile Version 3.0",
        "centreline of a tube, mm",
        "ASCII",
        "DATASET POLYDATA",
        f"POINTS {count} double",
        *(" ".join(repr(float(v)) for v in point) for point in points),
        f"LINES 1 {count + 1}",
        " ".join(str(n) for n in (count, *range(count))),
        f"POINT_DATA {count}",
    ]
    for name, values in data.items():
        lines += [f"SCALARS {name} double 1", "LOOKUP_TABLE default", *(repr(float(v)) for v in values)]
    return "\n".join(lines) + "\n"
