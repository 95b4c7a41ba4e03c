"""What experiments 1 and 2 have in common: tubes, poses, calibration, and the errors of all methods."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from tubesight.apps.reproduce.mockup import (
    ELLIPSE_DEG,
    ELLIPSE_RATIO,
    LENGTH_MM,
    PAPER_MAX_DEG,
    PAPER_MAX_MM,
    PAPER_MEAN_DEG,
    PAPER_MEAN_MM,
    TUBE,
    true_rig,
)
from tubesight.apps.reproduce.session import PlainRig, Session, calibrated
from tubesight.apps.reproduce.shots import METHODS, Row, Shot, measured, statistics
from tubesight.apps.reproduce.study import Context, Table
from tubesight.core import InputError

CALIBRATED, TRUE = "calibrated", "true"


@dataclass(frozen=True, slots=True)
class Mockup:
    """A tube of the paper: its name, bending and ratio of axes."""

    name: str
    bending_deg: float
    ratio: float = 1.0


ELLIPTIC = Mockup("elliptic 40", ELLIPSE_DEG, ELLIPSE_RATIO)


def circular(bending_deg: Iterable[int]) -> list[Mockup]:
    """Circular tubes."""
    return [Mockup(f"circular {bending}", bending) for bending in bending_deg]


def photograph_and_measure(
    context: Context, tubes: Sequence[Mockup], orientations_deg: Sequence[float]
) -> tuple[list[Row], Mapping[str, Any]]:
    """Calibrate, then measure every tube at every orientation with the calibrated and with the true rig.

    Returns
    -------
    rows, configuration
        Of `measured`, and what they were made with.

    Raises
    ------
    InputError
        If the rendered pictures of the board give no calibration: with another seed they do.
    """
    # Both experiments share one calibration, as in the paper.
    session = Session(seed=context.seed)
    made = context.map(calibrated, [session])[0]
    if made["refused"]:
        raise InputError(f"seed {context.seed}: the rendered boards give no calibration ({made['refused']}); change it")
    true = PlainRig.of(true_rig())
    rigs = ((CALIBRATED, PlainRig.from_plain(made["cameras"])), (TRUE, true))
    shots = [
        Shot(t.name, t.bending_deg, t.ratio, phi, true, rigs, context.seed_of(t.name, phi))
        for t in tubes
        for phi in orientations_deg
    ]
    rows = [row for rows in context.map(measured, shots) for row in rows]
    configuration = {
        "tube": asdict(TUBE),
        "length_mm": LENGTH_MM,
        "ellipse_ratio": ELLIPSE_RATIO,
        "true_rig": asdict(true)["cameras"],
        "calibration": asdict(session) | {"rms_px": made["rms_px"]},
        "calibrated_rig": made["cameras"],
    }
    return rows, configuration


def of(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """Rows whose cells have the values wanted."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def summary_of(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Entry of ``summary.json``: methods with the calibrated rig, then ``METHOD/true_rig``."""
    return {
        method + suffix: statistics(of(rows, method=method, rig=rig))
        for rig, suffix in ((CALIBRATED, ""), (TRUE, "/true_rig"))
        for method in METHODS
    }


def error_table(summary: Mapping[str, Mapping[str, float]], caption: str) -> Table:
    """Mean and largest errors by method, beside the paper's."""
    heading = ("", "tip [mm]", "bending [deg]", "orientation [deg]", "length [mm]", "failed", "of")
    quantities = ("tip_{}_mm", "bending_{}_deg", "orientation_{}_deg", "length_{}_mm")
    rows = [
        (
            name.replace("/true_rig", ", true rig"),
            *(f"{entry[q.format('mean')]:.3f}, {entry[q.format('max')]:.3f}" for q in quantities),
            str(entry["failures"]),
            str(entry["n"]),
        )
        for name, entry in summary.items()
    ]
    paper_mm, paper_deg = (f"{PAPER_MEAN_MM}, {PAPER_MAX_MM}", f"{PAPER_MEAN_DEG}, {PAPER_MAX_DEG}")
    rows.append(("the paper, real tubes", paper_mm, paper_deg, paper_deg, paper_mm, "-", "-"))
    return Table(f"{caption}: mean, largest absolute error.", heading, tuple(rows))


def verdict(summary: Mapping[str, Mapping[str, float]]) -> str:
    """Say what the table shows in a few sentences."""
    sentences = []
    for method in METHODS:
        entry = summary[method]
        angle_mean = (entry["bending_mean_deg"] + entry["orientation_mean_deg"]) / 2
        angle_max = max(entry["bending_max_deg"], entry["orientation_max_deg"])
        sentences.append(
            f"{method}: tip {entry['tip_mean_mm']:.3f} mm in the mean and {entry['tip_max_mm']:.3f} mm at most, angles "
            f"{angle_mean:.3f} and {angle_max:.3f} degrees, {entry['failures']:.0f} of {entry['n']:.0f} refused."
        )
    return " ".join(sentences)
