"""What each thing that can be wrong in a session costs, and whether lens distortion makes errors grow with bending."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from math import nan
from typing import TYPE_CHECKING, Any

from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.cases import ADVICE, Case, cases
from tubesight.apps.reproduce.distortion import distortion_study
from tubesight.apps.reproduce.disturbed import Disturbed, Look, Told, measured_disturbed
from tubesight.apps.reproduce.mockup import ELLIPSE_DEG, ELLIPSE_RATIO, PAPER_MAX_DEG, PAPER_MAX_MM
from tubesight.apps.reproduce.session import PlainRig, Session, calibrated
from tubesight.apps.reproduce.shots import ERRORS, METHODS, Row, statistics
from tubesight.apps.reproduce.study import Context, StudyResult, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

# Bending, ratio and orientations of the poses that every case is measured at.
_POSES = (
    *((30.0, 1.0, phi) for phi in (60.0, 150.0, 240.0, 330.0)),
    *((70.0, 1.0, phi) for phi in (30.0, 120.0, 210.0, 300.0)),
    *((ELLIPSE_DEG, ELLIPSE_RATIO, phi) for phi in (15.0, 105.0, 195.0, 285.0)),
)
_QUICK_POSES = _POSES[::3]
# Calibrations of one kind that differ in the board's poses.
_CALIBRATIONS, _QUICK_CALIBRATIONS = 3, 1


def run(context: Context) -> StudyResult:
    """Measure every case, make the table, and test the paper's guess on distortion."""
    chosen = [case for case in cases(context.seed) if case.quick or not context.quick]
    rows = _measure(context, chosen)
    poses = [dict(zip(("bending_deg", "ratio", "orientation_deg"), pose, strict=True)) for pose in _poses(context)]
    described = [asdict(case) for case in chosen]
    data = context.write_data("sensitivity", rows, {"poses": poses, "cases": described})
    entries = {
        case: {m: statistics([r for r in rows if _is(r, case) and r["method"] == m]) for m in METHODS}
        for case in chosen
    }
    summary = {f"{m}/{_name(case)}": entry for case, by in entries.items() for m, entry in by.items()}
    figure = context.write_figure(
        "sensitivity",
        _dots(entries),
        "Largest errors with one thing wrong at a time; crosses: a method refused some poses.",
    )
    text = (
        f"One thing at a time is wrong, everything else is as in the experiments, over {len(poses)} poses; the rig is "
        "the true one except where its calibration is what varies. The table says what each costs the method "
        "silhouette and what to do; the data have all methods."
    )
    bending = distortion_study(context)
    return StudyResult(
        "Sensitivity: what accuracy to expect",
        (text, *bending.paragraphs),
        (figure, *bending.figures),
        (_table(entries), *bending.tables),
        summary,
        (data, *bending.data),
    )


def _poses(context: Context) -> Sequence[tuple[float, float, float]]:
    return _QUICK_POSES if context.quick else _POSES


def _is(row: Row, case: Case) -> bool:
    return bool(row["cause"] == case.cause and row["level"] == case.level)


def _name(case: Case) -> str:
    return f"{case.cause} {case.level}".strip()


def _measure(context: Context, chosen: Sequence[Case]) -> list[Row]:
    """Rows of all cases: every pose, method and calibration."""
    repeats = _QUICK_CALIBRATIONS if context.quick else _CALIBRATIONS
    sessions = [
        (case, replace(case.session, seed=case.session.seed + repeat))
        for case in chosen
        if case.session is not None
        for repeat in range(repeats)
    ]
    made = context.map(calibrated, [session for _, session in sessions])
    # Cases with what the methods are told in each; a calibration that was refused tells nothing.
    told = [(case, Told(diameter_error_mm=case.diameter_error_mm)) for case in chosen if case.session is None]
    refused: list[Row] = []
    for (case, session), result in zip(sessions, made, strict=True):
        if result["refused"]:
            refused += [_refused(case, session, pose, m) for pose in _poses(context) for m in METHODS]
        else:
            told.append((case, Told(PlainRig.from_plain(result["cameras"]), case.diameter_error_mm)))
    return _photographed(context, told) + refused


