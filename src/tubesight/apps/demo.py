"""``tubesight demo``: the whole way from a board to measured shapes, on simulated photographs, judged by the truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from tubesight.apps.demo_report import write_report
from tubesight.apps.evaluate import Evaluation, evaluate
from tubesight.apps.run import RunOptions, RunReport, run_folder
from tubesight.apps.simulate import DatasetPlan, mockup_phantoms, write_dataset
from tubesight.files.truth import TrueShape, load_truth
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
    truth
        By frame.
    run
        What was measured.
    evaluation
        Errors by frame.
    verdicts
        On calibration and registration, a line each.
    seconds
        By step.
    data, rig_path, results, report
        Where photographs, rig, results and report are.
    """

    truth: Mapping[str, TrueShape]
    run: RunReport
    evaluation: Evaluation
    verdicts: tuple[str, ...]
    seconds: Mapping[str, float]
    data: Path
    rig_path: Path
    results: Path
    report: Path


def run_demo(out: Path, quick: bool = False, progress: Progress = lambda step, done, total: None) -> Demo:
    """Take photographs of boards and tubes, calibrate, register, measure, compare with the truth, report.

    Raises
    ------
    InputError
        If the results cannot be written.
    """
    data, rig_path, results, report = out / "data", out / "rig.yaml", out / "results", out / "report.html"
    clock = _Clock()
    write_dataset(data, _plan(quick), lambda done, total: progress("taking photographs", done, total))
    clock.lap("take photographs")
    verdicts = _calibrate(data, rig_path, progress)
    clock.lap("calibrate")
    options = RunOptions(data, rig_path, results, data / "tube.yaml", overlay=True)
    run = run_folder(options, lambda done, total: progress("measuring shapes", done, total))
    clock.lap("measure")
    demo = Demo(
        load_truth(data / "truth.json"),
        run,
        evaluate(results, data / "truth.json"),
        verdicts,
        clock.seconds,
        data,
        rig_path,
        results,
        report,
    )
    write_report(demo)
    return demo


def _plan(quick: bool) -> DatasetPlan:
    phantoms = mockup_phantoms()
    if not quick:
        return DatasetPlan(phantoms)
    few = {name: phantoms[name] for name in _QUICK_FRAMES}
    return DatasetPlan(few, rig_around(size_px=_QUICK_SIZE), board_views=_QUICK_VIEWS)


class _Clock:
    """Seconds by step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, step: str) -> None:
        """Note the time since the last step."""
        now = perf_counter()
        self.seconds[step], self._last = now - self._last, now


def _clear(folder: Path, mark: str) -> None:
    """Remove what an earlier demo left; a folder that holds something else is not touched."""
    if not folder.exists():
        return
    if not (folder / mark).is_file():
        raise InputError(f"{folder}: exists and is not from a demo; name another folder with -o")
    shutil.rmtree(folder)
