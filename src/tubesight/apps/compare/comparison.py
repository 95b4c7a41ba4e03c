"""All methods on all cases: rows, what they say of each method, and the worst case of each as a picture."""

from __future__ import annotations

import csv
import io
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from math import isfinite, nan
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tubesight import __version__
from tubesight.apps.bench import one_thread
from tubesight.apps.compare import external
from tubesight.apps.compare.cases import Case, by_resolution, experiment, of_folders
from tubesight.apps.compare.criteria import ROUND, best_arc_mm, judged, stated
from tubesight.apps.compare.measure import COLUMNS, Measured, Row, largest, mean, measured
from tubesight.core import FramePair, Image, InputError
from tubesight.files.safe import unknown_name
from tubesight.geometry.rig import Rig
from tubesight.methods import METHODS
from tubesight.outputs.machine import machine
from tubesight.outputs.overlay import draw_overlay

Progress = Callable[[str, int, int], None]

# icpReconstructor takes 5 to 160 s a pair: it gets at most so many of the cases, evenly spread.
_EXTERNAL = 5
# The worst case of a method is drawn for this many of its cameras.
_DRAWN = 2
_TRUE_BGR = (70, 200, 70)


@dataclass(frozen=True, slots=True, eq=False)
class Worst:
    """The worst case of a method: its row, and the picture with the true centreline and what was found."""

    row: Row
    picture: Image


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """What was measured.

    Attributes
    ----------
    rows, by_resolution
        Of the cases, and of some of them at several resolutions.
    given
        By method: what it is given beyond two calibrated pictures.
    criteria
        By method, then by criterion: met, not met, or not decided.
    worst
        By method.
    about
        What made it: source of the pictures, version, machine.
    """

    rows: tuple[Row, ...]
    by_resolution: tuple[Row, ...]
    given: Mapping[str, tuple[str, ...]]
    criteria: Mapping[str, Mapping[str, bool | None]]
    worst: Mapping[str, Worst]
    about: Mapping[str, Any]

    def of(self, name: str) -> list[Row]:
        """Rows of one method."""
        return [row for row in self.rows if row.method == name]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names in the order of the registry."""
        return tuple(self.criteria)

    def as_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {**self.about, "methods": {name: self._entry(name) for name in self.methods}}

    def _entry(self, name: str) -> dict[str, Any]:
        rows = self.of(name)
        quantities = ("tip_mm", "curve_mean_mm", "bending_deg", "orientation_deg", "length_mm")
        entry: dict[str, Any] = {"given": list(self.given[name]), "cameras": max(row.cameras for row in rows)}
        for quantity in quantities:
            stem, unit = quantity.removesuffix("_mm").removesuffix("_deg"), quantity.rsplit("_", 1)[1]
            entry[f"{stem.removesuffix('_mean')}_mean_{unit}"] = mean(rows, quantity)
            column = "curve_max_mm" if stem == "curve_mean" else quantity
            entry[f"{stem.removesuffix('_mean')}_max_{unit}"] = largest(rows, column)
        return entry | {
            "failures": sum(not row.ok for row in rows),
            "n": len(rows),
            "reasons": dict(Counter(row.status for row in rows if not row.ok)),
            "ms_per_pair": mean(rows, "ms"),
            "criteria": dict(self.criteria[name]),
            "stated": stated(name),
        }

    def table(self) -> str:
        """All rows as CSV, those by resolution after the others."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(("study", *COLUMNS))
        for study, rows in (("cases", self.rows), ("resolution", self.by_resolution)):
            for row in rows:
                writer.writerow((study, *("" if cell != cell else cell for cell in astuple(row))))
        return text.getvalue()


