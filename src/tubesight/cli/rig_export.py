"""``tubesight rig-export``."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

# The names of `tubesight.files.exporters`, whose import would slow down `--help`; a test holds both together.
Format = enum.StrEnum("Format", ["opencv", "ros"])


def command(
    rig: Annotated[Path, typer.Argument(help="The rig: `rig.yaml`.")],
    format: Annotated[Format, typer.Option("--format", help="The tool to write for.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the files; made where there is none.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Write a rig for OpenCV (FileStorage, mm) or ROS (camera_info, metres).

    tubesight rig-export rig.yaml --format ros -o camera_info
    """
    from tubesight.apps.importing import export_rig
    from tubesight.cli.console import stdout
    from tubesight.files.tables import to_json

    files = export_rig(rig, format.value, out)
    if json:
        typer.echo(to_json({"format": format.value, "files": list(files)}))
    else:
        stdout().print(f"written: {', '.join(str(path) for path in files)}", soft_wrap=True)
