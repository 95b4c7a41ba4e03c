"""Calibration boards, in the board frames of the file formats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from tubesight.core.arrays import Array

BoardType = Literal["chessboard", "charuco"]


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard or ChArUco board, counted in squares.

    Attributes
    ----------
    type
        ``chessboard`` or ``charuco``.
    squares
        (columns, rows) of squares; the inner corners are one fewer each way.
    square_mm
        Side of a square.
    marker_mm, dictionary
        ChArUco only: side of a marker, name of the ArUco dictionary (``DICT_4X4_50`` ...).
    """

    type: BoardType
    squares: tuple[int, int]
    square_mm: float
    marker_mm: float | None = None
    dictionary: str | None = None

    def __post_init__(self) -> None:
        if self.type not in ("chessboard", "charuco"):
            raise ValueError(f"board type: expected chessboard or charuco, got {self.type!r}")
        if min(self.squares) < 3:
            raise ValueError(f"squares: expected at least 3 columns and 3 rows, got {self.squares}")
        if not self.square_mm > 0:
            raise ValueError(f"square_mm: expected a positive number, got {self.square_mm}")
        if self.type == "charuco":
            if self.marker_mm is None or not 0 < self.marker_mm < self.square_mm:
                raise ValueError(f"marker_mm: expected a number between 0 and square_mm, got {self.marker_mm}")
            if not self.dictionary:
                raise ValueError("a charuco board needs its dictionary, for example DICT_4X4_50")

    @property
    def inner_corners(self) -> tuple[int, int]:
        """(columns, rows) of inner corners."""
        return self.squares[0] - 1, self.squares[1] - 1

    @property
    def corners_mm(self) -> Array:
        """Inner corners (N, 3) in the board frame, row by row, z = 0.

        Chessboard: origin at the first inner corner. ChArUco: origin at the board's outer corner, the first inner
        corner at (square, square, 0). z points away from the viewer in both.
        """
        columns, rows = self.inner_corners
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        first = 1 if self.type == "charuco" else 0
        grid = np.stack([x + first, y + first, np.zeros_like(x)], -1).reshape(-1, 3)
        return np.asarray(grid * self.square_mm, dtype=np.float64)
