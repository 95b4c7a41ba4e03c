"""Options that the commands with running cameras share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.live.options import PictureMode

SourceOption = Annotated[
    list[str],
    typer.Option(
        "--source",
        metavar="CAMERA=SOURCE",
        help="Per camera: an index, `/dev/video0`, `usb:NAME`, `http://...`, `rtsp://...`, a video, a folder of "
        "pictures, a recording, `sim:`, or `fault:SCRIPT:SOURCE`.",
    ),
]
SizeOption = Annotated[
    str | None, typer.Option("--size", metavar="WIDTHxHEIGHT", help="Size of picture to ask the cameras for.")
]

RigOption = Annotated[
    Path | None, typer.Option("--rig", help="The cameras: `rig.yaml`. Simulated cameras alone need none.")
]
TubeOption = Annotated[Path | None, typer.Option("--tube", help="What is known of the tube: `tube.yaml`.")]
BackgroundOption = Annotated[
    Path | None, typer.Option("--background", help="Pictures without the tube, one subfolder per camera.")
]
BaseOption = Annotated[
    list[str] | None, typer.Option("--base", metavar="CAMERA:X,Y ...", help="Pixel of the tube's base in each camera.")
]
TipOption = Annotated[
    list[str] | None,
    typer.Option(
        "--tip",
        metavar="CAMERA:X,Y ...",
        help="Pixel of the tube's tip at the start: follow this one of several devices.",
    ),
]
GrayOption = Annotated[bool, typer.Option("--gray", help="Do without colour: pictures decode faster.")]
ToleranceOption = Annotated[
    float, typer.Option("--tolerance", min=0, help="Largest difference between the times of a pair, ms.")
]
OffsetOption = Annotated[
    list[str] | None,
    typer.Option("--offset", metavar="CAMERA=MS", help="Constant delay of a camera's times, ms; repeat."),
]
SecondsOption = Annotated[float | None, typer.Option("--seconds", min=0, help="Stop after so long.")]
PicturesOption = Annotated[
    str,
    typer.Option(
        "--pictures",
        help="Pictures to record: `lossless` (as the camera coded them, else pixels), `jpeg`, `crop` or `none`.",
    ),
]
IgtlOption = Annotated[
    str | None, typer.Option("--igtl", metavar="[HOST:]PORT", help="Serve results by OpenIGTLink (18944).")
]
WebsocketOption = Annotated[
    str | None, typer.Option("--websocket", metavar="[HOST:]PORT", help="Serve results as JSON (8765).")
]
UdpOption = Annotated[
    str | None, typer.Option("--udp", metavar="[HOST:]PORT", help="Send results as JSON datagrams (8766).")
]
ViewOption = Annotated[
    int | None, typer.Option("--view", metavar="PORT", help="Show everything in the browser (8080).", min=0)
]
EveryOption = Annotated[int, typer.Option("--every", min=1, help="Record the pictures of every n-th pair.")]


def pictures_of(text: str) -> PictureMode:
    """Read which pictures to record; wrong usage where it is none of them."""
    modes: tuple[PictureMode, ...] = ("lossless", "jpeg", "crop", "none")
    for mode in modes:
        if text == mode:
            return mode
    raise typer.BadParameter(f"expected one of {', '.join(modes)}, got {text!r}", param_hint="--pictures")


def sources_of(texts: Sequence[str]) -> dict[str, str]:
    """Split sources by camera; wrong usage where one is no ``CAMERA=SOURCE``."""
    sources: dict[str, str] = {}
    for text in texts:
        name, equals, source = text.partition("=")
        if not (equals and name and source):
            raise typer.BadParameter(f"expected CAMERA=SOURCE such as left=0, got {text!r}", param_hint="--source")
        if name in sources:
            raise typer.BadParameter(f"camera {name!r} is there twice", param_hint="--source")
        sources[name] = source
    return sources


def size_of(text: str | None) -> tuple[int, int] | None:
    """Read width and height; wrong usage where they are not ``WIDTHxHEIGHT``."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text)
    if match is None:
        raise typer.BadParameter(f"expected WIDTHxHEIGHT such as 1920x1080, got {text!r}", param_hint="--size")
    return int(match[1]), int(match[2])


def offsets_of(texts: Sequence[str]) -> dict[str, float]:
    """Read seconds by camera from ``CAMERA=MILLISECONDS``."""
    offsets: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            offsets[name] = float(value) / 1e3
        except ValueError:
            raise typer.BadParameter(
                f"expected CAMERA=MILLISECONDS such as right=12.5, got {text!r}", param_hint="--offset"
            ) from None
    return offsets
