"""``tubesight view``: a folder of pictures or a recording, shown place by place."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from tubesight.apps.live.replay import sensor_of
from tubesight.apps.run import RunOptions, sensor_for
from tubesight.apps.switch import SensorSwitch
from tubesight.apps.viewer.controls import controls_of
from tubesight.apps.viewer.guard import PORT
from tubesight.apps.viewer.panel import PLAYER
from tubesight.apps.viewer.reels import FolderReel, RecordingReel, Reel
from tubesight.apps.viewer.viewer import Viewer
from tubesight.files.recording import Recording
from tubesight.sensor import ShapeSensor

# Places a second, at most.
_HZ_MAX = 60
#: Name in the list of pipelines for the results that a recording holds.
AS_RECORDED = "as recorded"


class Player:
    """Shows the places of a reel one after the other, again and again until it is stopped.

    Parameters
    ----------
    reel, sensor
        What is shown, and what measures it.
    port
        Of the viewer.
    again
        Whether to measure at first what was measured before.
    """

    def __init__(self, reel: Reel, sensor: ShapeSensor, port: int = PORT, again: bool = False) -> None:
        self._reel, self._again = reel, again or not reel.measured
        self._changed, self._ended = threading.Event(), threading.Event()
        self.switch = SensorSwitch(sensor, changed=self._changed.set)
        controls = controls_of(self.switch)
        if reel.measured:
            names = (*controls.methods[:again], AS_RECORDED, *controls.methods[again:])
            controls = replace(controls, methods=names, on_method=self._use)
        self.viewer = Viewer(sensor.rig, sensor.tube, port, controls)
        gui = self.viewer.server.gui
        with gui.add_folder("player", order=PLAYER):
            self._playing = gui.add_checkbox("play", True)
            self._rate = gui.add_slider("pairs a second", 1, _HZ_MAX, 1, min(max(round(reel.hz), 1), _HZ_MAX))
            self._place = gui.add_slider("pair", 1, max(len(reel), 2), 1, 1)
        self._place.on_update(lambda _: self._changed.set())

    def run(self, pairs: int | None = None) -> None:
        """Show places until `stop`, or so many."""
        shown = 0
        with closing(self._reel), self.viewer:
            while not self._ended.is_set() and (pairs is None or shown < pairs):
                due = time.monotonic() + 1 / self._rate.value
                self._changed.clear()
                self._show(min(int(self._place.value), len(self._reel)) - 1)
                shown += 1
                self._changed.wait(max(due - time.monotonic(), 0.0) if self._playing.value else None)
                if self._playing.value and not self._ended.is_set():
                    self._place.value = int(self._place.value) % len(self._reel) + 1  # type: ignore[misc]

    def stop(self) -> None:
        """End `run`."""
        self._ended.set()
        self._changed.set()

    def _show(self, index: int) -> None:
        self.switch.adopt()
        shown = self._reel.show(index, self.switch.current, self._again)
        result = shown.result
        took = f", {result.total_ms:.1f} ms" if math.isfinite(result.total_ms) and result.ms else ""
        remarks = f"pair {index + 1} of {len(self._reel)}{took}, {result.method}; {shown.remarks}"
        self.viewer.publish(result, shown.pair, shown.time_s, remarks.strip("; "))

    def _use(self, name: str) -> None:
        self._again = name != AS_RECORDED
        if self._again:
            self.switch.use(name)
        self._changed.set()


def view_folder(options: RunOptions, port: int, tell: Callable[[str], None]) -> Player:
    """Open a player for a folder.

    Parameters
    ----------
    options
        As for ``tubesight run``; nothing is written.
    tell
        Called with what the user should know.
    """
    sensor, source, messages = sensor_for(options)
    for message in messages:
        tell(message)
    return _opened(Player(FolderReel(source), sensor, port), tell)


def view_recording(path: Path, method: str | None, port: int, tell: Callable[[str], None]) -> Player:
    """Open a player for a recording; with a method it is measured again.

    Raises
    ------
    InputError
        If it is no whole recording, or holds nothing.
    """
    recording = Recording(path)
    sensor, reel = sensor_of(recording), RecordingReel(recording)
    if (what := recording.configuration.get("pictures")) in ("none", "crop"):
        tell(f"{path}: holds {'no pictures' if what == 'none' else 'crops of the pictures'}; results alone are shown")
    again = method is not None
    return _opened(Player(reel, replace(sensor, method=method) if method else sensor, port, again), tell)


def _opened(player: Player, tell: Callable[[str], None]) -> Player:
    tell(f"open {player.viewer.address} in a browser on this machine; Ctrl-C ends")
    return player
