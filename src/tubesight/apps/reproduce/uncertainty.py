"""Uncertainty: is the fit as good as the edges allow, does it say how good it is, does it fail, near straight too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from tubesight.apps.planning.information import Errors
from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.edge_trials import INDEPENDENT, QUANTITIES, Row, Trial, column, rms, tried
from tubesight.apps.reproduce.study import Context, StudyResult, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_METHOD = "silhouette"
# Poses of the tube for bound and coverage, and camera angles of the search for failures.
_BENDING_DEG = (10.0, 30.0, 50.0, 70.0, 90.0)
_FAILURE_ANGLES_DEG = (20.0, 40.0, 60.0, 90.0, 120.0, 140.0, 160.0)
# From 5 degrees to straight.
_STRAIGHT_DEG = tuple(np.round(np.arange(5.0, -0.05, -0.1), 3).tolist())
_STRAIGHT_PHI_DEG = 53.0
_SCENARIOS: Mapping[str, tuple[Errors, bool]] = MappingProxyType(
    {
        "independent noise": (INDEPENDENT, False),
        "noise, shading and blur": (Errors(), False),
        "independent noise, calibration": (INDEPENDENT, True),
        "all of them": (Errors(), True),
    }
)
_LABELS = ("tip x", "tip y", "tip z", "bending", "orientation", "length")


def run(context: Context) -> StudyResult:
    """Draw edges for many poses and compare errors with the bound and with the deviations that the fit states."""
    orientations = np.arange(0.0, 360.0, 90.0 if context.quick else 30.0).tolist()
    draws = 8 if context.quick else 25
    poses = [(b, o) for b in _BENDING_DEG for o in orientations]
    trials = {
        name: [Trial(90.0, b, o, errors, calibrated, (_METHOD,), draws, context.seed_of(name, b, o)) for b, o in poses]
        for name, (errors, calibrated) in _SCENARIOS.items()
    }
    found = {name: _all(context, tasks) for name, tasks in trials.items()}
    searched = _all(context, _search(context))
    straight = _all(context, _towards_straight(context))
    rows = [{"scenario": name} | row for name, own in found.items() for row in own]
    configuration = {"bending_deg": _BENDING_DEG, "orientations_deg": orientations, "draws": draws}
    data = (
        context.write_data("uncertainty", rows, configuration),
        context.write_data("uncertainty_failures", searched, {"angles_deg": _FAILURE_ANGLES_DEG}),
        context.write_data("uncertainty_straight", straight, {"bending_deg": _STRAIGHT_DEG}),
    )
    ratios = {name: _ratios(own) for name, own in found.items()}
    coverage = {name: _coverage(own) for name, own in found.items()}
    return StudyResult(
        "Uncertainty: bound, stated deviations, failures, and the straight limit",
        (
            _INTRODUCTION,
            _bound_text(ratios),
            _coverage_text(coverage),
            _failure_text(searched),
            _straight_text(straight),
        ),
        (
            context.write_figure("uncertainty_bound", _bound_figure(ratios, coverage), _BOUND_CAPTION),
            context.write_figure("uncertainty_straight", _straight_figure(straight), _STRAIGHT_CAPTION),
        ),
        (
            _table(ratios, "Root mean square errors over the predicted deviations (1: as good as the edges allow).", 2),
            _table(coverage, "Share of errors within two stated deviations, percent (normal: 95.4).", 1),
        ),
        {},
        data,
    )


_INTRODUCTION = (
    "Edges of a tube are drawn with known errors, without pictures, and given to the fit: 24 a side and 16 on the "
    "tip in "
    "each of two cameras 90 degrees apart, as many as it uses of a photograph. Independent noise is 0.06 px; shading "
    "moves and tilts rows by 0.05 px, blur all edges by 0.1 px; the clamp errs by 0.03 mm and 0.03 degrees in all of "
    "them."
)


def _all(context: Context, tasks: Sequence[Trial]) -> list[Row]:
    return [row for rows in context.map(tried, tasks) for row in rows]


def _search(context: Context) -> list[Trial]:
    """Every bending from 0 to 90 degrees, every orientation, every angle of the cameras, all errors."""
    bendings = np.arange(0.0, 91.0, 30.0 if context.quick else 10.0).tolist()
    orientations = np.arange(0.0, 360.0, 60.0 if context.quick else 15.0).tolist()
    return [
        Trial(a, b, o, Errors(), False, (_METHOD,), 1, context.seed_of("search", a, b, o))
        for a in _FAILURE_ANGLES_DEG
        for b in bendings
        for o in orientations
    ]


def _towards_straight(context: Context) -> list[Trial]:
    """One and the same draw of the edges' errors, in an exact clamp, for less and less bending."""
    seed, errors = context.seed_of("straight"), Errors(clamp_mm=1e-6, clamp_rad=1e-8)
    return [Trial(90.0, b, _STRAIGHT_PHI_DEG, errors, False, (_METHOD,), 1, seed) for b in _STRAIGHT_DEG]


