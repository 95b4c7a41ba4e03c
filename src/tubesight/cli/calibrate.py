"""``tubesight calibrate``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.calibrate import Outcome


def command(
    folder: Annotated[Path, typer.Argument(help="Pictures of the board: one subfolder per camera.")],
    board: Annotated[Path, typer.Option("--board", help="The board: `board.yaml`.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The rig file to write.")],
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for a report with pictures; made where there is none.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Calibrate lenses and relative poses from pictures of a chessboard or ChArUco board.

    Ends with a verdict in words and the next step. The base frame is the first camera's until `tubesight register`.

        tubesight calibrate calibration --board board.yaml -o rig.yaml --report report
    """
    from tubesight.apps.calibrate import calibrate_folder

    with bar() as progress:
        outcome = calibrate_folder(folder, board, out, report, progress)
    show(outcome, json)


@contextmanager
def bar() -> Iterator[Callable[[str, int, int], None]]:
    """Progress on stderr: a line for each stage."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from tubesight.cli.console import stderr

    console = stderr()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        tasks = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield report


def show(outcome: Outcome, json: bool) -> None:
    """Print an outcome: tables, what was left out, the verdict and the next step."""
    from tubesight.apps.calibrate import camera_rows, coverage_lines, pair_rows
    from tubesight.cli.console import remark, stdout, table
    from tubesight.files.tables import to_json

    if json:
        typer.echo(to_json(outcome.as_dict()))
        return
    console = stdout()
    for rows in (camera_rows(outcome), pair_rows(outcome)):
        if len(rows) > 1:
            shown = table([heading.replace(" [", "\n[") for heading in rows[0]], texts=1)
            for row in rows[1:]:
                shown.add_row(*row)
            console.print(shown)
    for line in coverage_lines(outcome):
        console.print(line, soft_wrap=True)
    for view, mm in outcome.registration.get("deviation_mm", {}).items():
        console.print(f"{view}: the board as stated is {mm:.3f} mm from where the pictures place it")
    if outcome.left_out:
        console.print("not used, or not fully:")
        for line in outcome.left_out:
            console.print(f"  {line}", soft_wrap=True)
    remark(f"note: {line}" for line in (*outcome.warnings, *outcome.verdict.remarks))
    console.print(outcome.verdict.sentence, soft_wrap=True)
    console.print(f"next: {outcome.verdict.next_step}", soft_wrap=True)
    console.print(f"written: {', '.join(str(path) for path in outcome.files)}", soft_wrap=True)
