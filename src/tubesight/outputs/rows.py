"""Reconstructions as rows of ``shapes.csv`` and curves of ``curves.npz``, and the folder that holds them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.core import Array, Status
from tubesight.files.tables import Curves, ShapeRow, write_curves, write_json, write_shapes
from tubesight.geometry.curve import Curve3D, NodeCurve
from tubesight.outputs.plot3d import plots_installed, write_plot
from tubesight.sensor import Reconstruction

# Points of a stored curve: at 160 mm one each 1.6 mm, where the chord of a 50 mm radius is 0.006 mm off the arc.
CURVE_POINTS = 101


def shape_row(result: Reconstruction, time_s: float = float("nan")) -> ShapeRow:
    """Turn a reconstruction into its row; anything but ``ok`` has no numbers."""
    shape = result.shape
    notes = "; ".join(result.notes)
    if not result or shape is None:
        return ShapeRow(
            result.frame,
            time_s=time_s,
            status=str(result.status),
            notes=notes or result.status.advice,
            method=result.method,
            total_ms=result.total_ms,
        )
    sd = shape.sd
    return ShapeRow(
        frame=result.frame,
        time_s=time_s,
        status=str(result.status),
        notes=notes,
        tip_x_mm=float(shape.tip_mm[0]),
        tip_y_mm=float(shape.tip_mm[1]),
        tip_z_mm=float(shape.tip_mm[2]),
        bending_deg=math.degrees(shape.bending_rad),
        orientation_deg=math.degrees(shape.orientation_rad),
        length_mm=shape.length_mm,
        curvature_per_mm=shape.curvature_per_mm,
        tip_x_sd_mm=sd["tip_x"],
        tip_y_sd_mm=sd["tip_y"],
        tip_z_sd_mm=sd["tip_z"],
        bending_sd_deg=math.degrees(sd["bending"]),
        orientation_sd_deg=math.degrees(sd["orientation"]),
        length_sd_mm=sd["length"],
        curvature_sd_per_mm=sd["curvature"],
        fit_rms_px=result.fit_rms_px,
        model=result.curve.model if result.curve is not None else "",
        method=result.method,
        total_ms=result.total_ms,
    )


def unreadable_row(frame: str, reason: str, method: str) -> ShapeRow:
    """Row of a pair whose pictures could not be read."""
    return ShapeRow(frame, status=str(Status.BAD_IMAGE), notes=reason, method=method)


def curves_of(found: Sequence[tuple[str, Curve3D]]) -> Curves:
    """Sample curves, given with their frames, at equal arc lengths."""
    share = np.linspace(0.0, 1.0, CURVE_POINTS)
    s = np.array([share * curve.length_mm for _, curve in found]).reshape(-1, CURVE_POINTS)
    xyz = np.array([curve.at(row) for (_, curve), row in zip(found, s, strict=True)]).reshape(-1, CURVE_POINTS, 3)
    sd = np.array([deviation_mm(curve, share) for _, curve in found]).reshape(-1, CURVE_POINTS)
    return Curves(tuple(frame for frame, _ in found), s, xyz, sd)


def deviation_mm(curve: Curve3D, share: Array) -> Array:
    """Root of the trace of the position's covariance at shares of the length (N,); NaN where the curve carries none."""
    if not isinstance(curve, NodeCurve) or not curve.from_picture:
        return np.full_like(share, np.nan)
    points = curve.at(share * curve.length_mm)
    off = [other.at(share * other.length_mm) - points for other in (*curve.from_picture, *curve.from_rig)]
    return np.asarray(np.sqrt((np.array(off) ** 2).sum((0, 2))))


def write_results(out: Path, rows: Sequence[ShapeRow], curves: Curves, about: Mapping[str, Any]) -> list[Path]:
    """Write ``shapes.csv``, ``curves.npz``, ``run.json`` and, where matplotlib is there, ``shapes.png``.

    Parameters
    ----------
    about
        What made the results, for ``run.json``.
    """
    table, npz, run, plot = (out / name for name in ("shapes.csv", "curves.npz", "run.json", "shapes.png"))
    write_shapes(table, rows)
    write_curves(npz, curves)
    write_json(run, about)
    if not plots_installed():
        return [table, npz, run]
    write_plot(plot, curves)
    return [table, npz, run, plot]
