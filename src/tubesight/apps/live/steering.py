"""What people may change while a session runs: the sensor, and whether it is recorded."""

from __future__ import annotations

import base64
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2

from tubesight import __version__
from tubesight.apps.live.loop import warm_up
from tubesight.apps.live.options import LiveOptions, PictureMode, RecordOptions, Setup
from tubesight.apps.switch import SensorSwitch
from tubesight.core import InputError
from tubesight.files.nested import plain
from tubesight.files.recording import FORMAT
from tubesight.files.tube import tube_text
from tubesight.outputs.machine import machine
from tubesight.outputs.mcap_file import McapFile
from tubesight.outputs.recorder import Recorder
from tubesight.sensor import ShapeSensor
from tubesight.tracking.tracker import Tracked


class SessionRecording:
    """Recordings of a session, one at a time, begun and ended while cameras run; a subscriber.

    Parameters
    ----------
    options, setup, switch
        Of the session.
    """

    def __init__(self, options: LiveOptions, setup: Setup, switch: SensorSwitch) -> None:
        self._options, self._setup, self._switch = options, setup, switch
        given = options.record
        self._every = given.every if given is not None else 1
        self._folder = given.path.parent if given is not None else Path()
        #: Which pictures are recorded where nothing else is asked for.
        self.pictures: PictureMode = given.pictures if given is not None else "lossless"
        # The one lets one thread at a time begin and end, which waits for the disk; the other is held for moments.
        self._beginning, self._lock = threading.RLock(), threading.Lock()
        self._recorder: Recorder | None = None
        self._record: RecordOptions | None = None
        self._recorded_with = switch.current
        self._last: Mapping[str, Any] = {}

    @property
    def folder(self) -> Path:
        """Where recordings that are begun by name are written."""
        return self._folder.absolute()

    @property
    def running(self) -> bool:
        """Whether what is published is recorded; not where the disk failed."""
        recorder = self._recorder
        return recorder is not None and "stopped" not in recorder.state()

    @property
    def name(self) -> str:
        """Name of the file that is written, or of a new one: the time in UTC."""
        record = self._record
        if record is not None and self.running:
            return record.path.name
        return f"tubesight-{datetime.now(UTC):%Y%m%d-%H%M%S}.mcap"

    def start_named(self, name: str, pictures: PictureMode) -> None:
        """Begin a recording in the session's folder; see `start`.

        Whoever reaches the viewer gives the name, so it names no folder.
        """
        if not name.isprintable() or not name.strip() or name.startswith(".") or "/" in name or "\\" in name:
            raise InputError(f"{name[:60]!r}: expected a file name without a folder, for example {self.name}")
        path = self._folder / (name if name.endswith(".mcap") else f"{name}.mcap")
        self.start(RecordOptions(path, pictures, self._every))

    def start(self, record: RecordOptions) -> None:
        """Begin a recording.

        Raises
        ------
        InputError
            If one is running, or the file is there already or cannot be made.
        """
        with self._beginning:
            if self.running:
                raise InputError(f"{record.path}: a recording is running already; end that first")
            self.stop()
            sensor = self._switch.current
            file = McapFile(record.path)
            about = configuration(self._options, self._setup, sensor, record)
            recorder = Recorder(file, about, record.pictures, record.every)
            with self._lock:
                self._recorded_with, self._record, self._recorder = sensor, record, recorder

    def stop(self) -> None:
        """End the recording, if one is running; takes up to one and a half seconds."""
        with self._beginning:
            with self._lock:
                recorder, self._recorder = self._recorder, None
            if recorder is not None:
                recorder.close()
                self._last = recorder.state()

    def state(self) -> Mapping[str, Any]:
        """Return what was written by the recording that runs, or else by the last one; empty where there was none."""
        recorder = self._recorder
        return recorder.state() if recorder is not None else self._last

    def words(self) -> str:
        """Say what is or was written, and where."""
        state, record = dict(self.state()), self._record
        if record is None:
            return f"recordings are written to {self.folder}"
        failure = state.pop("stopped", "")
        counts = ", ".join(f"{value} {key.replace('_', ' ')}" for key, value in state.items())
        word = f"stopped, {failure}" if failure else "recording" if self.running else "recorded"
        return f"{word}: {record.path.absolute()}: {counts}"

    def publish(self, tracked: Tracked) -> None:
        """Take a result; returns at once."""
        with self._lock:
            if self._recorder is None or self._record is None:
                return
            sensor = self._switch.current
            if sensor is not self._recorded_with:
                self._recorder.configure(configuration(self._options, self._setup, sensor, self._record))
                self._recorded_with = sensor
            self._recorder.publish(tracked)

    def close(self) -> None:
        """End the recording."""
        self.stop()


@dataclass(frozen=True, slots=True, eq=False)
class Steering:
    """The sensor of a session and its recording, both of which may be changed while it runs."""

    switch: SensorSwitch
    recording: SessionRecording


def steering_of(options: LiveOptions, setup: Setup) -> Steering:
    """Return what steers a session; a new sensor is warmed up before it measures, so that no picture waits for it."""
    switch = SensorSwitch(setup.sensor(), prepare=warm_up)
    return Steering(switch, SessionRecording(options, setup, switch))


def configuration(options: LiveOptions, setup: Setup, sensor: ShapeSensor, record: RecordOptions) -> dict[str, Any]:
    """Collect what makes the results: a recording is measured again from it alone."""
    return {
        "format": FORMAT,
        "version": __version__,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "sources": {name: source.name for name, source in setup.sources.items()},
        "rig": setup.rig_text,
        "tube": tube_text(setup.tube),
        "method": sensor.method,
        "base_px": plain(sensor.base_px),
        "tip_px": plain(setup.tip_px),
        "backgrounds": {
            name: base64.b64encode(cv2.imencode(".png", image)[1].tobytes()).decode()
            for name, image in setup.backgrounds.items()
        },
        "gray": options.gray,
        "filtered": options.filtered,
        "tolerance_s": options.tolerance_s,
        "offset_s": dict(options.offset_s),
        "deadline_s": options.deadline_s,
        "pictures": record.pictures,
        "every": record.every,
        "machine": machine(),
    }
