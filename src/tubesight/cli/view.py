"""``tubesight view``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.viewer.boards import BoardFolder
    from tubesight.apps.viewer.play import Player


def command(
    what: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER | RECORDING",
            help="One subfolder of pictures per camera; or a recording, `.mcap`.",
        ),
    ],
    rig: Annotated[
        Path | None, typer.Option("--rig", help="The cameras: `rig.yaml`. Recordings hold their own.")
    ] = None,
    tube: Annotated[Path | None, typer.Option("--tube", help="What is known of the tube: `tube.yaml`.")] = None,
    method: Annotated[
        str | None,
        typer.Option("--method", help="Pipeline to begin with; a recording is measured again with it."),
    ] = None,
    background: Annotated[
        Path | None, typer.Option("--background", help="Pictures without the tube, one subfolder per camera.")
    ] = None,
    board: Annotated[
        Path | None,
        typer.Option("--board", help="The folder is a calibration: show where this board, `board.yaml`, was seen."),
    ] = None,
    port: Annotated[int, typer.Option("--port", help="Port of the page on this machine; 0 takes any free one.")] = 8080,
    pairs: Annotated[int | None, typer.Option("--pairs", help="Stop after so many pairs.", min=1)] = None,
) -> None:
    """Look at a folder of pictures or a recording in the browser: what the cameras see and what is measured, in 3-D.

    The page is served on this machine alone and needs no network. From another machine reach it through
    `ssh -L 8080:127.0.0.1:8080`. Nothing is written.

        tubesight view photos --rig rig.yaml --tube tube.yaml

        tubesight view session.mcap

        tubesight view calibration --board board.yaml
    """
    from tubesight.files.packages import require_package

    require_package("viser", "view", "the viewer needs the package viser")
    from tubesight.cli.run import refuse_unknown

    if method is not None:
        refuse_unknown(method)
    if board is not None:
        _refuse({"--rig": rig, "--tube": tube, "--background": background, "--method": method}, "--board needs none")
        player: Player | BoardFolder = _boards(what, board, port)
    else:
        player = _player(what, rig, tube, method, background, port)
    try:
        player.run(pairs)
    except KeyboardInterrupt:
        player.stop()


def _player(
    what: Path, rig: Path | None, tube: Path | None, method: str | None, background: Path | None, port: int
) -> Player:
    from tubesight.apps.run import RunOptions
    from tubesight.apps.viewer.play import view_folder, view_recording
    from tubesight.cli.console import remark
    from tubesight.sensor import DEFAULT_METHOD

    def tell(line: str) -> None:
        remark([line])

    if what.is_file() or what.suffix.lower() == ".mcap":
        _refuse({"--rig": rig, "--tube": tube, "--background": background}, "a recording holds its own")
        return view_recording(what, method, port, tell)
    if rig is None:
        raise typer.BadParameter("a folder of pictures needs --rig rig.yaml", param_hint="--rig")
    return view_folder(RunOptions(what, rig, what, tube, method or DEFAULT_METHOD, background), port, tell)


def _boards(folder: Path, board: Path, port: int) -> BoardFolder:
    from tubesight.apps.viewer.boards import BoardFolder
    from tubesight.cli.console import remark

    boards = BoardFolder(folder, board, port)
    remark([f"open {boards.page.address} in a browser on this machine; Ctrl-C ends"])
    return boards


def _refuse(given: Mapping[str, object], why: str) -> None:
    """Refuse options that mean nothing here."""
    unused = [option for option, value in given.items() if value is not None]
    if unused:
        raise typer.BadParameter(why, param_hint=unused[0])
