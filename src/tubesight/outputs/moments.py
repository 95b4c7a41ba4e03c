"""Live results as plain data: what recordings hold and the network gets."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

import numpy as np

from tubesight.outputs.rows import curves_of, shape_row
from tubesight.tracking.tracker import Tracked


def moment_data(tracked: Tracked) -> dict[str, Any]:
    """Turn a live result into plain data; numbers that are not known are null.

    Keys: ``state``, ``time_s``, ``skew_s``, ``latency_s``, ``late``, ``faults``, ``notes``, ``moved``, ``family``,
    ``pictures`` (numbers by camera), ``times_s`` (by camera), ``row`` (the columns of ``shapes.csv``), ``s_mm``,
    ``xyz_mm``, ``sd_mm`` (the curve at 101 equal arc lengths, as in ``curves.npz``), ``filtered`` (``position_mm``,
    ``sd_mm``).
    """
    data: dict[str, Any] = {
        "state": str(tracked.state),
        "time_s": tracked.time_s,
        "skew_s": tracked.skew_s,
        "latency_s": _number(tracked.latency_s),
        "late": tracked.late,
        "faults": {name: str(fault) for name, fault in tracked.faults.items()},
        "notes": list(tracked.notes),
        "moved": tracked.moved,
        "family": tracked.family,
    }
    if tracked.pair is not None:
        data["pictures"] = {name: frame.number for name, frame in tracked.pair.frames.items()}
        data["times_s"] = {name: frame.time_s for name, frame in tracked.pair.frames.items()}
    result = tracked.result
    if result is not None:
        row = asdict(shape_row(result, tracked.time_s))
        data["row"] = {key: _number(value) for key, value in row.items()}
        if result and result.curve is not None:
            curves = curves_of([(result.frame, result.curve)])
            data["s_mm"], data["xyz_mm"] = curves.s_mm[0].tolist(), curves.xyz_mm[0].tolist()
            data["sd_mm"] = [_number(value) for value in curves.sd_mm[0].tolist()]
    if tracked.filtered is not None:
        deviation = np.sqrt(tracked.filtered.position_covariance.diagonal())
        data["filtered"] = {"position_mm": tracked.filtered.position_mm.tolist(), "sd_mm": deviation.tolist()}
    return data


def moment_json(tracked: Tracked) -> bytes:
    """Write `moment_data` as JSON: floats to their last bit."""
    return json.dumps(moment_data(tracked), allow_nan=False, separators=(",", ":")).encode()


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
