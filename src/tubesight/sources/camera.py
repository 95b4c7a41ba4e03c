"""Pictures of one instant from cameras, streams, videos, folders or the simulator, in pairs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Protocol

import numpy as np

from tubesight.core import Board, FramePair, InputError
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import board_views, render_board_pair, rig_around
from tubesight.sources.opening import open_source
from tubesight.sources.reader import TIMEOUT_S, BrokenPictureError, Picture, Reader, Source, Wanted

# Pictures of free-running cameras are taken for one instant up to this difference: one and a half frames at 30 Hz.
_SKEW_S = 0.05
# A stream in which so many pictures in a row are broken is not usable; single ones are, on a busy network.
_BROKEN_MAX = 10
# Videos are looked at so many times a second: a board held still is held for longer.
_LOOKS_PER_S = 8.0
# The simulated board rests for some frames at each of its places and takes one to get there.
_SIM_PLACES, _SIM_REST, _SIM_HZ = 40, 2, 5.0
_SIM_SIZE = (1280, 720)


class Feed(Protocol):
    """Pictures of one camera."""

    def next(self) -> Picture | None:
        """Return the next picture, of a live camera the newest; None at the end."""

    def close(self) -> None:
        """Let the camera go."""


class _Pulled:
    """A feed that waits for its reader: nothing is lost between two pictures."""

    def __init__(self, pictures: Iterator[Picture]) -> None:
        self._pictures = pictures

    def next(self) -> Picture | None:
        return next(self._pictures, None)

    def close(self) -> None:
        close: Callable[[], None] = getattr(self._pictures, "close", lambda: None)
        close()


class LiveFeed:
    """A camera read on its own thread, of which the newest picture counts.

    Parameters
    ----------
    name
        For messages.
    open_camera
        Called on the thread.
    timeout_s
        A camera that gives no picture for so long is dead.
    """

    def __init__(self, name: str, open_camera: Callable[[], Reader], timeout_s: float) -> None:
        self._name, self._open, self._timeout_s = name, open_camera, timeout_s
        self._newest: Picture | None = None
        self._failure: InputError | None = None
        self._ended = False
        self._changed = threading.Condition()
        # A driver may hang for ever in a call: a daemon does not keep the program.
        self._thread = threading.Thread(target=self._run, name=f"camera {name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            reader = self._open()
            try:
                for picture in _whole(reader):
                    if self._ended:
                        return
                    with self._changed:
                        self._newest = picture
                        self._changed.notify_all()
            finally:
                reader.close()
        except InputError as failure:
            with self._changed:
                self._failure = failure
                self._changed.notify_all()

    def next(self) -> Picture | None:
        """Wait for a picture that was not returned yet; raise `InputError` where the camera is dead."""
        with self._changed:
            there = self._changed.wait_for(lambda: self._newest or self._failure, self._timeout_s)
            if self._newest is not None:
                picture, self._newest = self._newest, None
                return picture
            if not there or self._failure is None:
                raise InputError(
                    f"{self._name}: no picture for {self._timeout_s:g} s; check the cable, and that no other program "
                    "uses the camera"
                )
            raise self._failure

    def close(self) -> None:
        """Stop reading; waits for the thread as long as a picture may take."""
        self._ended = True
        self._thread.join(self._timeout_s)


def open_feeds(
    sources: Mapping[str, str],
    board: Board,
    size_px: tuple[int, int] | None = None,
    timeout_s: float = TIMEOUT_S,
) -> dict[str, Feed]:
    """Open what pictures come from, by camera name.

    Parameters
    ----------
    sources
        Per camera, see `tubesight.sources.opening.open_source`; ``sim:`` is a simulated board here.
    board
        What the simulator shows.
    size_px
        (width, height) to ask cameras for, and of simulated pictures.

    Raises
    ------
    InputError
        If one of them cannot be opened.
    """
    feeds: dict[str, Feed] = {}
    simulated = tuple(name for name, text in sources.items() if text.startswith("sim:"))
    try:
        for name, text in sources.items():
            if name in simulated:
                feeds[name] = _Pulled(_simulated(name, simulated, board, size_px or _SIM_SIZE))
            else:
                feeds[name] = _open(text, Wanted(name, size_px, timeout_s=timeout_s))
    except BaseException:
        close_feeds(feeds)
        raise
    return feeds


def close_feeds(feeds: Mapping[str, Feed]) -> None:
    """Let all cameras go."""
    for feed in feeds.values():
        feed.close()


def _open(text: str, wanted: Wanted) -> Feed:
    source = open_source(text, wanted)
    if source.live:
        # A network camera may use its whole time to connect, and again for a picture.
        return LiveFeed(source.name, source.open, 2 * wanted.timeout_s)
    return _Pulled(_looks(source))


def _whole(reader: Reader) -> Iterator[Picture]:
    """Pictures of a reader without the broken ones, of which a few in a row may come."""
    broken = 0
    while True:
        try:
            picture = reader.read()
        except BrokenPictureError:
            broken += 1
            if broken >= _BROKEN_MAX:
                raise
            continue
        if picture is None:
            return
        broken = 0
        yield picture


def _looks(source: Source) -> Iterator[Picture]:
    """Pictures of a folder, or `_LOOKS_PER_S` of a video."""
    reader = source.open()
    due = 0.0
    try:
        for picture in _whole(reader):
            if np.isnan(picture.time_s):
                yield picture
            elif picture.time_s >= due:
                # Half a millisecond for times that are rounded.
                due = picture.time_s + 1 / _LOOKS_PER_S - 5e-4
                yield picture
    finally:
        reader.close()


def _simulated(name: str, names: tuple[str, ...], board: Board, size_px: tuple[int, int]) -> Iterator[Picture]:
    """Carry a board from place to place before simulated cameras, always in the same way."""
    rig = rig_around(size_px=size_px, names=names, angle_deg=90.0 if len(names) < 3 else 180.0 / len(names))
    alone = Rig({name: rig.cameras[name]}, {name: rig.camera_from_base[name]})
    poses = board_views(rig, board, _SIM_PLACES, np.random.default_rng(0))
    index = 0
    for k, pose in enumerate(poses):
        shown = [Pose(pose.rotation, (pose.translation_mm + poses[k - 1].translation_mm) / 2)] if k else []
        for way in (*shown, *[pose] * _SIM_REST):
            image = render_board_pair(alone, board, way, name=f"{index}").images[name]
            yield Picture(image, index / _SIM_HZ)
            index += 1


def instants(feeds: Mapping[str, Feed]) -> Iterator[FramePair]:
    """Pictures of one instant of all cameras, until the first of them ends.

    Of cameras that run freely the newest pictures are taken; where these are too far apart the older one is taken
    again, once. The time is that of the first camera.

    Raises
    ------
    InputError
        If a camera is dead or its pictures change their size.
    """
    sizes: dict[str, tuple[int, ...]] = {}
    index = 0
    while True:
        pictures: dict[str, Picture] = {}
        for name, feed in feeds.items():
            picture = feed.next()
            if picture is None:
                return
            pictures[name] = picture
        oldest = min(pictures, key=lambda n: pictures[n].time_s)
        newest = max(p.time_s for p in pictures.values())
        if newest - pictures[oldest].time_s > _SKEW_S and isinstance(feeds[oldest], LiveFeed):
            with suppress(InputError):
                pictures[oldest] = feeds[oldest].next() or pictures[oldest]
        for name, picture in pictures.items():
            size = picture.image.shape[1::-1]
            if sizes.setdefault(name, size) != size:
                raise InputError(
                    f"{name}: the size of its pictures changes from {sizes[name]} to {size}; keep it fixed"
                )
        first = next(iter(pictures.values()))
        yield FramePair({n: p.image for n, p in pictures.items()}, str(index), first.time_s)
        index += 1
