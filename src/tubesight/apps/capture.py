"""``tubesight capture``: pairs of pictures of a board, to calibrate with."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tubesight.apps.calibrate import board_of
from tubesight.calibration.look import FEW_PAIRS, Collection, Look, is_still, look_at, motion_px
from tubesight.calibration.search import in_threads
from tubesight.core import Board, FramePair, Image, InputError
from tubesight.files.dataset import list_pairs, list_pictures
from tubesight.files.images import read_image
from tubesight.files.rig import refuse_camera_name
from tubesight.files.safe import write_atomic
from tubesight.sources.camera import close_feeds, instants, open_feeds
from tubesight.sources.reader import TIMEOUT_S


@dataclass(frozen=True, slots=True)
class CaptureOptions:
    """What to take pictures with.

    Attributes
    ----------
    sources
        By camera name, see `tubesight.sources.camera.open_feeds`.
    board_path
        ``board.yaml``.
    out
        Folder for the pairs, one subfolder per camera; goes on where pairs are there already.
    pairs
        How many to keep at least.
    seconds
        Longest time to go on.
    size_px
        (width, height) to ask cameras for; None for their own.
    timeout_s
        A camera that gives nothing for so long is dead.
    """

    sources: Mapping[str, str]
    board_path: Path
    out: Path
    pairs: int = 15
    seconds: float = 900.0
    size_px: tuple[int, int] | None = None
    timeout_s: float = TIMEOUT_S


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """One moment, for the screen.

    Attributes
    ----------
    images, looks
        By camera: its picture, and what that shows.
    still
        By camera: whether the board is still in it.
    kept
        Name of the pair if this one was kept, else empty.
    word
        What happened to the pair, or what to do.
    """

    images: Mapping[str, Image]
    looks: Mapping[str, Look]
    still: Mapping[str, bool]
    collection: Collection
    kept: str
    word: str


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """How it ended: ``level`` is ``enough``, ``usable`` or ``too few``; `sentence` says why, `next_step` what to do."""

    options: CaptureOptions
    collection: Collection
    level: str
    sentence: str
    next_step: str

    def as_dict(self) -> dict[str, Any]:
        """Plain data for ``--json``."""
        return {
            "pairs": len(self.collection),
            "cameras": {
                name: {
                    "source": self.options.sources[name].partition("@")[2] or self.options.sources[name],
                    "covered": self.collection.covered(name).covered,
                    "turned_deg": self.collection.turned_deg(name),
                    "sizes": self.collection.sizes(name),
                }
                for name in self.collection.looks
            },
            "lacking": self.collection.lacking(),
            "verdict": {"level": self.level, "sentence": self.sentence, "next_step": self.next_step},
            "folder": self.options.out,
        }


def capture(options: CaptureOptions, tell: Callable[[State], None] = lambda state: None) -> Captured:
    """Keep pairs until they are enough, the sources end, the time is over, or Ctrl-C; always whole pairs.

    Parameters
    ----------
    tell
        Called after every look.

    Raises
    ------
    InputError
        If a camera is missing or dies, or the folder cannot be used.
    """
    _refuse(options)
    board = board_of(options.board_path)
    collection = Collection(tuple(options.sources), options.pairs)
    number = _there_already(options, board, collection)
    feeds = open_feeds(options.sources, board, options.size_px, options.timeout_s)
    end = time.monotonic() + options.seconds
    reason = "the sources ended"
    before: FramePair | None = None
    looks: dict[str, Look] = {}
    try:
        for pair in instants(feeds):
            last, looks = looks, _look(pair, board)
            seconds = pair.time_s - before.time_s if before is not None else float("nan")
            # Pictures of a folder do not follow each other in time: whether the board was still cannot be told.
            still = {
                name: bool(np.isnan(pair.time_s)) or is_still(motion_px(last.get(name), look), seconds, look.size_px[0])
                for name, look in looks.items()
            }
            before = pair
            word = _refusal(looks, still, collection)
            kept = ""
            if not word:
                kept = f"{number:03d}"
                _write(options.out, pair, kept)
                collection.add(looks)
                number += 1
                word = f"kept {kept}"
            tell(State(pair.images, looks, still, collection, kept, word))
            if collection.done:
                reason = "nothing is lacking" if not collection.lacking() else "more of the same would not help"
                break
            if time.monotonic() > end:
                reason = f"{options.seconds:g} s are over"
                break
    except KeyboardInterrupt:
        reason = "stopped"
    except InputError as error:
        raise InputError(f"{error} ({len(collection)} pairs are kept in {options.out})") from error
    finally:
        close_feeds(feeds)
    return _captured(options, collection, reason)


def _refuse(options: CaptureOptions) -> None:
    if len(options.sources) < 1:
        raise InputError("capture needs a source per camera, for example --source left=0 --source right=1")
    for name in options.sources:
        refuse_camera_name(name, f"--source {name}=...")
    if options.out.exists() and not options.out.is_dir():
        raise InputError(f"{options.out}: this is a file; name a folder for the pairs")


def _there_already(options: CaptureOptions, board: Board, collection: Collection) -> int:
    """Count pairs of an earlier capture in, and return the next number."""
    if not any((options.out / name).is_dir() and list_pictures(options.out / name) for name in options.sources):
        return 0
    numbers = [-1]
    for stem, paths in list_pairs(options.out, options.sources):
        looks = {name: look_at(read_image(path), board) for name, path in paths.items()}
        if all(look.corners is not None for look in looks.values()):
            collection.add(looks)
        numbers.append(int(stem) if stem.isdecimal() else -1)
    return max(numbers) + 1


def _look(pair: FramePair, board: Board) -> dict[str, Look]:
    names = list(pair.images)
    found = in_threads(lambda name: look_at(pair.images[name], board), names, lambda done: None)
    return dict(zip(names, found, strict=True))


def _refusal(looks: Mapping[str, Look], still: Mapping[str, bool], collection: Collection) -> str:
    """Why a pair is not kept, in a few words; empty where it is."""
    missing = [name for name, look in looks.items() if look.corners is None]
    if missing:
        return f"no board in {' and '.join(missing)}"
    blurred = [name for name, look in looks.items() if not look.sharp]
    if blurred:
        return f"blurred in {' and '.join(blurred)}: focus, or more light"
    if not all(still.values()):
        return "hold the board still"
    if not collection.adds(looks):
        return "; ".join(collection.lacking()[:2]) or "show the board elsewhere"
    return ""


def _write(out: Path, pair: FramePair, stem: str) -> None:
    """Write all pictures of a pair or none."""
    data = {name: cv2.imencode(".png", image)[1].tobytes() for name, image in pair.images.items()}
    paths = [out / name / f"{stem}.png" for name in data]
    try:
        for path, content in zip(paths, data.values(), strict=True):
            write_atomic(path, content)
    except BaseException:
        for path in paths:
            path.unlink(missing_ok=True)
        raise


def _captured(options: CaptureOptions, collection: Collection, reason: str) -> Captured:
    count, lacking = len(collection), collection.lacking()
    cover = ", ".join(f"{name} {100 * collection.covered(name).covered:.0f} %" for name in collection.looks)
    if count >= options.pairs and not lacking:
        level = "enough"
    elif count >= FEW_PAIRS:
        level = "usable"
    else:
        level = "too few"
    sentence = f"{level}: {count} pairs in {options.out}, the board's corners cover {cover}; {reason}"
    calibrate = f"tubesight calibrate {options.out} --board {options.board_path} -o rig.yaml"
    if level == "enough":
        return Captured(options, collection, level, sentence, calibrate)
    again = f"capture more into the same folder: {'; '.join(lacking)}" if lacking else "capture more pairs"
    step = again if level == "too few" else f"{calibrate}, or {again}"
    return Captured(options, collection, level, sentence, step)
