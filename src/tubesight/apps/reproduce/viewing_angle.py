"""The angle between the cameras and the direction of the tube, which the paper leaves open (section 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from tubesight.apps.planning.information import Errors
from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.cone_choice import OFF_MM, RULES, Choices, chosen
from tubesight.apps.reproduce.edge_trials import Row, Trial, column, rms, tried
from tubesight.apps.reproduce.experiment import of
from tubesight.apps.reproduce.mockup import LENGTH_MM, TUBE, photograph
from tubesight.apps.reproduce.shots import METHODS
from tubesight.apps.reproduce.study import Context, StudyResult, Table
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Scene, rig_around
from tubesight.simulate.phantom import Arc

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

# From the base lines of stereo endoscopes to cameras that nearly face each other.
_RULE_ANGLES_DEG = (10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 135.0, 150.0, 160.0, 170.0)
_ANGLES_DEG = (2.0, 4.0, 6.0, 8.0, *_RULE_ANGLES_DEG)
_BENDING_DEG = (10.0, 30.0, 50.0, 70.0, 90.0)
# Noise of centrelines between sub-pixel edges, and of those found on whole pixels.
_RULE_NOISE_PX = (0.1, 1.0)
# Bendings at which the direction of the tube is turned all around.
_TURNED_DEG = (30.0, 60.0, 90.0)
# Rendered checks: angles, and poses at each.
_RENDERED_ANGLES_DEG = (10.0, 30.0, 60.0, 120.0, 150.0)
_RENDERED_POSES_DEG = ((30.0, 40.0), (50.0, 160.0), (70.0, 280.0))
_TIPS = ("tip_x_mm", "tip_y_mm", "tip_z_mm")
# Errors of the tip above this count as wrong, whatever the status says.
_WRONG_MM = 2.0


@dataclass(frozen=True, slots=True)
class Photograph:
    """One photograph at an angle of the cameras; the task of `photographed`."""

    angle_deg: float
    bending_deg: float
    orientation_deg: float
    seed: int


def photographed(task: Photograph) -> list[Row]:
    """Render a pair and measure it by every method: a row each with status and error of the tip."""
    rig = rig_around(task.angle_deg)
    phantom = Arc(float(np.radians(task.bending_deg)), float(np.radians(task.orientation_deg)), LENGTH_MM)
    pair = photograph(rig, phantom, Scene(seed=task.seed), "")
    rows = []
    for method in METHODS:
        result = ShapeSensor(rig, TUBE, method)(pair)
        off = np.nan
        if result.shape is not None:
            off = float(np.linalg.norm(result.shape.tip_mm - phantom.at(phantom.length_mm)))
        about = {"angle_deg": task.angle_deg, "bending_deg": task.bending_deg, "orientation_deg": task.orientation_deg}
        rows.append(about | {"method": method, "status": str(result.status), "tip_mm_error": off})
    return rows


def run(context: Context) -> StudyResult:
    """Sweep the angle and the direction on drawn edges, compare the rules for the cone, and check on photographs."""
    quick = context.quick
    orientations = np.arange(0.0, 360.0, 60.0 if quick else 30.0).tolist()
    poses = [(a, b, o) for a in _ANGLES_DEG for b in _BENDING_DEG for o in orientations]
    swept = _tried(context, poses, 1 if quick else 4)
    directions = np.arange(0.0, 360.0, 30.0 if quick else 10.0).tolist()
    turned = _tried(context, [(90.0, b, o) for b in _TURNED_DEG for o in directions], 4 if quick else 20)
    around = tuple(np.arange(0.0, 360.0, 30.0 if quick else 10.0).tolist())
    choices = [
        Choices(a, b, noise, around, context.seed_of(a, b, noise))
        for a in _RULE_ANGLES_DEG
        for b in _BENDING_DEG
        for noise in _RULE_NOISE_PX
    ]
    rules = [row for rows in context.map(chosen, choices) for row in rows]
    shown = _RENDERED_POSES_DEG[:1] if quick else _RENDERED_POSES_DEG
    photographs = [
        Photograph(a, b, o, context.seed_of("photograph", a, b, o)) for a in _RENDERED_ANGLES_DEG for b, o in shown
    ]
    rendered = [row for rows in context.map(photographed, photographs) for row in rows]
    configuration = {"bending_deg": _BENDING_DEG, "orientations_deg": orientations, "length_mm": LENGTH_MM}
    data = (
        context.write_data("viewing_angle", swept, configuration),
        context.write_data("viewing_angle_direction", turned, {"bending_deg": _TURNED_DEG}),
        context.write_data("viewing_angle_rules", rules, {"bending_deg": _BENDING_DEG}),
        context.write_data("viewing_angle_photographs", rendered, {"poses_deg": shown}),
    )
    figures = (
        context.write_figure("viewing_angle", _angle_figure(swept, rendered), _ANGLE_CAPTION),
        context.write_figure("viewing_angle_direction", _direction_figure(turned), _DIRECTION_CAPTION),
        context.write_figure("viewing_angle_rules", _rules_figure(rules), _RULES_CAPTION),
    )
    return StudyResult(
        "Viewing angle: the angle between the cameras and the direction of the tube",
        (
            _INTRODUCTION,
            _angle_text(swept),
            _prediction_text(swept, turned),
            _rules_text(rules),
            _rendered_text(rendered),
        ),
        figures,
        (_angle_table(swept),),
        _summary(swept),
        data,
    )


_INTRODUCTION = (
    "Cameras stand 310 mm from the middle of a tube of 160 mm and look at it horizontally, at angles from the base "
    "line of "
    "a stereo endoscope (2 degrees) to nearly opposite (170). Edges are drawn with noise, shading and blur as "
    "photographs "
    "have them, and each method solves from the same edges; the calibration is exact. The predicted line comes from "
    "the "
    "information in the edges alone, the same with which tubesight plan works."
)


def _tried(context: Context, poses: Sequence[tuple[float, float, float]], draws: int) -> list[Row]:
    tasks = [Trial(a, b, o, Errors(), False, METHODS, draws, context.seed_of(a, b, o)) for a, b, o in poses]
    return [row for rows in context.map(tried, tasks) for row in rows]


def _failed(rows: Sequence[Row]) -> int:
    """Rows without a result, or with a wrong one."""
    return sum(row["status"] != "ok" or not row["tip_mm_error"] <= _WRONG_MM for row in rows)


def _tip_rms(rows: Sequence[Row]) -> float:
    """Root mean square of x, y and z together, of rows that did not fail."""
    off = column([row for row in rows if row["status"] == "ok"], "tip_mm_error")
    return rms(off[off <= _WRONG_MM])


def _angle_table(rows: Sequence[Row]) -> Table:
    made = []
    for angle in _ANGLES_DEG:
        own = of(rows, angle_deg=angle)
        cells = [f"{_tip_rms(of(own, method=m)):.3f}, {_failed(of(own, method=m))}" for m in METHODS]
        made.append((f"{angle:.0f}", f"{rms(column(own, 'predicted_tip_mm')):.3f}", *cells))
    n = len(of(rows, angle_deg=_ANGLES_DEG[0], method=METHODS[0]))
    caption = (
        f"Root mean square error of the tip in mm, and how many of {n} trials failed or were wrong by over "
        f"{_WRONG_MM:.0f} mm."
    )
    return Table(caption, ("angle [deg]", "predicted [mm]", *METHODS), tuple(made))


def _summary(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Errors of all angles from 20 to 160 degrees together."""
    made = {}
    for method in METHODS:
        own = [row for row in of(rows, method=method) if 20 <= row["angle_deg"] <= 160]
        good = [row for row in own if row["status"] == "ok"]
        entry: dict[str, float] = {}
        for name, keys, unit in (
            ("tip", _TIPS, "mm"),
            ("bending", ("bending_deg",), "deg"),
            ("orientation", ("orientation_deg",), "deg"),
            ("length", ("length_mm",), "mm"),
        ):
            values = np.abs(np.concatenate([column(good, f"{key}_error") for key in keys]))
            entry |= {f"{name}_max_{unit}": float(np.nanmax(values)), f"{name}_mean_{unit}": float(np.nanmean(values))}
        made[method] = entry | {"failures": len(own) - len(good), "n": len(own)}
    return made