def compare(
    folders: Sequence[Path] = (),
    names: Sequence[str] = (),
    quick: bool = False,
    external_python: str | None = None,
    progress: Progress = lambda step, done, total: None,
) -> Comparison:
    """Measure every case with every method.

    Parameters
    ----------
    folders
        Data sets with their truth; without one, experiment 1 of the paper is rendered, at several resolutions too.
    names
        Methods; all where empty.
    quick
        Fewer cases of fewer pixels: two minutes instead of an hour.
    external_python
        Interpreter of an environment with icpReconstructor, which is then compared too, on a few of the cases.
    progress
        Called with what is being done, how many are done and how many there are.

    Raises
    ------
    InputError
        If a method is not known, a folder cannot be used, or icpReconstructor is not there.
    """
    if external_python is not None:
        external.check(external_python)
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise InputError(f"--methods: {unknown_name('method', unknown[0], METHODS)}")
    names = [name for name in METHODS if not names or name in names]
    cases = of_folders(folders, quick) if folders else experiment(quick)
    resolutions = [] if folders else by_resolution(quick)
    with one_thread():
        _warm_up(cases[0], names)
        worst: dict[str, Worst] = {}
        rows = [_kept(made, case, worst) for made, case in _measured(cases, names, "comparing", progress)]
        if external_python is not None:
            few = cases[:: -(-len(cases) // _EXTERNAL)]
            rows += [_kept(made, case, worst) for made, case in _external(few, external_python, progress)]
        finer = [made.row for made, _ in _measured(resolutions, names, "by resolution", progress)]
    given = {name: METHODS[name].given for name in names}
    if external_python is not None:
        given |= dict.fromkeys((external.SHIPPED, external.PATCHED), external.GIVEN)
    return Comparison(
        tuple(rows),
        tuple(finer),
        given,
        _criteria(cases, given, rows),
        {name: worst[name] for name in given},
        {
            "version": __version__,
            "pictures": [str(folder) for folder in folders] or "experiment 1, rendered, true rig",
            "quick": quick,
            "machine": machine(),
        },
    )


def _warm_up(case: Case, names: Iterable[str]) -> None:
    """Let every method do what it does only once: compile, import."""
    deque(measured(case, list(names)), maxlen=0)


def _measured(
    cases: Sequence[Case], names: Sequence[str], step: str, progress: Progress
) -> Iterator[tuple[Measured, Case]]:
    for done, case in enumerate(cases, start=1):
        for made in measured(case, names):
            yield made, case
        progress(step, done, len(cases))


def _external(cases: Sequence[Case], python: str, progress: Progress) -> Iterator[tuple[Measured, Case]]:
    for done, case in enumerate(cases, start=1):
        for made in external.external(case, python):
            yield made, case
        progress("icpReconstructor", done, len(cases))


def _kept(made: Measured, case: Case, worst: dict[str, Worst]) -> Row:
    """Keep the picture of a case that is worse than all before, and return its row."""
    before = worst.get(made.row.method)
    if before is None or _badness(made.row) > _badness(before.row):
        worst[made.row.method] = Worst(made.row, _drawn(made, case))
    return made.row


def _badness(row: Row) -> float:
    """Largest distance of the curve; a case without a curve comes last, there is less to look at."""
    return row.curve_max_mm if isfinite(row.curve_max_mm) else -1.0


def _drawn(made: Measured, case: Case) -> Image:
    """Draw what was found over the true centreline, in the first cameras."""
    rig, pair = made.shot.rig, made.shot.pair
    shown = rig.names[:_DRAWN]
    images = {name: pair.images[name].copy() for name in shown}
    for name, image in images.items():
        px = rig.project(name, case.true.centreline_mm)
        cv2.polylines(image, [np.rint(px * 16).astype(np.int32).reshape(-1, 1, 2)], False, _TRUE_BGR, 2, cv2.LINE_AA, 4)
    if made.result is None:
        return np.concatenate(list(images.values()), axis=1)
    part = Rig(
        {name: rig.cameras[name] for name in shown},
        {name: rig.camera_from_base[name] for name in shown},
        rig.base_frame,
    )
    return draw_overlay(FramePair(images, pair.name), made.result, part)


def _criteria(
    cases: Sequence[Case], given: Mapping[str, tuple[str, ...]], rows: Sequence[Row]
) -> dict[str, dict[str, bool | None]]:
    bent = [best_arc_mm(case.true) for case in cases if case.true.kind not in ROUND]
    arc_mm = float(np.mean(bent)) if bent else nan
    radius_mm = min((case.tube.diameter_mm / 2 for case in cases if case.tube.diameter_mm), default=nan)
    own = {name: [row for row in rows if row.method == name] for name in given}
    return {name: judged(given[name], own[name], radius_mm, arc_mm) for name in given}
