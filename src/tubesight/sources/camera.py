"""Pictures of one instant from cameras, streams, videos, folders or the simulator, in pairs."""

from __future__ import annotations

import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from tubesight.core import Board, FramePair, Image, InputError
from tubesight.files.dataset import list_pictures
from tubesight.files.images import decode_image, read_image
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import board_views, render_board_pair, rig_around
from tubesight.sources.http import HttpPictures

# A camera that gives nothing for so long is dead: webcams take up to 3 s for their first picture.
TIMEOUT_S = 5.0
# Pictures of free-running cameras are taken for one instant up to this difference: one and a half frames at 30 Hz.
_SKEW_S = 0.05
# A stream in which so many pictures in a row are broken is not usable; single ones are, on a busy network.
_BROKEN_MAX = 10
# Videos are looked at so many times a second: a board held still is held for longer.
_LOOKS_PER_S = 8.0
_VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".mjpg", ".mjpeg", ".m4v")
# The simulated board rests for some frames at each of its places and takes one to get there.
_SIM_PLACES, _SIM_REST, _SIM_HZ = 40, 2, 5.0
_SIM_SIZE = (1280, 720)


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture and when it was taken, seconds (of the machine's clock or the video's); NaN where that is not known."""

    image: Image
    time_s: float


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
        Called on the thread; returns the function that waits for a picture and the one that lets the camera go.
    timeout_s
        A camera that gives no picture for so long is dead.
    """

    def __init__(
        self, name: str, open_camera: Callable[[], tuple[Callable[[], Image], Callable[[], None]]], timeout_s: float
    ) -> None:
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
            read, close = self._open()
            try:
                while not self._ended:
                    picture = Picture(read(), time.monotonic())
                    with self._changed:
                        self._newest = picture
                        self._changed.notify_all()
            finally:
                close()
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
        Per camera: an index or ``/dev/video0``, ``http://...`` (motion JPEG, or a picture each time), a video file, a
        folder of pictures, or ``sim:`` for a simulated board.
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
                feeds[name] = _open(text, size_px, timeout_s)
    except BaseException:
        close_feeds(feeds)
        raise
    return feeds


def close_feeds(feeds: Mapping[str, Feed]) -> None:
    """Let all cameras go."""
    for feed in feeds.values():
        feed.close()


def _open(text: str, size_px: tuple[int, int] | None, timeout_s: float) -> Feed:
    if text.startswith(("http://", "https://")):
        stream = HttpPictures(text, timeout_s)
        return LiveFeed(stream.name, lambda: (_decoder(stream), stream.close), 2 * timeout_s)
    if re.fullmatch(r"\d{1,3}", text) or text.startswith("/dev/"):
        return _device(text, size_px, timeout_s)
    path = Path(text)
    if path.is_dir():
        pictures = list_pictures(path)
        if not pictures:
            raise InputError(f"{path}: no pictures in this folder; name one that holds a camera's pictures")
        return _Pulled(Picture(read_image(p), float("nan")) for p in pictures.values())
    if path.suffix.lower() in _VIDEO_SUFFIXES and path.is_file():
        return _Pulled(_video(path))
    what = "no such file or folder" if not path.exists() else "neither a video nor a folder of pictures"
    raise InputError(f"{text}: {what}; a source is an index, /dev/video0, http://..., a video, a folder or sim:")


def _decoder(stream: HttpPictures) -> Callable[[], Image]:
    def read() -> Image:
        for broken in range(_BROKEN_MAX):
            data = stream.read()
            try:
                return decode_image(data, stream.name)
            except InputError:
                if broken == _BROKEN_MAX - 1:
                    raise
        raise AssertionError

    return read


def _device(text: str, size_px: tuple[int, int] | None, timeout_s: float) -> Feed:
    place = f"/dev/video{text}" if text.isdecimal() else text
    linux = sys.platform == "linux"
    if linux and not Path(place).exists():
        raise InputError(f"{place}: there is no such camera; `ls /dev/video*` lists those that are there")
    name = place if linux else f"camera {text}"

    def open_camera() -> tuple[Callable[[], Image], Callable[[], None]]:
        backend = cv2.CAP_V4L2 if linux else cv2.CAP_ANY
        device = cv2.VideoCapture(int(text), backend) if text.isdecimal() else cv2.VideoCapture(text, backend)
        if size_px is not None:
            # Most cameras give their larger sizes at full rate as motion JPEG only.
            device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
            device.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
            device.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
        # A calibration holds for one focus.
        device.set(cv2.CAP_PROP_AUTOFOCUS, 0)

        def read() -> Image:
            good, image = device.read()
            if not good or image is None:
                raise InputError(f"{name}: the camera gives no pictures; does another program use it?")
            if size_px is not None and image.shape[1::-1] != tuple(size_px):
                raise InputError(
                    f"{name}: gives {image.shape[1]} x {image.shape[0]}, not {size_px[0]} x {size_px[1]}; "
                    "ask for a size that it has with --size"
                )
            return np.asarray(image, dtype=np.uint8)

        return read, device.release

    return LiveFeed(name, open_camera, timeout_s)


def _video(path: Path) -> Iterator[Picture]:
    """Frames of a video, `_LOOKS_PER_S` of them."""
    video = cv2.VideoCapture(str(path))
    try:
        rate = video.get(cv2.CAP_PROP_FPS)
        rate = rate if 0 < rate < 1000 else 30.0
        step = max(round(rate / _LOOKS_PER_S), 1)
        index = 0
        while video.grab():
            if index % step == 0:
                good, image = video.retrieve()
                if not good or image is None:
                    break
                yield Picture(np.asarray(image, dtype=np.uint8), index / rate)
            index += 1
        if index == 0:
            raise InputError(f"{path}: no picture can be read from this video; convert it, for example to mp4 (H.264)")
    finally:
        video.release()


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
