"""``tubesight run``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

if TYPE_CHECKING:
    from tubesight.apps.run import RunOptions, RunReport
    from tubesight.files.tables import ShapeRow

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
_BASE = re.compile(rf"(\w[\w .-]*):({_NUMBER}),({_NUMBER})")
# A longer table is for the file, not for the screen.
_ROWS_SHOWN = 40


class RunCommand(TyperCommand):
    """A command whose ``--base`` takes as many ``camera:X,Y`` as follow it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat ``--base`` before each place that follows one."""
        expanded: list[str] = []
        for arg in args:
            follows = len(expanded) >= 2 and expanded[-2] == "--base"
            if follows and _BASE.fullmatch(arg):
                expanded.append("--base")
            expanded.append(arg)
        return super().parse_args(ctx, expanded)


def command(
    folder: Annotated[Path, typer.Argument(help="Data set: one subfolder of pictures per camera.")],
    rig: Annotated[Path, typer.Option("--rig", help="The cameras: `rig.yaml` of calibrate or register.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the results; made where there is none.")],
    tube: Annotated[Path | None, typer.Option("--tube", help="What is known of the tube: `tube.yaml`.")] = None,
    method: Annotated[str | None, typer.Option("--method", help="One of `tubesight methods`.")] = None,
    background: Annotated[
        Path | None, typer.Option("--background", help="Pictures without the tube, one subfolder per camera.")
    ] = None,
    base: Annotated[
        list[str] | None,
        typer.Option("--base", metavar="CAMERA:X,Y ...", help="Pixel of the tube's base in each camera."),
    ] = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="Draw what was found on the photographs.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Measure the shape in every pair of pictures.

    Writes `shapes.csv` (one row a pair), `curves.npz`, `run.json` and a 3-D plot. Colours and segmenters need no
    option: they are chosen from the pictures, and the command says which and why.

        tubesight run photos --rig rig.yaml --tube tube.yaml -o results --overlay
    """
    places = _places(base or [])
    from tubesight.apps.run import RunOptions
    from tubesight.sensor import DEFAULT_METHOD

    name = method or DEFAULT_METHOD
    _refuse_unknown(name)
    report = _run(RunOptions(folder, rig, out, tube, name, background, places, overlay))
    _print(report, out, json)
    raise typer.Exit(0 if report.complete else 1)


def _places(base: Sequence[str]) -> dict[str, tuple[float, float]]:
    places: dict[str, tuple[float, float]] = {}
    for text in base:
        for part in text.split():
            match = _BASE.fullmatch(part)
            if match is None:
                raise typer.BadParameter(f"expected CAMERA:X,Y such as left:960,52, got {part!r}", param_hint="--base")
            places[match[1]] = (float(match[2]), float(match[3]))
    return places


def _refuse_unknown(method: str) -> None:
    from tubesight.files.safe import unknown_name
    from tubesight.methods import METHODS

    if method not in METHODS:
        raise typer.BadParameter(unknown_name("method", method, METHODS), param_hint="--method")


def _run(options: RunOptions) -> RunReport:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from tubesight.apps.run import run_folder
    from tubesight.cli.console import stderr

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = stderr()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("pairs", total=None)
        return run_folder(options, lambda done, total: bar.update(task, completed=done, total=total))


def _print(report: RunReport, out: Path, json: bool) -> None:
    from tubesight.cli.console import remark, stdout
    from tubesight.files.tables import to_json

    remark(report.messages)
    remark(f"error: {problem}" for problem in report.problems)
    if json:
        rows = [asdict(row) for row in report.rows]
        files = [str(path) for path in report.files]
        typer.echo(to_json({"rows": rows, "messages": report.messages, "problems": report.problems, "files": files}))
        return
    _print_table(report.rows)
    ok = sum(row.status == "ok" for row in report.rows)
    stdout().print(f"{ok} of {len(report.rows)} pairs measured; results in {out}/", soft_wrap=True)


def _print_table(rows: Sequence[ShapeRow]) -> None:
    from tubesight.cli.console import fixed, stdout, table

    numbers = ("tip x\n[mm]", "y\n[mm]", "z\n[mm]", "bending\n[deg]", "orient.\n[deg]", "length\n[mm]", "rms\n[px]")
    shown = table(("frame", "status", *numbers), texts=2)
    for row in rows[:_ROWS_SHOWN]:
        tip = (fixed(value, 3) for value in (row.tip_x_mm, row.tip_y_mm, row.tip_z_mm))
        rest = (fixed(value, 2) for value in (row.bending_deg, row.orientation_deg, row.length_mm, row.fit_rms_px))
        shown.add_row(row.frame, row.status, *tip, *rest)
    stdout().print(shown)
    for row in rows[:_ROWS_SHOWN]:
        if row.notes:
            stdout().print(f"{row.frame}: {row.notes}", soft_wrap=True)
    if len(rows) > _ROWS_SHOWN:
        stdout().print(f"... and {len(rows) - _ROWS_SHOWN} more in shapes.csv")