def _angle_text(rows: Sequence[Row]) -> str:
    own = {a: _tip_rms(of(rows, angle_deg=a, method="silhouette")) for a in _ANGLES_DEG}
    best = min(own, key=lambda a: own[a])
    flat = [a for a in _ANGLES_DEG if own[a] <= 1.5 * own[best]]
    lost = {m: _failed([r for r in of(rows, method=m) if 20 <= r["angle_deg"] <= 160]) for m in METHODS}
    n = len([r for r in of(rows, method=METHODS[0]) if 20 <= r["angle_deg"] <= 160])
    return (
        f"The fit's tip is best at {best:.0f} degrees ({1e3 * own[best]:.0f} um) and within 1.5 of that from "
        f"{min(flat):.0f} to {max(flat):.0f} degrees; at 10 degrees it is {1e3 * own[10.0]:.0f} um, "
        f"at 2 degrees {1e3 * own[2.0]:.0f} um. "
        "Between 20 and 160 degrees "
        + ", ".join(f"{m} fails or is wrong in {k} of {n} trials" for m, k in lost.items())
        + "."
    )


def _prediction_text(swept: Sequence[Row], turned: Sequence[Row]) -> str:
    parts = []
    for name, rows in (("angle", swept), ("direction", turned)):
        own = of(rows, method="silhouette")
        keys = sorted({row["angle_deg"] if name == "angle" else row["true_orientation_deg"] for row in own})
        ratios = [
            _tip_rms(group) / rms(column(group, "predicted_tip_mm"))
            for key in keys
            for group in [[r for r in own if key == (r["angle_deg"] if name == "angle" else r["true_orientation_deg"])]]
        ]
        parts.append(f"{min(ratios):.2f} to {max(ratios):.2f} by {name}")
    return f"The fit's errors are {' and '.join(parts)} times the predicted ones."


