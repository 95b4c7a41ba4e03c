"""A reconstruction as the plain data of a message (`tubesight.files.message`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tubesight.outputs.rows import deviation_mm, shape_row
from tubesight.sensor import Reconstruction

# Points of a sent curve: at 160 mm one each 5 mm, where the chord of a 50 mm radius is 0.06 mm off the arc.
CURVE_POINTS = 33
# Digits behind the point of lengths (0.1 um) and of curvatures and directions: below any deviation.
_MM_DIGITS, _FINE_DIGITS = 4, 7


def result_message(result: Reconstruction, number: int, time_s: float = float("nan")) -> dict[str, Any]:
    """Turn a reconstruction into a message.

    Parameters
    ----------
    number
        Counts the results of a sender.
    time_s
        Time of the pictures.
    """
    row = shape_row(result, time_s)
    message: dict[str, Any] = {
        "format": "tubesight-result/1",
        "number": number,
        "frame": row.frame,
        "time_s": _known(row.time_s, 6),
        "status": row.status,
        "notes": list(result.notes),
        "method": row.method,
        "model": row.model or None,
        "tip_mm": None,
        "tip_direction": None,
        "bending_deg": _known(row.bending_deg),
        "orientation_deg": _known(row.orientation_deg),
        "length_mm": _known(row.length_mm),
        "curvature_per_mm": _known(row.curvature_per_mm, _FINE_DIGITS),
        "sd": None,
        "curve_mm": None,
        "curve_sd_mm": None,
        "fit_rms_px": _known(row.fit_rms_px),
        "total_ms": round(row.total_ms, 3),
    }
    if result.shape is None or result.curve is None:
        return message
    share = np.linspace(0.0, 1.0, CURVE_POINTS)
    curve = result.curve
    message |= {
        "tip_mm": result.shape.tip_mm.round(_MM_DIGITS).tolist(),
        "tip_direction": curve.tangent([curve.length_mm])[0].round(_FINE_DIGITS).tolist(),
        "sd": {
            "tip_mm": [_known(row.tip_x_sd_mm), _known(row.tip_y_sd_mm), _known(row.tip_z_sd_mm)],
            "bending_deg": _known(row.bending_sd_deg),
            "orientation_deg": _known(row.orientation_sd_deg),
            "length_mm": _known(row.length_sd_mm),
            "curvature_per_mm": _known(row.curvature_sd_per_mm, _FINE_DIGITS),
        },
        "curve_mm": curve.at(share * curve.length_mm).round(_MM_DIGITS).tolist(),
        "curve_sd_mm": [_known(sd) for sd in deviation_mm(curve, share).tolist()],
    }
    return message


def _known(value: float, digits: int = _MM_DIGITS) -> float | None:
    return round(value, digits) if math.isfinite(value) else None
