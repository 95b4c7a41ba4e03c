"""The nine criteria of the paper's table 2, decided by what was measured and given instead of what is claimed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite, nan
from types import MappingProxyType

import numpy as np

from tubesight.apps.compare.measure import Row, largest, mean
from tubesight.apps.evaluate import distance_to_polyline
from tubesight.files.truth import TrueShape
from tubesight.geometry.arcs import free_arc

# 30 frames a second (criterion 1), and a millimetre (criterion 2).
_FRAME_MS, _ACCURATE_MM = 1e3 / 30, 1.0
# A method that refuses more than this share of the pictures is not accurate on them, one that refuses more than half
# does not reconstruct.
_REFUSED, _HALF = 0.1, 0.5
# Share of what the best circular arc leaves on a curve that is none, under which a curve is not such an arc.
_ARC_SHARE = 0.5
# Kinds of curve that are circular arcs.
ROUND = ("circle", "straight")

CRITERIA: Mapping[str, str] = MappingProxyType(
    {
        "1": "fast: over 30 pairs a second, on one core of this machine",
        "2": "accurate: every measured tip and every mean curve distance within 1 mm, at most a tenth refused",
        "3": "needs no more than two cameras",
        "4": "needs no markers",
        "5": "needs no physical grid",
        "6": "needs no initial guess",
        "7": "follows the elliptic tube: at most half of what the best circular arc leaves, in the mean",
        "8": "finds the tip: within 1 mm in the mean",
        "9": "3-D: half of the pairs or more, and the curve lies inside the true tube in the mean",
    }
)
# What the paper's table 2 states: met, not met, unknown; by criterion.
_STATED: Mapping[str, str] = MappingProxyType(
    {
        "markers": "?nynyy?yy",
        "epipolar": "n?yyyy??y",
        "arcs_planar": "y?ynyynyn",
        "carving": "nynyyyyyy",
        "affine_shape": "??nyyy??y",
        "markers_arcs": "n?ynnynyy",
        "nurbs": "?ynyyy??y",
        "symmetric": "n?yyyy??y",
        "som": "nnyyynyny",
        "reference": "yyyyyyyyy",
    }
)

# What `Method.given` says of a method that does not meet a criterion.
_NEEDS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"3": ("views", "cameras"), "4": ("marker", "band"), "5": ("grid",), "6": ("initial guess",)}
)


def stated(name: str) -> dict[str, bool | None]:
    """Return what the paper states of a method, by criterion; empty where it is not in its table."""
    marks = {"y": True, "n": False, "?": None}
    return {str(k): marks[mark] for k, mark in enumerate(_STATED.get(name, ""), start=1)}


def judged(given: Sequence[str], rows: Sequence[Row], radius_mm: float, best_arc_mm: float) -> dict[str, bool | None]:
    """Decide the criteria by rows of one method; None where nothing measured decides.

    Parameters
    ----------
    given
        What the method is given beyond two calibrated pictures.
    radius_mm
        Of the tube, for criterion 9; NaN where it is not known.
    best_arc_mm
        Mean distance that the best circular arc leaves on the curves that are none, for criterion 7; NaN where all are
        circular.
    """
    good = [row for row in rows if row.ok]
    refused = 1 - len(good) / len(rows) if rows else 1.0
    bent = [row for row in good if row.kind not in ROUND]
    tips, curves = largest(good, "tip_mm"), largest(good, "curve_mean_mm")
    return {
        "1": _under(mean(rows, "ms"), _FRAME_MS),
        "2": bool(good) and refused <= _REFUSED and tips <= _ACCURATE_MM and curves <= _ACCURATE_MM,
        **{key: not any(word in text for text in given for word in words) for key, words in _NEEDS.items()},
        "7": _under(mean(bent, "curve_mean_mm"), _ARC_SHARE * best_arc_mm),
        "8": bool(good) and mean(good, "tip_mm") <= _ACCURATE_MM,
        "9": bool(good) and refused <= _HALF and _under(mean(good, "curve_mean_mm"), radius_mm),
    }


def _under(value: float, limit: float) -> bool | None:
    return bool(value <= limit) if isfinite(value) and isfinite(limit) else None


def best_arc_mm(true: TrueShape) -> float:
    """Mean distance of a centreline from the circular arc that fits it best; NaN where no arc does."""
    points = true.centreline_mm
    try:
        arc = free_arc(points, np.ones(len(points)), true.tip_mm)
    except ValueError:
        return nan
    return float(distance_to_polyline(points, arc.at(np.linspace(0.0, arc.length_mm, 4 * len(points)))).mean())