def _shares(rows: Sequence[Row], angle: float, noise: float) -> dict[tuple[str, str], float]:
    """Percent of the poses that fail at an angle, by pair of rules."""
    made = {}
    for camera, root in RULES:
        own = of(rows, angle_deg=angle, noise_px=noise, camera=camera, root=root)
        made[camera, root] = 100 * sum(r["failures"] for r in own) / sum(r["n"] for r in own)
    return made


def _off_mm(rows: Sequence[Row], angle: float, noise: float, rule: tuple[str, str]) -> float:
    """Distance from the true curve that nine points of ten keep: median over poses, mean over bendings."""
    own = of(rows, angle_deg=angle, noise_px=noise, camera=rule[0], root=rule[1])
    return float(np.mean(column(own, "off_median_mm")))


def _rules_text(rows: Sequence[Row]) -> str:
    parts = []
    for noise in _RULE_NOISE_PX:
        mean = {rule: float(np.mean([_shares(rows, a, noise)[rule] for a in _RULE_ANGLES_DEG])) for rule in RULES}
        worst = [
            max(_off_mm(rows, a, noise, (camera, "order")) for a in _RULE_ANGLES_DEG)
            for camera in ("curvature", "crossing")
        ]
        parts.append(
            f"With {noise:g} px of noise {mean['curvature', 'equation 10']:.1f} % of the poses of all angles fail by "
            f"the "
            f"paper's rules, {mean['crossing', 'equation 10']:.1f} % with the other camera alone, "
            f"{mean['curvature', 'order']:.1f} % with the other root alone and {mean['crossing', 'order']:.1f} % "
            f"with both; "
            f"at the worst angle nine points of ten lie within {worst[0]:.1f} mm of the curve by the more curved "
            f"view and "
            f"{worst[1]:.1f} mm by the other (roots in order)."
        )
    return (
        "In the paper the more curved view makes the cone and equation 10 takes the root; in cone_ray the view makes "
        "it whose curve the other's rays cross most squarely, and the roots run along that curve in order. "
        + " ".join(parts)
    )


def _rendered_text(rows: Sequence[Row]) -> str:
    own = of(rows, method="silhouette")
    off = column(own, "tip_mm_error")
    failed = {m: sum(r["status"] != "ok" for r in of(rows, method=m)) for m in METHODS}
    return (
        f"Of {len(own)} rendered pairs at {len(_RENDERED_ANGLES_DEG)} angles the fit's tip is off by "
        f"{np.nanmean(off):.3f} mm "
        f"in the mean and {np.nanmax(off):.3f} mm at most; refused: "
        + ", ".join(f"{m} {k}" for m, k in failed.items())
        + "."
    )


_ANGLE_CAPTION = (
    "Left: error of the tip by the angle between the cameras: drawn edges (lines), rendered photographs (crosses), "
    "and the "
    f"prediction (dashed). Right: trials without a result or wrong by more than {_WRONG_MM:.0f} mm."
)
_DIRECTION_CAPTION = (
    "Error of the tip by the direction to which the tube bends, cameras at 0 and 90 degrees: Monte Carlo (markers) and "
    "prediction (lines). A tube that points away from both cameras is far from them and seen end on."
)
_RULES_CAPTION = (
    "Poses that fail, by the camera that makes the cone and the choice of the root, by the noise of the centrelines. "
    f"A pose fails where over a tenth of its points are more than {OFF_MM:.0f} mm off. "
    "Below: median over the poses of the distance from the true curve within which nine points of ten lie."
)


