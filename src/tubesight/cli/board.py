"""``tubesight board``."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class _Type(StrEnum):
    chessboard = "chessboard"
    charuco = "charuco"


class _Sheet(StrEnum):
    a4 = "a4"
    letter = "letter"
    a3 = "a3"


def command(
    out: Annotated[Path, typer.Option("-o", "--out", help="The PDF; its `.yaml` goes beside it.")] = Path("board.pdf"),
    type_: Annotated[_Type, typer.Option("--type", help="Kind of board.")] = _Type.chessboard,
    squares: Annotated[str, typer.Option("--squares", metavar="COLUMNSxROWS", help="Number of squares.")] = "10x7",
    square_mm: Annotated[
        float | None, typer.Option("--square-mm", help="Side of a square.", show_default="the largest that fits")
    ] = None,
    marker_mm: Annotated[
        float | None, typer.Option("--marker-mm", help="Side of a ChArUco marker.", show_default="3/4 of a square")
    ] = None,
    dictionary: Annotated[
        str | None, typer.Option("--dictionary", help="Markers of a ChArUco board.", show_default="DICT_4X4_50")
    ] = None,
    sheet: Annotated[_Sheet, typer.Option("--sheet", help="Paper.", case_sensitive=False)] = _Sheet.a4,
    force: Annotated[bool, typer.Option("--force", help="Overwrite what is there.")] = False,
) -> None:
    """Make a calibration board to print, in exact millimetres, with rulers to check the print.

    tubesight board -o board.pdf
    """
    match = re.fullmatch(r"(\d{1,3})\s*[x,]\s*(\d{1,3})", squares)
    if match is None:
        raise typer.BadParameter(f"expected COLUMNSxROWS such as 10x7, got {squares!r}", param_hint="--squares")
    from tubesight.apps.board import BoardOptions, make_board
    from tubesight.cli.console import stdout

    counts = int(match[1]), int(match[2])
    made = make_board(BoardOptions(out, type_.value, counts, square_mm, marker_mm, dictionary, sheet.value, force))
    console = stdout()
    console.print(
        f"{made.pdf}: print it at 100 %, on {sheet.value}; both rulers have to measure 100 mm", soft_wrap=True
    )
    console.print(f"{made.yaml}: describes it; put the side of a square as measured there", soft_wrap=True)
