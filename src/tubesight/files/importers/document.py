"""One file of another tool as keys and values: YAML, JSON, XML or MATLAB, capped before it is parsed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from tubesight.core import Array, InputError
from tubesight.files.importers.mat import MAT_BYTES, is_mat, parse_mat
from tubesight.files.nested import one_line, parse_yaml, refuse_nesting
from tubesight.files.safe import read_bytes

# A calibration with its 100 views of 500 corners each takes 2 MiB as text.
_TEXT_BYTES = 4 << 20
# As in our own files; a storage of OpenCV's nests 4 deep.
_XML_DEPTH = 32

# No number of a calibration is that large; squares of larger ones overflow.
_HUGE = 1e12

_BRACKET = re.compile(r"[\[\]{}]")
# What OpenCV writes and YAML does not know: its header without a space, and the tags of its matrices. The marks between
# documents end what `rostopic echo` prints.
_NOT_YAML = re.compile(r"^%YAML.*$|!!opencv-[\w-]+|^(?:---|\.\.\.)[ \t]*$", re.MULTILINE)


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """Keys and values of a file, or of a mapping inside it.

    Attributes
    ----------
    path
        The file, for messages.
    data
        Values are mappings, lists, text, numbers or arrays.
    matlab
        Whether the file is a ``.mat``.
    where
        Name of the mapping inside the file with a dot behind it, for messages.
    """

    path: Path
    data: Mapping[str, Any]
    matlab: bool = False
    where: str = ""

    def refusal(self, key: str, message: str) -> InputError:
        """Return an error that names the file and the key."""
        return InputError(f"{self.path}: {self.where}{key}: {message}")

    def inner(self, key: str) -> Document:
        """Return the mapping under a key."""
        value = self.data.get(key)
        if not isinstance(value, Mapping):
            raise self.refusal(key, "expected keys and values; write the file again")
        return Document(self.path, _text_keys(value), self.matlab, f"{self.where}{key}.")

    def first(self, *keys: str) -> str | None:
        """Return the first of some keys that is there."""
        return next((key for key in keys if key in self.data), None)

    def text(self, *keys: str) -> str | None:
        """Text under the first of some keys that is there; None without one."""
        key = self.first(*keys)
        return str(self.data[key]).strip() if key is not None and self.data[key] is not None else None

    def array(self, key: str) -> Array:
        """Numbers under a key: a list, rows, an array, or a matrix of OpenCV's (``rows``, ``cols``, ``data``)."""
        if key not in self.data:
            raise self.refusal(key, "this key is missing; is the file complete?")
        try:
            values = _numbers(self.data[key])
        except (ValueError, TypeError, KeyError, OverflowError):
            raise self.refusal(key, "expected a number, a list or a matrix of numbers; write the file again") from None
        if not (np.abs(values) < _HUGE).all():
            raise self.refusal(key, "expected finite numbers; calibrate again")
        return values

    def matrix(self, key: str, rows: int, columns: int) -> Array:
        """Numbers under a key as a matrix, also where they are written one after the other, row by row."""
        values = self.array(key)
        if values.shape not in ((rows, columns), (rows * columns,), (1, rows * columns), (rows * columns, 1)):
            raise self.refusal(key, f"expected a {rows} x {columns} matrix, got {_shape(values)}; write the file again")
        return values.reshape(rows, columns)

    def vector(self, key: str, count: int | None = None) -> Array:
        """Numbers under a key as a vector."""
        values = self.array(key)
        if values.size != max(values.shape, default=1) or (count is not None and values.size != count):
            wanted = "a vector" if count is None else f"{count} numbers"
            raise self.refusal(key, f"expected {wanted}, got {_shape(values)}; write the file again")
        return values.reshape(-1)

    def size(self, key: str, other: str | None = None) -> tuple[int, int]:
        """Width and height under one key, or under a key each."""
        pair = self.vector(key, 2) if other is None else (self.vector(key, 1)[0], self.vector(other, 1)[0])
        if not all(1 <= n == int(n) for n in pair):
            raise self.refusal(key, "expected the width and height of the pictures in whole pixels; mend them")
        return int(pair[0]), int(pair[1])