def _angle_figure(rows: Sequence[Row], rendered: Sequence[Row]) -> Drawing:
    made, axes = drawing.panels(1, 2, (9.0, 3.8), sharex=True)
    left, right = axes[0]
    for method in METHODS:
        colour, marker = drawing.COLOURS[method], drawing.MARKERS[method]
        groups = [of(rows, angle_deg=a, method=method) for a in _ANGLES_DEG]
        left.plot(_ANGLES_DEG, [_tip_rms(g) for g in groups], color=colour, marker=marker, label=method)
        right.plot(_ANGLES_DEG, [100 * _failed(g) / len(g) for g in groups], color=colour, marker=marker)
        shown = of(rendered, method=method)
        left.plot(column(shown, "angle_deg"), column(shown, "tip_mm_error"), "x", color=colour)
    predicted = [rms(column(of(rows, angle_deg=a), "predicted_tip_mm")) for a in _ANGLES_DEG]
    left.plot(_ANGLES_DEG, predicted, color="black", linestyle="--", label="predicted for silhouette")
    drawing.decimal_log(left)
    left.set(ylabel="error of the tip, rms [mm]", xlabel="angle between the cameras [deg]")
    right.set(ylabel="failed or wrong [%]", xlabel="angle between the cameras [deg]")
    right.set_xticks(range(0, 181, 30))
    drawing.legend_below(made, left, columns=4)
    return made


def _direction_figure(rows: Sequence[Row]) -> Drawing:
    made, axes = drawing.panels(1, 1, (7.0, 3.6))
    panel = axes[0][0]
    for bending, colour, marker in zip(_TURNED_DEG, drawing.shades(len(_TURNED_DEG)), "os^", strict=False):
        own = of(rows, true_bending_deg=bending, method="silhouette")
        directions = sorted({row["true_orientation_deg"] for row in own})
        groups = [of(own, true_orientation_deg=d) for d in directions]
        panel.plot(directions, [_tip_rms(g) for g in groups], marker, color=colour, label=f"{bending:.0f} degrees")
        panel.plot(directions, [rms(column(g, "predicted_tip_mm")) for g in groups], color=colour)
    panel.set(xlabel="orientation of the tube [deg]", ylabel="error of the tip, rms [mm]")
    panel.set_ylim(0)
    drawing.orientation_axis(panel)
    drawing.legend_below(made, panel, columns=3, title="bending")
    return made


_RULE_STYLES: Mapping[tuple[str, str], tuple[str, str, str]] = MappingProxyType(
    {
        ("curvature", "equation 10"): ("#D55E00", "s", "more curved view, equation 10 (paper)"),
        ("crossing", "equation 10"): ("#E69F00", "v", "squarely crossed view, equation 10"),
        ("curvature", "order"): ("#56B4E9", "D", "more curved view, roots in order"),
        ("crossing", "order"): ("#0072B2", "^", "squarely crossed view, roots in order (cone_ray)"),
    }
)


def _rules_figure(rows: Sequence[Row]) -> Drawing:
    made, axes = drawing.panels(2, 2, (9.0, 6.2), sharex=True, sharey="row")
    for column_of, noise in enumerate(_RULE_NOISE_PX):
        failed, off = axes[0][column_of], axes[1][column_of]
        for rule in RULES:
            colour, marker, label = _RULE_STYLES[rule]
            shares = [_shares(rows, a, noise)[rule] for a in _RULE_ANGLES_DEG]
            failed.plot(_RULE_ANGLES_DEG, shares, color=colour, marker=marker, label=label)
            far = [_off_mm(rows, a, noise, rule) for a in _RULE_ANGLES_DEG]
            off.plot(_RULE_ANGLES_DEG, far, color=colour, marker=marker)
        failed.set_title(f"{noise:g} px of noise")
        drawing.decimal_log(off)
        off.set_xlabel("angle between the cameras [deg]")
        off.set_xticks(range(0, 181, 30))
    axes[0][0].set_ylabel("poses that fail [%]")
    axes[0][0].set_ylim(0)
    axes[1][0].set_ylabel("nine points of ten within [mm]")
    drawing.legend_below(made, axes[0][0], columns=2)
    return made