def _photographed(context: Context, told: Sequence[tuple[Case, Told]]) -> list[Row]:
    """Rows of all poses; cases whose photographs look the same share them."""
    alike: dict[Look, list[int]] = {}
    for index, (case, _) in enumerate(told):
        alike.setdefault(case.look, []).append(index)
    shots = [
        (indices, pose, Disturbed(look, *pose, context.seed_of(*pose), tuple(told[k][1] for k in indices)))
        for look, indices in alike.items()
        for pose in _poses(context)
    ]
    results = context.map(measured_disturbed, [shot for _, _, shot in shots])
    found = {
        (k, pose): rows
        for (indices, pose, _), by_told in zip(shots, results, strict=True)
        for k, rows in zip(indices, by_told, strict=True)
    }
    return [
        {**_about(case, pose), **row}
        for k, (case, _) in enumerate(told)
        for pose in _poses(context)
        for row in found[k, pose]
    ]


def _about(case: Case, pose: tuple[float, float, float]) -> Row:
    return {
        "cause": case.cause,
        "level": case.level,
        "true_bending_deg": pose[0],
        "ratio": pose[1],
        "true_orientation_deg": pose[2],
    }


def _refused(case: Case, session: Session, pose: tuple[float, float, float], method: str) -> Row:
    """Row of a shape that cannot be measured because there is no rig."""
    values = dict.fromkeys(("tip_x_mm", "tip_y_mm", "tip_z_mm", *ERRORS), nan)
    return {**_about(case, pose), "method": method, "status": "calibration_refused", **values}


def _table(entries: Mapping[Case, Mapping[str, Mapping[str, float]]]) -> Table:
    heading = ("what is wrong", "how much", "tip [mm]", "bending [deg]", "length [mm]", "failed", "what to do")
    rows = []
    for case, by_method in entries.items():
        entry = by_method["silhouette"]
        errors = (
            f"{entry[f'{q}_mean_{u}']:.3f}, {entry[f'{q}_max_{u}']:.3f}"
            for q, u in (("tip", "mm"), ("bending", "deg"), ("length", "mm"))
        )
        failed = f"{entry['failures']:.0f} of {entry['n']:.0f}" if entry["failures"] else "-"
        rows.append((case.cause, case.level, *errors, failed, ADVICE[case.cause]))
    return Table("Method silhouette: mean, largest absolute error.", heading, tuple(rows))


def _dots(entries: Mapping[Case, Mapping[str, Mapping[str, float]]]) -> Drawing:
    """Largest errors by case, tip and bending side by side; crosses at the right edge where poses were refused."""
    made, axes = drawing.panels(1, 2, (10.0, 2.2 + 0.24 * len(entries)), sharey=True)
    names = [_name(case) for case in entries]
    quantities = (("tip_max_mm", "tip", "mm", PAPER_MAX_MM), ("bending_max_deg", "bending", "deg", PAPER_MAX_DEG))
    for panel, (key, label, unit, paper) in zip(axes[0], quantities, strict=True):
        for index, method in enumerate(METHODS):
            look: dict[str, Any] = {"linestyle": "", "color": drawing.COLOURS[method], "markersize": 5}
            found = [by[method] for by in entries.values()]
            panel.plot([e[key] for e in found], names, marker=drawing.MARKERS[method], label=method, **look)
            refused = [name for name, e in zip(names, found, strict=True) if e["failures"]]
            if refused:
                look |= {"marker": "x", "clip_on": False, "transform": panel.get_yaxis_transform()}
                edge = [1.015 + 0.025 * index] * len(refused)
                panel.plot(edge, refused, label=f"{method}: poses refused", **look)
        panel.axvline(paper, color=drawing.COLOURS["paper"], linestyle="--", linewidth=1, label="largest in the paper")
        panel.set_xscale("log")
        panel.set_xlabel(f"largest error of {label} [{unit}]")
    axes[0][0].invert_yaxis()
    drawing.legend_below(made, axes[0][0], columns=4)
    return made
