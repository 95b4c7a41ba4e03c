"""``tubesight run``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tubesight.cli.places import places_of

if TYPE_CHECKING:
    from tubesight.apps.run import RunOptions, RunReport
    from tubesight.files.tables import ShapeRow

# A longer table is for the file, not for the screen.
_ROWS_SHOWN = 40


def command(
    folder: Annotated[
        Path | None, typer.Argument(help="Data set: one subfolder of pictures per camera.", show_default=False)
    ] = None,
    rig: Annotated[Path | None, typer.Option("--rig", help="The cameras: `rig.yaml` of calibrate or register.")] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for the results; made where there is none.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="Options in a file: `run.yaml`, or the `run.json` of another run.")
    ] = None,
    tube: Annotated[Path | None, typer.Option("--tube", help="What is known of the tube: `tube.yaml`.")] = None,
    method: Annotated[str | None, typer.Option("--method", help="One of `tubesight methods`.")] = None,
    background: Annotated[
        Path | None, typer.Option("--background", help="Pictures without the tube, one subfolder per camera.")
    ] = None,
    base: Annotated[
        list[str] | None,
        typer.Option("--base", metavar="CAMERA:X,Y ...", help="Pixel of the tube's base in each camera."),
    ] = None,
    overlay: Annotated[
        bool | None, typer.Option("--overlay/--no-overlay", help="Draw what was found on the photographs.")
    ] = None,
    stages: Annotated[
        bool | None, typer.Option("--stages/--no-stages", help="Draw what each stage made of the photographs.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Measure the shape in every pair of pictures.

    Writes `shapes.csv` (one row a pair), `curves.npz`, `run.json` and a 3-D plot. Colours and segmenters need no
    option: they are chosen from the pictures, and the command says which and why.

        tubesight run photos --rig rig.yaml --tube tube.yaml -o results --overlay

        tubesight run --config run.yaml
    """
    places = places_of(base or [])
    if method is not None:
        refuse_unknown(method)
    named = {
        "folder": folder,
        "rig_path": rig,
        "out": out,
        "tube_path": tube,
        "method": method,
        "background_path": background,
        "base_px": places or None,
        "overlay": overlay,
        "stages": stages,
    }
    options = _options(config, {name: value for name, value in named.items() if value is not None})
    report = _run(options)
    _print(report, options.out, json)
    raise typer.Exit(0 if report.complete else 1)


def _options(config: Path | None, named: dict[str, Any]) -> RunOptions:
    """Options of the file, those of the command line over them; wrong usage where one that has to be is in neither."""
    from tubesight.apps.run import RunOptions
    from tubesight.apps.run_config import load_run_config

    given = (load_run_config(config) if config is not None else {}) | named
    for name, hint, kind in (
        ("folder", "FOLDER", "argument"),
        ("rig_path", "--rig", "option"),
        ("out", "--out", "option"),
    ):
        if name not in given:
            raise typer.BadParameter(f"Missing {kind}; give it here or as {name!r} in --config", param_hint=hint)
    return RunOptions(**given)


def refuse_unknown(method: str) -> None:
    """Refuse a name that is no registered method as wrong usage."""
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
