"""Recording live results on a thread of its own: the measurement never waits for a disk."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from tubesight.core import Frame, InputError
from tubesight.files.recording import CONFIGURATION_TOPIC, PICTURE_TOPIC, RESULT_TOPIC, coded_image
from tubesight.outputs.mcap_file import FLUSH_S, McapFile
from tubesight.outputs.moments import moment_json
from tubesight.tracking.tracker import Tracked

# Pictures that wait for the disk hold at most so much memory; beyond that pictures are left out, never results.
_WAITING_BYTES = 256 << 20
# Results that wait: half a minute at 200 Hz.
_WAITING_RESULTS = 6000
_QUALITY = 95
# A crop leaves so much around the tube, in its largest extent.
_AROUND = 0.15
# How long closing waits for the disk, and how much of that for pictures.
_CLOSE_S, _CLOSE_PICTURES_S = 1.5, 0.8


class Recorder:
    """A subscriber that writes everything to a file.

    Parameters
    ----------
    file
        Where to; closed with the recorder.
    configuration
        What made the results; the first message of the file, written before this returns.
    pictures
        ``lossless`` (as the camera coded them; pixels as PGM or PPM, which the file's chunks compress five times faster
        than PNG would), ``jpeg``, ``crop`` or ``none``.
    every
        Pictures of every n-th pair.

    Raises
    ------
    InputError
        If the disk does not even take the configuration.
    """

    def __init__(self, file: McapFile, configuration: Mapping[str, Any], pictures: str, every: int = 1) -> None:
        self._file, self._pictures, self._every = file, pictures, every
        # Times of pictures are of a clock that starts anywhere; those of a file are since 1970.
        self._epoch_ns = time.time_ns() - time.monotonic_ns()
        self._changed = threading.Condition()
        self._queue: deque[tuple[Tracked | bytes, bool]] = deque()
        self._waiting, self._pairs, self._closed_s = 0, 0, math.inf
        self._counts = {"results": 0, "pictures": 0, "pictures_left_out": 0, "results_left_out": 0}
        self._failure = ""
        try:
            file.write(CONFIGURATION_TOPIC, time.time_ns(), 0, self._about(configuration))
            file.flush()
        except OSError as error:
            raise InputError(f"{file.path}: cannot be written ({error.strerror}); choose another place") from error
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def publish(self, tracked: Tracked) -> None:
        """Take a result; returns at once. Where the disk cannot follow, pictures are left out first."""
        with self._changed:
            if self._closed_s < math.inf or self._failure or len(self._queue) >= _WAITING_RESULTS:
                self._counts["results_left_out"] += 1
                return
            wanted = tracked.pair is not None and self._pictures != "none" and self._pairs % self._every == 0
            self._pairs += tracked.pair is not None
            room = self._waiting < _WAITING_BYTES
            if wanted and not room:
                self._counts["pictures_left_out"] += len(tracked.pair.frames if tracked.pair else ())
            self._waiting += _bytes(tracked) if wanted and room else 0
            self._queue.append((tracked, wanted and room))
            self._changed.notify()

    def configure(self, configuration: Mapping[str, Any]) -> None:
        """Say what makes the results from here on; returns at once."""
        with self._changed:
            if self._closed_s == math.inf and not self._failure:
                self._queue.append((self._about(configuration), False))

    def _about(self, configuration: Mapping[str, Any]) -> bytes:
        return json.dumps({**configuration, "epoch_ns": self._epoch_ns}).encode()

    def state(self) -> dict[str, Any]:
        """Say what was written, and why no more is; for the screen."""
        with self._changed:
            counts: dict[str, Any] = {key: n for key, n in self._counts.items() if n}
            return {**counts, "MB": self._file.bytes >> 20, **({"stopped": self._failure} if self._failure else {})}

    def close(self) -> None:
        """Write what waits and the index; gives up after one and a half seconds."""
        with self._changed:
            self._closed_s = min(self._closed_s, time.monotonic())
            self._changed.notify()
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._queue or self._closed_s < math.inf, FLUSH_S)
                    item = self._queue.popleft() if self._queue else None
                    closed = self._closed_s < math.inf
                    hurry = time.monotonic() > self._closed_s + _CLOSE_PICTURES_S
                if item is not None:
                    self._write(item[0], item[1] and not hurry)
                    if item[1] and hurry:
                        self._left_out(item[0])
                elif closed:
                    self._file.close()
                    return
                else:
                    self._file.flush()
        except OSError as error:
            with self._changed:
                self._failure = f"the disk takes no more ({error.strerror or error})"
                self._queue.clear()

    def _left_out(self, tracked: Tracked | bytes) -> None:
        if isinstance(tracked, Tracked) and tracked.pair is not None:
            with self._changed:
                self._counts["pictures_left_out"] += len(tracked.pair.frames)

    def _write(self, tracked: Tracked | bytes, pictures: bool) -> None:
        if isinstance(tracked, bytes):
            self._file.write(CONFIGURATION_TOPIC, time.time_ns(), 0, tracked)
            return
        if pictures and tracked.pair is not None:
            for frame in tracked.pair.frames.values():
                form, data = self._coded(frame, tracked)
                stamp = self._epoch_ns + round(frame.time_s * 1e9)
                message = coded_image(stamp, frame.camera, form, data)
                self._file.write(PICTURE_TOPIC + frame.camera, stamp, frame.number, message)
        stamp = self._epoch_ns + round(tracked.time_s * 1e9)
        self._file.write(RESULT_TOPIC, stamp, self._counts["results"], moment_json(tracked))
        with self._changed:
            self._counts["results"] += 1
            if pictures and tracked.pair is not None:
                self._counts["pictures"] += len(tracked.pair.frames)
                self._waiting -= _bytes(tracked)

    def _coded(self, frame: Frame, tracked: Tracked) -> tuple[str, bytes]:
        if self._pictures == "lossless" and frame.coded:
            return ("png" if frame.coded[:4] == b"\x89PNG" else "jpeg"), frame.coded
        if self._pictures == "jpeg":
            return "jpeg", cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        image = frame.image
        view = tracked.result.views.get(frame.camera) if tracked.result is not None else None
        if self._pictures == "crop" and view is not None:
            edges = view.edges_px.reshape(-1, 2)
            margin = _AROUND * float(np.ptp(edges, axis=0).max())
            low = np.clip((edges.min(0) - margin).astype(int), 0, None)
            high = (edges.max(0) + margin).astype(int)
            image = image[low[1] : high[1], low[0] : high[0]]
        form = "pgm" if image.ndim == 2 else "ppm"
        return form, cv2.imencode(f".{form}", image)[1].tobytes()


def _bytes(tracked: Tracked) -> int:
    frames = tracked.pair.frames.values() if tracked.pair is not None else ()
    return sum(frame.image.nbytes + len(frame.coded) for frame in frames)
