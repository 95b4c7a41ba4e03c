"""``tubesight board``: a board to print, and the file that describes it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tubesight.calibration.find import ambiguity, charuco_board, check_board
from tubesight.core import Array, Board, InputError
from tubesight.core.board import BoardType
from tubesight.files.safe import unknown_name, write_atomic
from tubesight.outputs.board_pdf import SHEETS, BoardDrawing, board_pdf, room_mm

# An even number of columns and an odd number of rows: no two sides of the chessboard look alike.
DEFAULT_SQUARES = (10, 7)
# Side of a marker in squares: OpenCV finds markers by the white rim that an eighth of a square leaves on each side.
_MARKER_SHARE = 0.75
DEFAULT_DICTIONARY = "DICT_4X4_50"


@dataclass(frozen=True, slots=True)
class BoardOptions:
    """What to print.

    Attributes
    ----------
    out
        The PDF; ``board.yaml`` goes beside it, under the same stem.
    type
        ``chessboard`` or ``charuco``.
    squares
        (columns, rows).
    square_mm
        Side of a square; None for the largest whole number of millimetres that fits the sheet.
    marker_mm, dictionary
        ChArUco only; None for three quarters of a square and ``DICT_4X4_50``.
    sheet
        ``a4``, ``letter`` or ``a3``.
    force
        Whether to overwrite what is there.
    """

    out: Path
    type: BoardType = "chessboard"
    squares: tuple[int, int] = DEFAULT_SQUARES
    square_mm: float | None = None
    marker_mm: float | None = None
    dictionary: str | None = None
    sheet: str = "a4"
    force: bool = False


@dataclass(frozen=True, slots=True)
class PrintedBoard:
    """A board that was drawn: it, the PDF, and the file that describes it."""

    board: Board
    pdf: Path
    yaml: Path


def make_board(options: BoardOptions) -> PrintedBoard:
    """Write the PDF and the board file.

    Raises
    ------
    InputError
        If there is no such board, it does not fit the sheet, its chessboard looks alike from two sides, or a file is
        there already.
    """
    out = options.out
    description = out.with_suffix(".yaml")
    if out.suffix.lower() != ".pdf":
        raise InputError(f"{out}: the board is a PDF; name a file that ends in .pdf")
    taken = [path for path in (out, description) if path.exists() and not options.force]
    if taken:
        raise InputError(f"{taken[0]}: is there already; take another name with -o, or --force to overwrite it")
    try:
        board, landscape = _board(options)
    except ValueError as error:
        raise InputError(f"{out}: {error}") from error
    drawing = BoardDrawing(black_mm(board), _size_mm(board), _origin_mm(board), _text(board, out.stem))
    write_atomic(out, board_pdf(drawing, options.sheet, landscape))
    write_atomic(description, board_text(board))
    return PrintedBoard(board, out, description)


def _board(options: BoardOptions) -> tuple[Board, bool]:
    """Return the board and whether the sheet lies on its longer side; ValueError where there is none."""
    if options.sheet not in SHEETS:
        raise ValueError(unknown_name("sheet", options.sheet, SHEETS))
    columns, rows = options.squares
    if min(columns, rows) < 3:
        raise ValueError(f"--squares: expected at least 3 columns and 3 rows, got {columns} x {rows}")
    landscape = columns > rows
    room = room_mm(options.sheet, landscape)
    largest = min(room[0] / columns, room[1] / rows)
    square = options.square_mm if options.square_mm is not None else float(math.floor(largest))
    if square > largest:
        raise ValueError(
            f"{columns} x {rows} squares of {square:g} mm do not fit {options.sheet}; take --square-mm "
            f"{math.floor(10 * largest) / 10:g} at most, or a larger --sheet"
        )
    if options.square_mm is None and square == 0:
        raise ValueError(
            f"{columns} x {rows} squares are too many for {options.sheet}; take fewer, or give --square-mm"
        )
    charuco = options.type == "charuco"
    if not charuco and (options.marker_mm is not None or options.dictionary is not None):
        raise ValueError("only a ChArUco board has markers; add --type charuco, or leave their options out")
    marker = options.marker_mm if options.marker_mm is not None else round(_MARKER_SHARE * square, 1)
    markers = (marker, options.dictionary or DEFAULT_DICTIONARY) if charuco else (None, None)
    board = Board(options.type, options.squares, square, *markers)
    check_board(board)
    if ambiguity(board):
        raise ValueError(ambiguity(board))
    return board, landscape


def _size_mm(board: Board) -> tuple[float, float]:
    return board.squares[0] * board.square_mm, board.squares[1] * board.square_mm


def _origin_mm(board: Board) -> tuple[float, float]:
    """Origin of the board frame from the outer corner: see the file formats."""
    first = 0.0 if board.type == "charuco" else board.square_mm
    return first, first


def black_mm(board: Board) -> Array:
    """Black rectangles (N, 4) of a board: x, y, width, height in mm from its upper left outer corner, y down.

    The first square of a chessboard is white, so that the side with two white corner squares is on the left (with an
    even number of columns and an odd number of rows); that of a ChArUco board is black, as OpenCV draws it.
    """
    columns, rows = board.squares
    square = board.square_mm
    first = 0 if board.type == "charuco" else 1
    black = [
        (column * square, row * square, square, square)
        for row in range(rows)
        for column in range(columns)
        if (row + column) % 2 == first
    ]
    return np.array(black + (_markers_mm(board) if board.type == "charuco" else []), dtype=np.float64)


def _markers_mm(board: Board) -> list[tuple[float, float, float, float]]:
    """Black cells of the markers, neighbours in a row joined."""
    drawn = charuco_board(board)
    dictionary = drawn.getDictionary()
    count = dictionary.markerSize + 2
    cell = float(board.marker_mm or 0.0) / count
    found = []
    for marker, corners in zip(np.ravel(drawn.getIds()), drawn.getObjPoints(), strict=True):
        # OpenCV keeps corners in single precision: take the square they lie in, and its middle from exact numbers.
        column, row = np.floor(np.mean(corners, 0)[:2] / board.square_mm)
        left, top = ((k + 0.5) * board.square_mm - count * cell / 2 for k in (float(column), float(row)))
        bits = dictionary.generateImageMarker(int(marker), count, borderBits=1) < 128
        for i, line in enumerate(bits):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(int)))
            pairs = edges.reshape(-1, 2).tolist()
            found += [(left + a * cell, top + i * cell, (b - a) * cell, cell) for a, b in pairs]
    return found


def _what(board: Board) -> str:
    columns, rows = board.squares
    name = "ChArUco" if board.type == "charuco" else "chessboard"
    return f"{name}, {columns} x {rows} squares of {board.square_mm:g} mm"


def _text(board: Board, name: str) -> tuple[str, ...]:
    charuco = board.type == "charuco"
    markers = (f"markers of {board.marker_mm:g} mm, {board.dictionary}",) if charuco else ()
    return (
        f"tubesight board {name[:40]}",
        _what(board),
        *markers,
        f"origin: {'outer corner' if charuco else 'first inner corner'}, z into the sheet",
        "Print at 100 %, not fitted to the page. Both rulers have",
        "to measure 100 mm, or correct square_mm in the file.",
    )


def board_text(board: Board) -> str:
    """``board.yaml`` with comments."""
    columns, rows = board.squares
    lines = [
        "# The calibration board. Measure the print: over all columns, divided by their number, is square_mm.",
        f"type: {board.type:19}# chessboard or charuco",
        f"squares: {f'[{columns}, {rows}]':16}# columns, rows of squares (not of corners)",
        f"square_mm: {board.square_mm!r:14}# side of a square as printed",
    ]
    if board.type == "charuco":
        lines += [
            f"marker_mm: {board.marker_mm!r:14}# side of a marker, its black border counted",
            f"dictionary: {board.dictionary}",
        ]
    return "\n".join(lines) + "\n"
