"""Video files and RTSP cameras, by PyAV (extra ``video``) or OpenCV."""

from __future__ import annotations

import time
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from tubesight.core import Image, InputError
from tubesight.sources.clock import ArrivalClock
from tubesight.sources.jpeg import to_gray
from tubesight.sources.reader import Picture, Source, Wanted

SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".mjpg", ".mjpeg", ".m4v")


def video_source(path: Path, wanted: Wanted) -> Source:
    """Open a video file; times are those of its container where PyAV is installed, else counted by its frame rate."""
    return Source(str(path), lambda: _VideoReader(str(path), wanted, live=False), live=False)


def rtsp_source(url: str, wanted: Wanted) -> Source:
    """Open a network camera's RTSP stream, over TCP: with UDP, lost packets tear pictures."""
    # A login in the address is no text for messages.
    name = "rtsp://" + url.removeprefix("rtsp://").rpartition("@")[2]
    return Source(name, lambda: _VideoReader(url, wanted, live=True, name=name))


class _VideoReader:
    def __init__(self, place: str, wanted: Wanted, live: bool, name: str = "") -> None:
        self._name, self._gray, self._live = name or place, wanted.gray, live
        self._clock = ArrivalClock()
        self._first = True
        make = _av_pictures if find_spec("av") is not None else _cv_pictures
        self._pictures = make(place, self._name, live, wanted)

    def read(self) -> Picture | None:
        found = next(self._pictures, None)
        if found is None:
            if self._live:
                raise InputError(f"{self._name}: the stream ended; is the camera still on?")
            if self._first:
                raise InputError(
                    f"{self._name}: no picture can be read from this video; convert it, for example to mp4 (H.264)"
                )
            return None
        self._first = False
        image, stamp = found
        time_s = self._clock.time_s(stamp, time.monotonic()) if self._live else stamp
        return Picture(to_gray(image) if self._gray else image, time_s)

    def close(self) -> None:
        self._pictures.close()


def _av_pictures(place: str, name: str, live: bool, wanted: Wanted) -> Generator[tuple[Image, float], None, None]:
    """Pictures and the times of the container; a damaged picture is left out by the decoder."""
    import av

    options = {"rtsp_transport": "tcp", "fflags": "nobuffer"} if live else {}
    try:
        container = av.open(place, options=options, timeout=wanted.timeout_s)
    except (av.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{name}: cannot be opened ({reason}); check the address or file") from error
    with container:
        if not container.streams.video:
            raise InputError(f"{name}: holds no video; name a video file or a camera's stream")
        stream = container.streams.video[0]
        stream.thread_type = "NONE" if live else "AUTO"
        form = "gray" if wanted.gray else "bgr24"
        start = None
        try:
            for frame in container.decode(stream):
                stamp = float(frame.time) if frame.time is not None else float("nan")
                start = stamp if start is None else start
                yield np.asarray(frame.to_ndarray(format=form), dtype=np.uint8), stamp - start
        except (av.FFmpegError, OSError) as error:
            raise InputError(f"{name}: the video breaks off ({error.strerror}); is it whole?") from error


def _cv_pictures(place: str, name: str, live: bool, wanted: Wanted) -> Generator[tuple[Image, float], None, None]:
    """Pictures, with times by the frame rate of a file; those of a stream are not known."""
    video = cv2.VideoCapture(place)
    try:
        rate = video.get(cv2.CAP_PROP_FPS)
        rate = rate if 0 < rate < 1000 else 30.0
        index = 0
        while True:
            good, image = video.read()
            if not good or image is None:
                return
            yield np.asarray(image, dtype=np.uint8), float("nan") if live else index / rate
            index += 1
    finally:
        video.release()
