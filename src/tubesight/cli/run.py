"""``tubesight run``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tubesight.cli.places import places_of
from tubesight.cli.spread_options import Resume, Scheduler, Workers

if TYPE_CHECKING:
    from tubesight.apps.many import ManyReport
    from tubesight.apps.run import RunOptions, RunReport
    from tubesight.files.tables import ShapeRow

_Inputs = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="FOLDER|RECORDING...",
        help="Data sets, one subfolder of pictures per camera, and recordings (`.mcap`).",
        show_default=False,
    ),
]
_Base = Annotated[
    list[str] | None,
    typer.Option("--base", metavar="CAMERA:X,Y ...", help="Pixel of the tube's base in each camera."),
]
# A longer table is for the file, not for the screen.
_ROWS_SHOWN = 40


def command(
    inputs: _Inputs = None,
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
    base: _Base = None,
    overlay: Annotated[
        bool | None, typer.Option("--overlay/--no-overlay", help="Draw what was found on the photographs.")
    ] = None,
    stages: Annotated[
        bool | None, typer.Option("--stages/--no-stages", help="Draw what each stage made of the photographs.")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    resume: Resume = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Measure the shape in every pair of pictures.

    Writes `shapes.csv` (one row a pair), `curves.npz`, `run.json` and a 3-D plot. Colours and segmenters need no
    option: they are chosen from the pictures, and the command says which and why.

        tubesight run photos --rig rig.yaml --tube tube.yaml -o results --overlay

        tubesight run --config run.yaml

    Several data sets, or recordings, are measured side by side, each into a folder of its name below OUT, with a
    summary of all; so is one data set with `--workers`, `--scheduler` or `--resume`.

        tubesight run monday tuesday session.mcap --rig rig.yaml -o results
    """
    places = places_of(base or [])
    if method is not None:
        refuse_unknown(method)
    named = {
        "rig_path": rig,
        "out": out,
        "tube_path": tube,
        "method": method,
        "background_path": background,
        "base_px": places or None,
        "overlay": overlay,
        "stages": stages,
    }
    given, sources = _given(config, {name: value for name, value in named.items() if value is not None}, inputs or ())
    spread = {"workers": workers, "scheduler": scheduler, "resume": resume}
    raise typer.Exit(0 if _measure(sources, given, spread, json) else 1)


def _measure(sources: Sequence[Path], given: dict[str, Any], spread: dict[str, Any], json: bool) -> bool:
    """Measure one data set into OUT itself, anything else into folders below it; whether nothing was wrong."""
    from tubesight.apps.many_tasks import is_recording
    from tubesight.apps.pool import usable_cores
    from tubesight.apps.run import RunOptions

    if len(sources) > 1 or is_recording(sources[0]) or any(spread.values()):
        return _many(sources, given, json, **spread | {"workers": spread["workers"] or usable_cores()})
    return _one(RunOptions(folder=sources[0], **given), json)


def _given(config: Path | None, named: dict[str, Any], inputs: Sequence[Path]) -> tuple[dict[str, Any], list[Path]]:
    """Options of the file, those of the command line over them; wrong usage where one that has to be is in neither.

    The inputs come apart from the options.
    """
    from tubesight.apps.many_tasks import is_recording
    from tubesight.apps.run_config import load_run_config

    given = (load_run_config(config) if config is not None else {}) | named
    folder = given.pop("folder", None)
    sources = list(inputs) or ([folder] if folder is not None else [])
    for name, lacks, hint, kind in (
        ("folder", not sources, "FOLDER", "argument"),
        ("rig_path", "rig_path" not in given and not all(map(is_recording, sources)), "--rig", "option"),
        ("out", "out" not in given, "--out", "option"),
    ):
        if lacks:
            raise typer.BadParameter(f"Missing {kind}; give it here or as {name!r} in --config", param_hint=hint)
    return given, sources


def refuse_unknown(method: str) -> None:
    """Refuse a name that is no registered method as wrong usage."""
    from tubesight.files.safe import unknown_name
    from tubesight.methods import METHODS

    if method not in METHODS:
        raise typer.BadParameter(unknown_name("method", method, METHODS), param_hint="--method")


def _one(options: RunOptions, json: bool) -> bool:
    from tubesight.apps.run import run_folder
    from tubesight.cli.calibrate import bar

    with bar() as progress:
        report = run_folder(options, lambda done, total: progress("pairs", done, total))
    _print(report, options.out, json)
    return report.complete


def _many(sources: Sequence[Path], given: dict[str, Any], json: bool, **spread: Any) -> bool:
    from tubesight.apps.many import run_many
    from tubesight.cli.calibrate import bar

    out = given.pop("out")
    with bar() as progress:
        report = run_many(sources, out, given, progress=progress, **spread)
    _print_many(report, out, json)
    return report.complete


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


def _print_many(report: ManyReport, out: Path, json: bool) -> None:
    from tubesight.apps.many import statuses
    from tubesight.cli.console import fixed, remark, stdout, table
    from tubesight.files.tables import to_json

    remark(report.messages)
    remark(f"error: {row.name}: {row.problem}" for row in report.rows if row.problem)
    if json:
        files = [str(path) for path in report.files]
        inputs = [asdict(row) for row in report.rows]
        typer.echo(to_json({"inputs": inputs, "messages": report.messages, "files": files}))
        return
    shown = table(("name", "rows by status", "pairs", "ok", "median\n[ms]"), texts=2)
    for row in report.rows[:_ROWS_SHOWN]:
        shown.add_row(row.name, statuses(row) or "-", str(row.pairs), str(row.ok), fixed(row.median_ms, 1))
    stdout().print(shown)
    if len(report.rows) > _ROWS_SHOWN:
        stdout().print(f"... and {len(report.rows) - _ROWS_SHOWN} more in summary.csv")
    pairs, ok = (sum(getattr(row, what) for row in report.rows) for what in ("pairs", "ok"))
    stdout().print(
        f"{ok} of {pairs} pairs measured in {len(report.rows)} inputs; results in {out}/, summed up in summary.csv",
        soft_wrap=True,
    )
