"""``tubesight import``."""

from __future__ import annotations

import enum
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.importing import Imported

_SIZE = re.compile(r"(\d{1,6})[xX](\d{1,6})")

# The names of `tubesight.files.importers`, whose import would slow down `--help`; a test holds both together.
Format = enum.StrEnum("Format", ["kalibr", "ros", "opencv", "bouguet", "matlab"])
Unit = enum.StrEnum("Unit", [("mm", "mm"), ("cm", "cm"), ("m", "m"), ("in", "in")])
Lens = enum.StrEnum("Lens", ["brown", "rational", "equidistant"])


def command(
    files: Annotated[list[Path], typer.Argument(help="Files of the other tool, the first camera's first.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The rig file to write.")],
    format: Annotated[
        Format | None, typer.Option("--format", help="The format; told from the content by default.")
    ] = None,
    names: Annotated[str | None, typer.Option("--names", help="Names of the cameras: `left,right`.")] = None,
    size: Annotated[
        list[str] | None,
        typer.Option("--size", help="Width and height of the pictures: `1920x1080`; once, or once for each camera."),
    ] = None,
    units: Annotated[Unit | None, typer.Option("--units", help="Unit of the lengths in the files.")] = None,
    lens: Annotated[Lens | None, typer.Option("--lens", help="The lens, where the files leave it open.")] = None,
    first_pixel: Annotated[
        int | None,
        typer.Option("--first-pixel", min=0, max=1, help="Where the files count pixels from: 0, or 1 as in MATLAB."),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Make a rig file from the calibration of another tool.

    OpenCV (yml, xml, json), ROS camera_info, Kalibr, Bouguet's toolbox and MATLAB; told from the content. The base
    frame is the first camera's until `tubesight register`.

        tubesight import left.yaml right.yaml -o rig.yaml

        tubesight import intrinsics.yml extrinsics.yml --size 1920x1080 -o rig.yaml
    """
    sizes = tuple(_size(text) for text in size or ())
    named = tuple(name.strip() for name in names.split(",")) if names else ()
    from tubesight.apps.importing import import_files
    from tubesight.files.importers import Settings

    settings = Settings(named, sizes, units and units.value, lens and lens.value, first_pixel)
    _show(import_files(files, out, settings, format and format.value), json)


def _size(text: str) -> tuple[int, int]:
    match = _SIZE.fullmatch(text.strip())
    if match is None:
        raise typer.BadParameter(f"expected WIDTHxHEIGHT as in 1920x1080, got {text!r}", param_hint="--size")
    return int(match[1]), int(match[2])


def _show(imported: Imported, json: bool) -> None:
    from tubesight.cli.console import fixed, remark, stdout, table
    from tubesight.files.tables import to_json

    if json:
        typer.echo(to_json(imported.as_dict()))
        return
    console, baselines = stdout(), imported.baselines_mm
    shown = table(("camera", "lens", "size\n[px]", "focal\n[px]", "from first\n[mm]"), texts=2)
    for name, camera in imported.rig.cameras.items():
        size = " x ".join(str(n) for n in camera.size_px)
        shown.add_row(name, camera.lens, size, fixed(camera.focal_px, 1), fixed(baselines.get(name, float("nan")), 2))
    console.print(shown)
    console.print(f"format: {imported.format}")
    remark(f"note: {line}" for line in imported.notes)
    console.print(f"next: {imported.next_step}", soft_wrap=True)
    console.print(f"written: {imported.path}", soft_wrap=True)
