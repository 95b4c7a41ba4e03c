"""MATLAB's ``.mat`` files of version 5 to 7: numbers, text and structs, everything else passed over.

The layout is that of MathWorks' "MAT-File Format": elements of a type, a size and data, of which an array has its
flags, its dimensions, its name and its values. Read here because `scipy.io.loadmat` ends the process (segmentation
fault, SciPy 1.17) on a file with a changed byte, and makes gigabytes of a small file that only declares them.
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.core import Array, InputError

# A workspace with the corners of 100 views has about 5 MiB.
MAT_BYTES = 16 << 20
# The whole content of the file once it is inflated.
_INFLATED_BYTES = 64 << 20
# Elements next to each other: a variable has 4, a struct two a field and entry.
_ELEMENTS = 100_000
# The structs of MATLAB's calibration nest 4 deep.
_DEPTH = 16

_HEADER_BYTES = 128
# Types of elements.
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXT = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
# Classes of arrays: 6 to 15 are numbers, of whatever type they are stored as.
_STRUCT, _CHARACTERS, _FIRST_NUMBER, _LAST_NUMBER = 2, 4, 6, 15


def is_mat(raw: bytes) -> bool:
    """Tell whether a file is one of MATLAB's, of any version."""
    return raw.startswith((b"MATLAB ", b"\x89HDF\r\n")) or raw[126:128] in (b"IM", b"MI")


def parse_mat(raw: bytes, path: Path) -> dict[str, Any]:
    """Variables of a ``.mat`` file: structs as mappings, text as text, numbers as arrays, None for what is else.

    Raises
    ------
    InputError
        If the file is of another version, is damaged, or holds more than a calibration can have.
    """
    if raw[124:128] not in (b"\x00\x01IM", b"\x01\x00MI"):
        raise InputError(f"{path}: not a MATLAB file of version 5 to 7; in MATLAB, save it again with -v7")
    order = "<" if raw[126:128] == b"IM" else ">"
    try:
        return _variables(memoryview(raw)[_HEADER_BYTES:], order)
    except _Oversized as error:
        raise InputError(f"{path}: {error}, more than a calibration has; is it the right file?") from error
    except (ValueError, IndexError, struct.error, zlib.error) as error:
        raise InputError(f"{path}: this MATLAB file is damaged or cut off; save it again") from error


class _Oversized(Exception):
    """The file holds more than a calibration can have."""


def _variables(body: memoryview, order: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    budget = _INFLATED_BYTES
    for kind, content in _elements(body, order):
        if kind == _COMPRESSED:
            content = memoryview(zlib.decompressobj().decompress(content, budget + 1))
            budget -= len(content)
            if budget < 0:
                raise _Oversized(f"it inflates to over {_INFLATED_BYTES >> 20} MiB")
            kind, content = _elements(content, order)[0]
        if kind == _MATRIX:
            name, value = _array(content, order, 0)
            found[name] = value
    return found


def _elements(body: memoryview, order: str) -> list[tuple[int, memoryview]]:
    """Split data into its elements: type and content; short ones hold up to 4 bytes in their own tag."""
    found: list[tuple[int, memoryview]] = []
    at = 0
    while at < len(body):
        if len(found) == _ELEMENTS:
            raise _Oversized(f"it has over {_ELEMENTS} elements next to each other")
        kind, size = struct.unpack_from(order + "II", body, at)
        start = at + 8
        if kind >> 16:
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
        if start + size > len(body):
            raise ValueError("cut off")
        found.append((kind, body[start : start + size]))
        # Data is padded to 8 bytes, but not when it is compressed.
        at = start + size + (0 if kind == _COMPRESSED else -(start + size) % 8)
    return found


def _array(content: memoryview, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of an array."""
    if depth > _DEPTH:
        raise _Oversized(f"it is nested more than {_DEPTH} deep")
    if not content:
        return "", None
    (_, flags), *parts = _elements(content, order)
    kind = struct.unpack_from(order + "I", flags)[0] & 0xFF
    if kind != _STRUCT and kind != _CHARACTERS and not _FIRST_NUMBER <= kind <= _LAST_NUMBER:
        # Cells, functions and objects; the last have no dimensions, and a name where those would be.
        return _decoded(parts[1 if parts[0][0] in (5, 6) else 0], order), None
    shape = tuple(int(n) for n in _numbers(parts[0], order))
    name = _decoded(parts[1], order)
    if kind == _STRUCT:
        return name, _struct(parts[2:], order, shape, depth)
    if kind == _CHARACTERS:
        return name, _decoded(parts[2], order) if len(parts) > 2 else ""
    return name, _numbers(parts[2], order).reshape(shape, order="F") if len(parts) > 2 else np.empty(0)


def _struct(
    parts: list[tuple[int, memoryview]], order: str, shape: tuple[int, ...], depth: int
) -> dict[str, Any] | None:
    """Fields of one struct; None for an array of several."""
    if math.prod(shape) != 1:
        return None
    width = int(_numbers(parts[0], order)[0])
    text = bytes(parts[1][1])
    names = [text[at : at + width].partition(b"\0")[0].decode("latin-1") for at in range(0, len(text), max(width, 1))]
    return {name: _array(content, order, depth + 1)[1] for name, (_, content) in zip(names, parts[2:], strict=True)}


def _numbers(part: tuple[int, memoryview], order: str) -> Array:
    kind, content = part
    if kind not in _NUMBERS:
        raise ValueError("not numbers")
    return np.frombuffer(content, np.dtype(order + _NUMBERS[kind])).astype(np.float64)


def _decoded(part: tuple[int, memoryview], order: str) -> str:
    kind, content = part
    if kind not in _TEXT:
        raise ValueError("not text")
    coding = _TEXT[kind]
    return bytes(content).decode(
        coding if coding in ("utf-8", "latin-1") else f"{coding}-{'le' if order == '<' else 'be'}"
    )
