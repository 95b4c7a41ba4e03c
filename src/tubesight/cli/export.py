"""``tubesight export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    recording: Annotated[Path, typer.Argument(help="A recording, `.mcap`.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The file, for `vtk` and `ros2` the folder, to write.")],
    form: Annotated[str, typer.Option("--format", help="`csv`, `parquet`, `npz`, `vtk` or `ros2`.")] = "csv",
) -> None:
    """Write the results of a recording in another format.

    tubesight export session.mcap --format csv -o shapes.csv
    """
    from tubesight.apps.live.export import FORMATS, export
    from tubesight.cli.console import stdout
    from tubesight.files.safe import unknown_name

    if form not in FORMATS:
        raise typer.BadParameter(unknown_name("format", form, FORMATS), param_hint="--format")
    done = export(recording, form, out)
    what = "messages" if form == "ros2" else "results"
    stdout().print(f"{done.results} {what} in {out}", soft_wrap=True)
