"""A calibration board as a PDF of exact millimetres, with rulers to check the print."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from tubesight.core import Array

#: Sheets by name: shorter and longer side in mm (ISO 216; ANSI letter).
SHEETS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"a4": (210.0, 297.0), "letter": (215.9, 279.4), "a3": (297.0, 420.0)}
)
# PDF counts in points of 1/72 inch.
_POINTS_PER_MM = 72 / 25.4
# Borders around the squares in mm. Office printers leave 4 to 6 mm blank; left and below are the rulers and the text.
_LEFT, _TOP, _RIGHT, _BOTTOM = 22.0, 12.0, 8.0, 28.0
# Length of the rulers in mm: long enough that half a millimetre read off is half a percent, and fits every sheet.
RULER_MM = 100
# Size of the text and distance of its lines in mm.
_TEXT, _LINE = 2.6, 3.4
# Length of the arrows along the board's axes in mm, and their distance from the squares.
_ARROW, _ARROW_GAP = 12.0, 3.0


@dataclass(frozen=True, slots=True)
class BoardDrawing:
    """What is printed of a board.

    Attributes
    ----------
    black_mm
        Black rectangles (N, 4): x, y, width, height from the upper left corner of the board, y down.
    size_mm
        Width and height of all squares together.
    origin_mm
        (x, y) of the origin of the board frame, where the arrows start.
    text
        Lines below the board, 60 characters each at most.
    """

    black_mm: Array
    size_mm: tuple[float, float]
    origin_mm: tuple[float, float]
    text: tuple[str, ...]


def room_mm(sheet: str, landscape: bool) -> tuple[float, float]:
    """Width and height in mm that a sheet leaves for the squares."""
    width, height = _sides(sheet, landscape)
    return width - _LEFT - _RIGHT, height - _TOP - _BOTTOM


def place_mm(size_mm: tuple[float, float], sheet: str, landscape: bool) -> tuple[float, float]:
    """Upper left corner of the squares on the sheet in mm, y down; raises `ValueError` where they do not fit."""
    room = room_mm(sheet, landscape)
    if any(size > space + 1e-9 for size, space in zip(size_mm, room, strict=True)):
        raise ValueError(
            f"{size_mm[0]:g} x {size_mm[1]:g} mm of squares do not fit the {room[0]:g} x {room[1]:g} mm of {sheet}"
        )
    return _LEFT + (room[0] - size_mm[0]) / 2, _TOP + (room[1] - size_mm[1]) / 2


def board_pdf(drawing: BoardDrawing, sheet: str, landscape: bool) -> bytes:
    """Draw a board on a sheet.

    All rectangles make one path that is filled once, so that neighbours meet without a gap on every screen and printer.
    The file asks viewers not to scale it (``PrintScaling None``), which Acrobat follows and others ignore.

    Raises
    ------
    ValueError
        If the board does not fit the sheet.
    """
    width, height = _sides(sheet, landscape)
    left, top = place_mm(drawing.size_mm, sheet, landscape)
    marks = [f"{_POINTS_PER_MM:.12f} 0 0 {-_POINTS_PER_MM:.12f} 0 {height * _POINTS_PER_MM:.9f} cm", "0 g 0 G"]
    marks += [f"{left + x:.6f} {top + y:.6f} {w:.6f} {h:.6f} re" for x, y, w, h in drawing.black_mm.tolist()]
    marks.append("f")
    marks += _ruler(_LEFT, height - 22, across=True) + _ruler(8.0, _TOP, across=False)
    marks += _arrows(left, top, drawing.origin_mm)
    first = height - 25
    marks += [_text(_LEFT + RULER_MM + 8, first + i * _LINE, line) for i, line in enumerate(drawing.text)]
    return _file("\n".join(marks), width * _POINTS_PER_MM, height * _POINTS_PER_MM)


def _sides(sheet: str, landscape: bool) -> tuple[float, float]:
    short, long = SHEETS[sheet]
    return (long, short) if landscape else (short, long)


def _text(x: float, y: float, text: str) -> str:
    """Set a line of text; the axis y points down, so letters are turned back upright."""
    escaped = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    return f"BT /F {_TEXT} Tf 1 0 0 -1 {x:.3f} {y:.3f} Tm ({escaped}) Tj ET"


def _segments(segments: Iterable[tuple[float, float, float, float]]) -> str:
    return "0.15 w " + " ".join(f"{a:.6f} {b:.6f} m {c:.6f} {d:.6f} l" for a, b, c, d in segments) + " S"


def _ruler(x: float, y: float, across: bool) -> list[str]:
    """Draw a ruler with millimetres that starts at (x, y)."""
    lines: list[tuple[float, float, float, float]] = [(0, 0, RULER_MM, 0)]
    lines += [(mm, 0, mm, 4 if mm % 10 == 0 else 3 if mm % 5 == 0 else 2) for mm in range(RULER_MM + 1)]
    turned = lines if across else [(b, a, d, c) for a, b, c, d in lines]
    marks = [_segments((x + a, y + b, x + c, y + d) for a, b, c, d in turned)]
    end = f"{RULER_MM} mm"
    if across:
        return [*marks, _text(x - 0.7, y + 7.5, "0"), _text(x + RULER_MM - 8, y + 7.5, end)]
    return [*marks, _text(x, y - 1, "0"), _text(x, y + RULER_MM + 3.2, end)]


def _arrows(left: float, top: float, origin_mm: tuple[float, float]) -> list[str]:
    """Draw an arrow along the board's x above the squares and along its y left of them, from the origin on."""
    x, y = left + origin_mm[0], top + origin_mm[1]
    above, beside = top - _ARROW_GAP, left - _ARROW_GAP
    along_x = [(x, above, x + _ARROW, above)] + [(x + _ARROW - 2, above + d, x + _ARROW, above) for d in (-1, 1)]
    along_y = [(beside, y, beside, y + _ARROW)] + [(beside + d, y + _ARROW - 2, beside, y + _ARROW) for d in (-1, 1)]
    labels = [_text(x + _ARROW + 1, above + 0.9, "x"), _text(beside - 0.6, y + _ARROW + 2.8, "y")]
    return [_segments(along_x + along_y), *labels]


def _file(content: str, width: float, height: float) -> bytes:
    """Wrap the marks of one page into a PDF 1.7 file (ISO 32000-1, 7.5)."""
    stream = content.encode("latin-1", "replace")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.6f} {height:.6f}] /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    data, offsets = b"%PDF-1.7\n", []
    for number, body in enumerate(objects, start=1):
        offsets.append(len(data))
        data += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    count = len(objects) + 1
    end = b"xref\n0 %d\n0000000000 65535 f \n%strailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n"
    return data + end % (count, table, count, len(data))
