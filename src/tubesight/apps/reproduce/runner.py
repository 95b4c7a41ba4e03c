"""``tubesight reproduce``: run studies and report them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tubesight.apps.pool import open_pool
from tubesight.apps.remembered import Progress, Remembered, forget
from tubesight.apps.reproduce.drawing import style
from tubesight.apps.reproduce.registry import STUDIES, study
from tubesight.apps.reproduce.report import page
from tubesight.apps.reproduce.study import Context, StudyResult
from tubesight.core import InputError
from tubesight.files.safe import unknown_name, write_atomic
from tubesight.files.tables import write_json
from tubesight.outputs.plot3d import plots_installed


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What was reproduced.

    Attributes
    ----------
    results
        By study, in the order of the report.
    report, summary
        What was written for people and for programs.
    """

    results: dict[str, StudyResult]
    report: Path
    summary: Path


def reproduce(
    out: Path,
    names: Sequence[str] = (),
    *,
    quick: bool = False,
    seed: int = 0,
    workers: int = 1,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Progress = lambda study, done, total: None,
) -> Reproduction:
    """Run studies; report and summary are written after each, so that an interruption leaves what was done.

    Parameters
    ----------
    out
        Folder for ``report.html``, ``summary.json``, ``data``, ``figures`` and ``cache``.
    names
        Studies; all where empty.
    resume
        Keep the tasks that an earlier run with the same options and version finished there.
    workers, scheduler
        See `tubesight.apps.pool.open_pool`.

    Raises
    ------
    InputError
        If a study is not known, matplotlib is missing, or something cannot be written or reached.
    """
    for name in names:
        if name not in STUDIES:
            raise InputError(unknown_name("study", name, STUDIES))
    if not plots_installed():
        raise InputError("reproduce draws figures, but matplotlib is missing (pip install 'tubesight[plots]')")
    if not resume:
        forget(out / "cache")
    results: dict[str, StudyResult] = {}
    report, summary = out / "report.html", out / "summary.json"
    write_json(summary, {})
    with style(), open_pool(workers, scheduler) as pool:
        spread = Remembered(out / "cache", pool, progress)
        for name in (n for n in STUDIES if not names or n in names):
            results[name] = study(name)(Context(name, out, quick, seed, spread))
            write_json(summary, {n: r.summary for n, r in results.items() if r.summary})
            write_atomic(report, page(results, _about(quick, seed)))
    return Reproduction(results, report, summary)


def _about(quick: bool, seed: int) -> dict[str, Any]:
    return {"seed": seed, "steps": "coarse (--quick)" if quick else "full"}