def _ratios(rows: Sequence[Row]) -> list[float]:
    """Root mean square of errors over predicted deviations, by quantity."""
    return [rms(column(rows, f"{q}_error") / column(rows, f"predicted_{q}")) for q in QUANTITIES]


def _coverage(rows: Sequence[Row]) -> list[float]:
    """Percent of errors within two stated deviations, by quantity."""
    made = []
    for q in QUANTITIES:
        off, sd = column(rows, f"{q}_error"), column(rows, f"{q}_sd")
        known = np.isfinite(off) & np.isfinite(sd)
        made.append(float(100 * np.mean(np.abs(off[known]) <= 2 * sd[known])) if known.any() else float("nan"))
    return made


def _table(values: Mapping[str, Sequence[float]], caption: str, digits: int) -> Table:
    rows = tuple((name, *(f"{v:.{digits}f}" for v in own)) for name, own in values.items())
    return Table(caption, ("", *_LABELS), rows)


def _bound_text(ratios: Mapping[str, Sequence[float]]) -> str:
    own = ratios["independent noise"]
    within = [label for label, ratio in zip(_LABELS, own, strict=True) if ratio <= 1.3]
    beyond = [f"{label} {ratio:.2f}" for label, ratio in zip(_LABELS, own, strict=True) if ratio > 1.3]
    end = f"; beyond it: {', '.join(beyond)}" if beyond else ""
    return (
        f"With independent noise the fit's errors are {min(own):.2f} to {max(own):.2f} times the Cramer-Rao bound: "
        f"within "
        f"1.3 of it are {', '.join(within) or 'none'}{end}. The bound knows that nothing else errs; the fit does "
        f"not, and "
        "gives away what shading and blur would have spoilt. With the errors that it expects the ratio is "
        f"{min(ratios['noise, shading and blur']):.2f} to {max(ratios['noise, shading and blur']):.2f}."
    )


def _coverage_text(coverage: Mapping[str, Sequence[float]]) -> str:
    parts = [f"{name}: {min(own):.1f} to {max(own):.1f} %" for name, own in coverage.items()]
    return (
        f"Two stated deviations cover, by quantity, {'; '.join(parts)}. Normal errors with exact deviations would give "
        "95.4 %; more means that the deviations are stated too large, which errs on the safe side."
    )


def _failure_text(rows: Sequence[Row]) -> str:
    bad = [row for row in rows if row["status"] != "ok"]
    worst = max(rows, key=lambda row: row["tip_mm_error"] or 0.0)
    text = (
        f"{len(bad)} of {len(rows)} poses failed, with bendings from 0 to 90 degrees, orientations all around and "
        f"cameras "
        f"{min(_FAILURE_ANGLES_DEG):.0f} to {max(_FAILURE_ANGLES_DEG):.0f} degrees apart. The largest error of the "
        f"tip is "
        f"{worst['tip_mm_error']:.3f} mm (cameras {worst['angle_deg']:.0f} degrees apart, bending "
        f"{worst['true_bending_deg']:.0f}, orientation {worst['true_orientation_deg']:.0f} degrees)."
    )
    listed = "; ".join(
        f"{row['angle_deg']:.0f}, {row['true_bending_deg']:.0f}, {row['true_orientation_deg']:.0f} ({row['status']})"
        for row in bad[:6]
    )
    return text + (f" Failed (angle, bending, orientation): {listed}." if bad else "")


