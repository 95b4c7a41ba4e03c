"""Searching the board in all pictures, giving up early where there is none."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from tubesight.calibration.corners import Corners, continues_beyond
from tubesight.calibration.errors import CalibrationError
from tubesight.calibration.find import find_corners
from tubesight.core import Board, Image

# Chessboard pictures looked at, over all cameras, in each of at most two rounds before a folder without boards is
# refused: a failing search takes 0.4 s. And the number of boards that lets the search go on.
_SAMPLE, _ENOUGH = 6, 2
# Pictures searched again at full size (1 s each); boards missed there are found from the other cameras' poses.
_MAX_AGAIN = 8
# Threads: OpenCV releases the interpreter lock; more than four only wait for memory.
_MAX_THREADS = 4

Pictures = Mapping[str, Mapping[str, Callable[[], Image]]]
"""By camera and view: a function that loads the picture (gray or BGR, 8 bit)."""

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many are done and how many there are."""

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A picture that was not used, or not fully, and why."""

    camera: str
    view: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Boards found.

    Attributes
    ----------
    corners
        By camera and view; cameras without any board have an empty mapping.
    sizes_px
        (width, height) by camera.
    left_out
        Pictures without a usable board.
    """

    corners: Mapping[str, Mapping[str, Corners]]
    sizes_px: Mapping[str, tuple[int, int]]
    left_out: tuple[LeftOut, ...]


def gray_of(load: Callable[[], Image]) -> Image:
    """Load a picture as gray."""
    image = load()
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def in_threads(function: Callable[[T], R], items: Sequence[T], done: Callable[[int], None]) -> list[R]:
    """Map in a few threads, in order, reporting how many are done."""
    results = []
    with ThreadPoolExecutor(min(_MAX_THREADS, os.cpu_count() or 1)) as pool:
        for i, result in enumerate(pool.map(function, items)):
            results.append(result)
            done(i + 1)
    return results


def search(pictures: Pictures, board: Board, progress: Progress) -> Search:
    """Find the board in all pictures.

    Raises
    ------
    CalibrationError
        If a camera's pictures differ in size, no sampled picture shows the board, or the pictures show a larger one.
    """
    found: dict[tuple[str, str], Corners | None] = {}
    sizes: dict[str, tuple[str, tuple[int, int]]] = {}
    beyond: list[tuple[str, str]] = []

    def look(keys: Iterable[tuple[str, str]], again: bool) -> None:
        wanted = list(keys)
        label = "searching boards at full size" if again else "searching boards"
        looked = in_threads(
            lambda key: _look(gray_of(pictures[key[0]][key[1]]), board, again),
            wanted,
            lambda n: progress(label, n, len(wanted)),
        )
        for key, (size, corners, continues) in zip(wanted, looked, strict=True):
            _check_size(key, size, sizes)
            found[key] = None if continues else corners
            if continues:
                beyond.append(key)

    def shown() -> int:
        return sum(corners is not None for corners in found.values())

    keys = [(camera, view) for camera in pictures for view in pictures[camera]]
    # A few pictures are looked at one and all; ChArUco boards are searched in 15 ms, found or not.
    sampled = board.type == "chessboard" and len(keys) > _SAMPLE
    for number, sample in enumerate(_samples(pictures) if sampled else []):
        # The second round asks whether a single board is more than a false grid on something else.
        if number == 0 or shown() == 1:
            look(sample, again=False)
    _look_again_where_nothing_was_found(found, beyond, look)
    if sampled and shown() < _ENOUGH:
        _refuse(board, len(found), shown(), beyond)
    look([key for key in keys if key not in found], again=False)
    _look_again_where_nothing_was_found(found, beyond, look)
    if shown() > 0:
        look([key for key in keys if found[key] is None and key not in beyond][:_MAX_AGAIN], again=True)
    if len(beyond) > shown() or shown() == 0:
        _refuse(board, len(keys), shown(), beyond)
    return _gather(pictures, found, sizes, beyond)


def _look_again_where_nothing_was_found(
    found: Mapping[tuple[str, str], Corners | None],
    beyond: Sequence[tuple[str, str]],
    look: Callable[[Iterable[tuple[str, str]], bool], None],
) -> None:
    """Search two pictures at full size before saying that none shows the board."""
    keys = list(found)
    if keys and not beyond and not any(corners is not None for corners in found.values()):
        look(dict.fromkeys((keys[0], keys[-1])), True)


def _gather(
    pictures: Pictures,
    found: Mapping[tuple[str, str], Corners | None],
    sizes: Mapping[str, tuple[str, tuple[int, int]]],
    beyond: Sequence[tuple[str, str]],
) -> Search:
    corners: dict[str, dict[str, Corners]] = {camera: {} for camera in pictures}
    left_out = []
    for camera in pictures:
        for view in pictures[camera]:
            c = found[camera, view]
            if c is not None:
                corners[camera][view] = c
            else:
                reason = "the pattern goes on past the board" if (camera, view) in beyond else "no board found"
                left_out.append(LeftOut(camera, view, reason))
    return Search(corners, {camera: sizes[camera][1] for camera in pictures}, tuple(left_out))


def _samples(pictures: Pictures) -> list[list[tuple[str, str]]]:
    """Two rounds of pictures spread over the views, a few per camera, camera by camera in turn."""
    count = max(1, _SAMPLE // len(pictures))
    rounds: list[list[tuple[str, str]]] = [[], []]
    for camera, views in pictures.items():
        names = list(views)
        places = np.unique(np.linspace(0, len(names) - 1, min(2 * count, len(names))).round().astype(int))
        for start, keys in enumerate(rounds):
            keys += [(camera, names[i]) for i in places[start::2]]
    return [keys for keys in rounds if keys]


def _look(gray: Image, board: Board, again: bool) -> tuple[tuple[int, int], Corners | None, bool]:
    corners = find_corners(gray, board, again=again)
    height, width = gray.shape
    return (width, height), corners, corners is not None and continues_beyond(gray, board, corners)


def _check_size(key: tuple[str, str], size: tuple[int, int], sizes: dict[str, tuple[str, tuple[int, int]]]) -> None:
    camera, view = key
    first, expected = sizes.setdefault(camera, (view, size))
    if size != expected:
        raise CalibrationError(
            f"{camera}: picture {view} has {size[0]} x {size[1]} pixels, {first} has {expected[0]} x {expected[1]}; "
            "take all pictures of a camera with one setting"
        )


def _refuse(board: Board, looked: int, shown: int, beyond: Sequence[tuple[str, str]]) -> None:
    columns, rows = board.squares
    what = f"a {'chessboard' if board.type == 'chessboard' else 'ChArUco board'} of {columns} x {rows} squares"
    if beyond:
        raise CalibrationError(
            f"the pictures show a larger pattern than {what} ({beyond[0][0]}, picture {beyond[0][1]}); "
            "count all squares, outer ones included, and mend `squares` in the board file"
        )
    more = ", its dictionary and marker size, and that the print is not OpenCV's legacy pattern"
    raise CalibrationError(
        f"{shown or 'none'} of the {looked} pictures looked at shows {what}; check `squares` in the board file "
        f"(outer squares count){more if board.type == 'charuco' else ''}, and that the whole board is sharp and lit"
    )
