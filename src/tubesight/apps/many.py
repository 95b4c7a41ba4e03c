"""``tubesight run`` over many inputs: data sets and recordings, each measured on its own, spread over processes."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from tubesight import __version__
from tubesight.apps.live.replay import replay_file
from tubesight.apps.many_tasks import CACHE, SUMMARIES, Task, absolute, names_of, tasks_of
from tubesight.apps.pool import open_pool
from tubesight.apps.remembered import Progress, Remembered, forget
from tubesight.apps.run import refuse_place, run_folder
from tubesight.core import InputError, Status
from tubesight.files.safe import write_atomic
from tubesight.files.tables import read_shapes, write_json
from tubesight.outputs.machine import machine


@dataclass(frozen=True, slots=True)
class InputRow:
    """How an input fared; a row of ``summary.csv``.

    Attributes
    ----------
    name, input
        Its folder in OUT, and its absolute path.
    pairs, ok
        Rows of its ``shapes.csv``, and how many are ``ok``.
    status
        Rows by status.
    without_pictures
        Pairs of a recording whose pictures were not recorded; they have no row.
    median_ms
        From pictures to shape, of the rows that are ``ok``.
    problem
        What could not be read or written; empty where nothing is wrong.
    """

    name: str
    input: str
    pairs: int = 0
    ok: int = 0
    status: Mapping[str, int] = field(default_factory=dict)
    without_pictures: int = 0
    median_ms: float = math.nan
    problem: str = ""


@dataclass(frozen=True, slots=True)
class ManyReport:
    """What a run over many inputs found.

    Attributes
    ----------
    rows
        One an input, in the order given.
    messages
        What the user should know of rig, tube and options; what concerns one input alone is in its ``run.json``.
    files
        The summaries.
    """

    rows: tuple[InputRow, ...]
    messages: tuple[str, ...]
    files: tuple[Path, ...]

    @property
    def complete(self) -> bool:
        """Whether all that was named was read and at least one row is ``ok``."""
        return not any(row.problem for row in self.rows) and any(row.ok for row in self.rows)


def run_many(
    inputs: Sequence[Path],
    out: Path,
    given: Mapping[str, Any],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Progress = lambda batch, done, total: None,
) -> ManyReport:
    """Measure data sets and recordings, each into its own folder below `out`, and sum up.

    An input that cannot be used becomes a row that says why; the others are measured.

    Parameters
    ----------
    inputs
        Folders as `tubesight.apps.run.run_folder` takes them, and recordings (``.mcap``), which are measured with the
        rig, tube and method inside them; one given twice is measured once.
    given
        Fields of `tubesight.apps.run.RunOptions` but ``folder`` and ``out``; ``rig_path`` where there is a folder. Of
        these ``method`` alone counts for recordings.
    workers, scheduler
        See `tubesight.apps.pool.open_pool`; results do not depend on them. Workers on other machines have to see
        inputs, rig, tube and `out` under the same paths.
    resume
        Keep what an earlier run measured with the same options and version, from files that have not changed since.
    progress
        Called with ``"inputs"``, how many are done and how many there are.

    Raises
    ------
    InputError
        If rig or tube cannot be used by any folder, the summary cannot be written, or the scheduler not be reached.
    """
    refuse_place(out)
    started = datetime.now(UTC)
    out = absolute(out)
    options = {key: absolute(value) if isinstance(value, Path) else value for key, value in given.items()}
    sources = list(dict.fromkeys(map(absolute, inputs)))
    names = names_of(sources)
    tasks, messages = tasks_of(sources, [out / name for name in names], options)
    if not resume:
        forget(out / CACHE)
    with open_pool(workers, scheduler) as pool:
        found = Remembered(out / CACHE, pool, progress, _unchanged)("inputs", measured, tasks)
    rows = tuple(
        InputRow(name, str(task.source), **result["row"])
        for name, task, result in zip(names, tasks, found, strict=True)
    )
    about = {"started": started.isoformat(timespec="seconds"), "configuration": options, "messages": messages}
    files = _write_summaries(out, rows, about)
    return ManyReport(rows, tuple(messages), files)


def measured(task: Task) -> dict[str, Any]:
    """Measure one input: its `InputRow` without name and path, and a hash of its table, empty where there is none."""
    try:
        problem, without = _measure(task)
        table = task.out / "shapes.csv"
        rows = read_shapes(table)
        digest = _digest(table)
    except (InputError, OSError, MemoryError) as error:
        # What is wrong with one input is no reason to lose the others.
        return {"row": {"problem": str(error) or "it needs more memory than there is"}, "table": ""}
    times = [row.total_ms for row in rows if row.status == Status.OK]
    row = {
        "pairs": len(rows),
        "ok": len(times),
        "status": dict(Counter(row.status for row in rows)),
        "without_pictures": without,
        "median_ms": median(times) if times else math.nan,
        "problem": problem,
    }
    return {"row": row, "table": digest, "file": str(table)}


def _measure(task: Task) -> tuple[str, int]:
    """Measure and write; what was wrong nevertheless, and how many pairs had no pictures."""
    if task.options is None:
        refuse_place(task.out)
        return "", replay_file(task.source, task.out, task.method).without_pictures
    problems = run_folder(task.options).problems
    more = f" (and {len(problems) - 1} more pairs)" if len(problems) > 1 else ""
    return (problems[0] + more if problems else ""), 0


def _unchanged(result: Mapping[str, Any]) -> bool:
    """Whether the table that a kept result speaks of is still there as it was written; no table is no result."""
    return bool(result["table"]) and result["table"] == _digest(Path(result["file"]))


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _write_summaries(out: Path, rows: Sequence[InputRow], about: Mapping[str, Any]) -> tuple[Path, ...]:
    """Write the table and its JSON."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [column.name for column in fields(InputRow)], lineterminator="\n")
    writer.writeheader()
    for row in rows:
        time = f"{row.median_ms:.7g}" if math.isfinite(row.median_ms) else ""
        writer.writerow(asdict(row) | {"status": statuses(row), "median_ms": time})
    table, data = (out / name for name in SUMMARIES)
    write_atomic(table, text.getvalue())
    head = {"format": "tubesight-runs/1", "version": __version__, **about, "machine": machine()}
    write_json(data, head | {"inputs": [asdict(row) for row in rows]})
    return table, data


def statuses(row: InputRow) -> str:
    """Rows by status on one line, the commonest first."""
    return "; ".join(f"{name} {count}" for name, count in Counter(row.status).most_common())