def _steps_mm(rows: Sequence[Row]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """How far the tip's error moves from one bending to the next, by axis: the largest of the three."""
    off = np.stack([column(rows, f"{q}_error") for q in QUANTITIES[:3]], 1)
    return np.asarray(np.abs(np.diff(off, axis=0)).max(1))


def _straight_text(rows: Sequence[Row]) -> str:
    turned = column(rows, "orientation_deg_error")
    known = np.isfinite(turned)
    least = min((r["true_bending_deg"] for r, k in zip(rows, known, strict=True) if k), default=float("nan"))
    most = max((r["true_bending_deg"] for r, k in zip(rows, known, strict=True) if not k), default=float("nan"))
    return (
        f"From 5 degrees of bending to none, in steps of 0.1 and with one and the same errors, the tip's error "
        f"changes by "
        f"{1e3 * _steps_mm(rows).max():.2f} um at most from step to step. The orientation is given down to {least:.1f} "
        f"degrees, "
        f"with errors of up to {np.nanmax(np.abs(turned)):.1f} degrees, and is undefined from {most:.1f} degrees on."
    )


_BOUND_CAPTION = (
    "Left: root mean square errors of the fit over the deviations predicted from the edges' errors; 1 is as good as "
    "possible, dashed: 1.3. Right: share of errors within two deviations as the fit states them; gray: 93 to 97 %."
)
_STRAIGHT_CAPTION = (
    "A tube that becomes straight, always with the same errors: error of the tip, and the orientation where it is "
    f"given. Its true value is {_STRAIGHT_PHI_DEG:.0f} degrees; where the tip lies on the axis within three "
    "deviations there is none."
)


def _bound_figure(ratios: Mapping[str, Sequence[float]], coverage: Mapping[str, Sequence[float]]) -> Drawing:
    made, axes = drawing.panels(1, 2, (9.0, 3.6))
    colours = ("#009E73", "#0072B2", "#E69F00", "#CC79A7")
    left, right = axes[0]
    for panel, values in ((left, ratios), (right, coverage)):
        for k, ((name, own), colour) in enumerate(zip(values.items(), colours, strict=True)):
            panel.plot(np.arange(6) + 0.12 * (k - 1.5), own, "os^D"[k], color=colour, label=name, markersize=5)
        panel.set_xticks(range(6), _LABELS, rotation=25)
    left.axhline(1.3, color="#555555", linestyle="--", linewidth=1)
    left.axhline(1.0, color="#555555", linewidth=0.8)
    left.set_ylim(0, max(1.6, 1.1 * max(max(own) for own in ratios.values())))
    left.set_ylabel("error over predicted deviation")
    right.axhspan(93, 97, color="#e6e6e6", zorder=0)
    right.set_ylabel("within two stated deviations [%]")
    right.set_ylim(min(88.0, min(min(own) for own in coverage.values()) - 2), 100.5)
    drawing.legend_below(made, left, columns=4)
    return made


def _straight_figure(rows: Sequence[Row]) -> Drawing:
    made, axes = drawing.panels(1, 2, (9.0, 3.2))
    left, right = axes[0]
    bending = column(rows, "true_bending_deg")
    for axis, colour in zip("xyz", drawing.shades(3), strict=True):
        left.plot(bending, 1e3 * column(rows, f"tip_{axis}_mm_error"), color=colour, label=f"tip {axis}")
    left.set(xlabel="bending [deg]", ylabel="error of the tip [um]")
    left.legend(loc="best")
    turned, sd = column(rows, "orientation_deg_error"), column(rows, "orientation_deg_sd")
    known = np.isfinite(turned)
    right.errorbar(
        bending[known], _STRAIGHT_PHI_DEG + turned[known], 2 * sd[known], fmt="o", color="#009E73", elinewidth=0.8
    )
    right.axhline(_STRAIGHT_PHI_DEG, color="#555555", linewidth=0.8)
    if (~known).any():
        right.axvspan(-0.1, bending[~known].max() + 0.05, color="#e6e6e6", zorder=0, label="not defined")
        right.legend(loc="upper right")
    right.set(xlabel="bending [deg]", ylabel="orientation, two deviations [deg]")
    return made
