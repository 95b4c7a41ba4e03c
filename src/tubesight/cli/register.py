"""``tubesight register``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from tubesight.cli.calibrate import bar, show
from tubesight.cli.places import places_of

_OTHERS = ("FOLDER", "--board", "--points", "--registration", "--report")
_Straight = Annotated[
    Path | None, typer.Option("--straight", help="Instead of a board: pictures of a straight rod in the clamp.")
]
_Bent = Annotated[
    Path | None, typer.Option("--bent", help="With --straight: pictures of a bent tube in the clamp give +x.")
]
_Towards = Annotated[
    str | None,
    typer.Option("--x-towards", metavar="CAMERA", help="With --straight: the camera that +x turns to."),
]
_TubeFile = Annotated[Path | None, typer.Option("--tube", help="With --bent: the bent tube, `tube.yaml`.")]
_Base = Annotated[
    list[str] | None,
    typer.Option("--base", metavar="CAMERA:X,Y ...", help="With --straight: pixel of the base in each camera."),
]


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
    straight: _Straight = None,
    bent: _Bent = None,
    x_towards: _Towards = None,
    tube: _TubeFile = None,
    base: _Base = None,
    report: Annotated[
        Path | None, typer.Option("--report", help="Folder for a report with pictures; made where there is none.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Place the base frame: from views of a board at known poses, from points, or from a straight rod in the clamp.

    Board and points are solved together with the observations of `tubesight calibrate` in the rig file.

        tubesight register registration --rig rig.yaml --board board.yaml -o rig.yaml

        tubesight register --points points.csv --rig rig.yaml -o rig.yaml

        tubesight register --straight rod --bent bent --tube tube.yaml --rig rig.yaml -o rig.yaml
    """
    if straight is not None:
        others = zip(_OTHERS, (folder, board, points, registration, report), strict=True)
        _refuse_mixed(dict(others), "--straight needs no")
        _straight(straight, rig, out, bent, x_towards, tube, places_of(base or []), json)
        return
    _refuse_mixed({"--bent": bent, "--x-towards": x_towards, "--tube": tube, "--base": base}, "only --straight takes")
    if points is None and folder is None:
        raise typer.BadParameter("name the folder of board pictures, --points or --straight", param_hint="FOLDER")
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


def _refuse_mixed(options: Mapping[str, object], why: str) -> None:
    for name, value in options.items():
        if value:
            raise typer.BadParameter(f"{why} {name}", param_hint=name)


def _straight(
    rod: Path,
    rig: Path,
    out: Path,
    bent: Path | None,
    x_towards: str | None,
    tube: Path | None,
    base_px: dict[str, tuple[float, float]],
    json: bool,
) -> None:
    if bent is not None and x_towards is not None:
        raise typer.BadParameter("+x is given by --bent already", param_hint="--x-towards")
    if tube is not None and bent is None:
        raise typer.BadParameter("it describes the tube of --bent", param_hint="--tube")
    from tubesight.apps.register_straight import StraightOptions, register_straight

    with bar() as progress:
        outcome = register_straight(StraightOptions(rod, rig, out, bent, x_towards, tube, base_px), progress)
    show(outcome, json)
