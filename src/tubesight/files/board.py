"""``board.yaml``: the calibration board."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import PositiveFloat, PositiveInt

from tubesight.core import Board
from tubesight.files.safe import Strict, load_yaml, refuse


class _BoardFile(Strict):
    type: Literal["chessboard", "charuco"]
    squares: tuple[PositiveInt, PositiveInt]
    square_mm: PositiveFloat
    marker_mm: PositiveFloat | None = None
    dictionary: str | None = None


def load_board(path: Path) -> Board:
    """Read ``board.yaml``; raise `InputError` where it does not describe a board."""
    file = load_yaml(path, _BoardFile)
    try:
        return Board(file.type, file.squares, file.square_mm, file.marker_mm, file.dictionary)
    except ValueError as error:
        refuse(path, error)
