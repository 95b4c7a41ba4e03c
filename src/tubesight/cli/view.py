"""``tubesight view``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    folder: Annotated[Path, typer.Argument(help="Data set: one subfolder of pictures per camera.")],
    rig: Annotated[Path, typer.Option("--rig", help="The cameras: `rig.yaml` of calibrate or register.")],
    tube: Annotated[Path | None, typer.Option("--tube", help="What is known of the tube: `tube.yaml`.")] = None,
    method: Annotated[str, typer.Option("--method", help="One of `tubesight methods`.")] = "silhouette",
    background: Annotated[
        Path | None, typer.Option("--background", help="Pictures without the tube, one subfolder per camera.")
    ] = None,
    port: Annotated[int, typer.Option("--port", help="Port of the page on this machine; 0 takes any free one.")] = 8080,
    pairs: Annotated[int | None, typer.Option("--pairs", help="Stop after so many pairs.", min=1)] = None,
) -> None:
    """Look at a folder of pictures in the browser: what the cameras see and what is measured, in 3-D.

    The page is served on this machine alone and needs no network. From another machine reach it through
    `ssh -L 8080:127.0.0.1:8080`. Nothing is written.

        tubesight view photos --rig rig.yaml --tube tube.yaml
    """
    from tubesight.files.packages import require_package

    require_package("viser", "view", "the viewer needs the package viser")
    from tubesight.apps.run import RunOptions
    from tubesight.apps.viewer.play import view_folder
    from tubesight.cli.console import remark
    from tubesight.cli.run import refuse_unknown

    refuse_unknown(method)
    options = RunOptions(folder, rig, folder, tube, method, background)
    player = view_folder(options, port, lambda line: remark([line]))
    try:
        player.run(pairs)
    except KeyboardInterrupt:
        player.stop()
