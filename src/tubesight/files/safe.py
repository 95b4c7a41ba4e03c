"""Reading text, YAML, JSON and CSV that nobody vouches for; writing files whole or not at all."""

from __future__ import annotations

import contextlib
import csv
import difflib
import io
import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from tubesight.core import InputError
from tubesight.files.nested import one_line, parse_yaml, refuse_nesting

# Hand-written files have a few dozen lines; a rig with the corners of 100 board pictures has about 2 MiB.
TEXT_BYTES = 1 << 20

_JSON_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[\[\]{}]')

Model = TypeVar("Model", bound=BaseModel)


class Strict(BaseModel):
    """Schema of a mapping in a file: unknown keys and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise ValueError(unknown_name("key", str(key), cls.model_fields))
        return data


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """Say that a name is not known, and which known one is nearest."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
    return f"unknown {kind} {name[:60]!r}; {hint}"


def read_bytes(path: Path, limit: int) -> bytes:
    """Read a file of at most `limit` bytes; raise `InputError` where there is none or it is larger."""
    path = Path(path)
    try:
        if path.is_dir():
            raise InputError(f"{path}: this is a folder; name a file")
        if not path.exists():
            raise InputError(f"{path}: no such file; {_near_file(path)}")
        if not path.is_file():
            raise InputError(f"{path}: not a regular file; name a file")
        size = path.stat().st_size
        if size > limit:
            raise InputError(f"{path}: {size} bytes is more than such a file can have ({limit}); is it the right file?")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); check the path and its permissions") from error


def _near_file(path: Path) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent} either; check the path"
    near = difflib.get_close_matches(path.name, sorted(os.listdir(path.parent)), n=1, cutoff=0.6)
    return f"did you mean {near[0]!r}?" if near else "check the path"


def read_text(path: Path, limit: int = TEXT_BYTES) -> str:
    """Read UTF-8 text, capped in size before it is read."""
    try:
        text = read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text; save it as plain text in UTF-8") from error
    if not text.strip():
        raise InputError(f"{path}: the file is empty; write it again")
    return text


def load_yaml(path: Path, model: type[Model], limit: int = TEXT_BYTES) -> Model:
    """Read a YAML file into a schema."""
    return validate(parse_yaml(read_text(path, limit), path), model, path)


def load_json(path: Path, model: type[Model], limit: int = TEXT_BYTES) -> Model:
    """Read a JSON file into a schema."""
    text = read_text(path, limit)
    refuse_nesting(_JSON_TOKEN.finditer(text), path)
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({one_line(str(error))}); mend it or write it again") from error
    return validate(data, model, path)


def load_csv(path: Path, limit: int = TEXT_BYTES) -> tuple[list[str], list[dict[str, str]]]:
    """Read a CSV file with a header line: its columns, and a mapping per row that is not empty; cells are stripped."""
    text = read_text(path, limit)
    try:
        table = [[cell.strip() for cell in row] for row in csv.reader(io.StringIO(text), strict=True)]
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV table ({error}); mend it or write it again") from error
    header = table[0]
    for column in header:
        if header.count(column) > 1:
            raise InputError(f"{path}: the column {column!r} is there twice; remove one")
    rows = []
    for line, row in enumerate(table[1:], start=2):
        if not any(row):
            continue
        if len(row) != len(header):
            raise InputError(
                f"{path}: row {line} has {len(row)} cells where the header has {len(header)}; mend that row"
            )
        rows.append(dict(zip(header, row, strict=True)))
    return header, rows


def number(cell: str, path: Path, where: str) -> float:
    """Turn a cell into a number, NaN where it is empty."""
    if not cell:
        return float("nan")
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"{path}: {where}: expected a number or an empty cell, got {cell[:40]!r}")
    return value


def validate(data: Any, model: type[Model], path: Path) -> Model:
    """Check parsed data against a schema; the first thing wrong becomes the one line of an `InputError`."""
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected keys and values ({', '.join(model.model_fields)}), got {_kind(data)}")
    try:
        return model.model_validate(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        first = details[0]
        where = ".".join(str(part) for part in first["loc"])
        more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
        raise InputError(f"{path}: {where + ': ' if where else ''}{_describe(first)}{more}") from error


def refuse(path: Path, error: ValueError) -> NoReturn:
    """Turn what a constructor objects to into an `InputError` that names the file."""
    raise InputError(f"{path}: {one_line(str(error))}") from error


def write_atomic(path: Path, data: bytes | str) -> None:
    """Write a file whole or not at all: to a temporary neighbour, then moved into place. Makes missing folders."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _describe(error: Any) -> str:
    kind, value = error["type"], error["input"]
    if kind == "missing":
        return "this key is missing; add it"
    if kind == "value_error":
        return one_line(str(error["ctx"]["error"]))
    if kind == "finite_number":
        return f"expected a finite number, got {value}; measure or calibrate again"
    message = error["msg"].replace("Input should be", "expected").replace("List should have", "expected")
    return one_line(f"{message}, got {_kind(value)}")


def _kind(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    return repr(value)[:60]