def _text_keys(data: Mapping[Any, Any]) -> dict[str, Any]:
    """YAML takes a key `null` or `1` for what it says."""
    return {str(key): value for key, value in data.items()}


def _shape(values: Array) -> str:
    return " x ".join(str(n) for n in values.shape) or "one number"


def _numbers(value: Any) -> Array:
    if isinstance(value, Mapping):
        data = np.ravel(_numbers(value["data"]))
        # "2d" has two numbers an entry, "d" one; ROS gives no type.
        channels = int(re.match(r"\d*", str(value.get("dt", ""))).group() or 1)  # type: ignore[union-attr]
        sizes = np.ravel(value["sizes"] if "sizes" in value else (value["rows"], value["cols"])).astype(int)
        return data.reshape(*sizes[:-1], sizes[-1] * channels)
    values = np.asarray(value)
    if values.dtype.kind not in "iuf":
        raise TypeError("not numbers")
    return values.astype(np.float64)


def read_document(path: Path) -> Document:
    """Read a file of another tool; what it is shows in its content, not in its name.

    Raises
    ------
    InputError
        If the file is too large, too deeply nested, has entities or aliases, or is none of YAML, JSON, XML, MATLAB.
    """
    path = Path(path)
    raw = read_bytes(path, MAT_BYTES)
    if is_mat(raw):
        return Document(path, parse_mat(raw, path), matlab=True)
    if len(raw) > _TEXT_BYTES:
        raise InputError(f"{path}: {len(raw)} bytes is more than a calibration has as text; is it the right file?")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(
            f"{path}: neither text in UTF-8 nor a MATLAB file; name the file that the other tool wrote"
        ) from None
    start = text.lstrip()[:1]
    data = _xml(text, path) if start == "<" else _json(text, path) if start == "{" else _yaml(text, path)
    if not isinstance(data, dict) or not data:
        raise InputError(f"{path}: expected keys and values; name the file that the other tool wrote")
    return Document(path, _text_keys(data))


def _yaml(text: str, path: Path) -> Any:
    return parse_yaml(_NOT_YAML.sub("", text).replace(".Nan", ".nan"), path)


def _json(text: str, path: Path) -> Any:
    refuse_nesting(_BRACKET.finditer(text), path)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({one_line(str(error))}); write it again") from error


class _Xml:
    """Builds mappings from the XML of OpenCV: elements named ``_`` are entries of a list, all others keys."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.open: list[tuple[str, list[tuple[str, Any]], list[str]]] = [("", [], [])]

    def start(self, name: str, attributes: dict[str, str]) -> None:
        if len(self.open) > _XML_DEPTH:
            raise InputError(f"{self.path}: nested more than {_XML_DEPTH} deep; is it the right file?")
        self.open.append((name, [], []))

    def end(self, name: str) -> None:
        _, children, text = self.open.pop()
        self.open[-1][1].append((name, self.value(children, "".join(text).strip())))

    def text(self, data: str) -> None:
        self.open[-1][2].append(data)

    def entity(self, *_: Any) -> None:
        raise InputError(f"{self.path}: a document type and entities are not allowed in XML; remove them")

    def value(self, children: list[tuple[str, Any]], text: str) -> Any:
        if not children:
            return _leaf(text)
        if all(name == "_" for name, _ in children):
            return [value for _, value in children]
        made = dict(children)
        if len(made) < len(children):
            raise InputError(f"{self.path}: a key is there twice; write the file again")
        return made


def _xml(text: str, path: Path) -> Any:
    builder = _Xml(path)
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.text
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = builder.entity
    try:
        parser.Parse(text.encode("utf-8"), True)
    except expat.ExpatError as error:
        raise InputError(f"{path}: not XML ({one_line(str(error))}); write it again") from error
    return builder.open[0][1][0][1]


def _leaf(text: str) -> Any:
    """Text of an element: a number, a list of numbers, or text without its quotes."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return text.strip('"')
    return values[0] if len(values) == 1 else values
