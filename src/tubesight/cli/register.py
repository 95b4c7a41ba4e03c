"""``tubesight register``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tubesight.cli.calibrate import bar, show


def command(
    rig: Annotated[Path, typer.Option("--rig", help="The cameras: `rig.yaml` of calibrate or import.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The rig file to write; may be the same.")],
    folder: Annotated[
        Path | None, typer.Argument(help="Pictures of the board at known poses: one subfolder per camera.")
    ] = None,
    board: Annotated[Path | None, typer.Option("--board", help="The board: `board.yaml`.")] = None,
    registration: Annotated[
        Path | None,
        typer.Option(
            "--registration", help="The board's poses; `registration.yaml` in the folder or above by default."
        ),
    ] = None,
    points: Annotated[
        Path | None, typer.Option("--points", help="Instead of a board: a table of points and their pixels (csv).")
    ] = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for a report with pictures; made where there is none.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Place the base frame: from views of a board at known poses, or from points.

    With the observations of `tubesight calibrate` in the rig file everything is solved again in one adjustment.

        tubesight register registration --rig rig.yaml --board board.yaml -o rig.yaml

        tubesight register --points points.csv --rig rig.yaml -o rig.yaml
    """
    if points is None and folder is None:
        raise typer.BadParameter("name the folder of board pictures, or --points", param_hint="FOLDER")
    if points is None and board is None:
        raise typer.BadParameter("the pictures show a board: name its file, or use --points", param_hint="--board")
    from tubesight.apps.register import register_folder

    with bar() as progress:
        outcome = register_folder(
            folder,
            rig,
            board,
            out,
            registration_path=registration,
            points_path=points,
            report=report,
            progress=progress,
        )
    show(outcome, json)
