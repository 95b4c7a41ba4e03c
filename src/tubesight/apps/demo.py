"""``tubesight demo``: the whole way from a board to measured shapes, on simulated photographs, judged by the truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from tubesight.apps.calibrate import calibrate_folder
from tubesight.apps.demo_report import Comparison, compare, summary, write_report
from tubesight.apps.evaluate import evaluate
from tubesight.apps.register import register_folder
from tubesight.apps.run import RunOptions, run_folder
from tubesight.apps.simulate import DatasetPlan, mockup_phantoms, write_dataset
from tubesight.core import InputError
from tubesight.files.truth import load_truth
from tubesight.simulate import rig_around

# A quick demo has a quarter of the pixels, fewer views of the board, and half of the shapes.
_QUICK_SIZE, _QUICK_VIEWS = (960, 540), 8
_QUICK_FRAMES = ("arc_50", "straight", "s_shape")

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many are done and how many there are."""


@dataclass(frozen=True, slots=True)
class Demo:
    """What the demo did.

    Attributes
    ----------
    comparisons
        Measured and true, by frame.
    summary
        Largest errors, in words.
    verdicts
        On calibration and registration, a line each.
    seconds
        By step.
    places
        What was written, by what it is.
    """

    comparisons: tuple[Comparison, ...]
    summary: str
    verdicts: tuple[str, ...]
    seconds: dict[str, float]
    places: dict[str, Path]


def run_demo(out: Path, quick: bool = False, progress: Progress = lambda step, done, total: None) -> Demo:
    """Take photographs of boards and tubes, calibrate, register, measure, compare with the truth, report.

    Raises
    ------
    InputError
        If `out` cannot be written, or holds folders of these names that no demo made.
    """
    data, results = out / "data", out / "results"
    rig, tube, board, truth = out / "rig.yaml", data / "tube.yaml", data / "board.yaml", data / "truth.json"
    _clear(data, truth)
    _clear(results, results / "run.json")
    seconds: dict[str, float] = {}
    started = perf_counter()

    def lap(step: str) -> None:
        nonlocal started
        seconds[step], started = perf_counter() - started, perf_counter()

    write_dataset(data, _plan(quick), lambda done, total: progress("taking photographs", done, total))
    lap("photographs")
    lenses = calibrate_folder(data / "calibration", board, rig, out / "calibration", progress)
    base = register_folder(data / "registration", rig, board, rig, report=out / "registration", progress=progress)
    lap("calibration")
    options = RunOptions(data, rig, results, tube, overlay=True)
    run = run_folder(options, lambda done, total: progress("measuring shapes", done, total))
    evaluation = evaluate(results, truth)
    lap("shapes")
    comparisons = compare(run.rows, load_truth(truth), evaluation)
    verdicts = (f"calibration: {lenses.verdict.sentence}", f"registration: {base.verdict.sentence}")
    report = out / "report.html"
    write_report(report, comparisons, evaluation, verdicts, run.messages, seconds, results)
    places = {
        "report": report,
        "overlays": results / "overlay",
        "results": results,
        "photographs": data,
        "rig": rig,
        "calibration report": out / "calibration" / "report.html",
    }
    plot = results / "shapes.png"
    if plot in run.files:
        places["3-D plot"] = plot
    return Demo(tuple(comparisons), summary(evaluation), verdicts, seconds, places)


def _plan(quick: bool) -> DatasetPlan:
    phantoms = mockup_phantoms()
    if not quick:
        return DatasetPlan(phantoms)
    few = {name: phantoms[name] for name in _QUICK_FRAMES}
    return DatasetPlan(few, rig_around(size_px=_QUICK_SIZE), board_views=_QUICK_VIEWS)


def _clear(folder: Path, mark: Path) -> None:
    """Remove what an earlier demo left; a folder without its mark holds something else and is not touched."""
    if not folder.exists():
        return
    if not mark.is_file():
        raise InputError(f"{folder}: not from a demo, so it is not overwritten; name another folder with -o")
    try:
        shutil.rmtree(folder)
    except OSError as error:
        raise InputError(f"{folder}: cannot be replaced ({error.strerror}); name another folder with -o") from error
