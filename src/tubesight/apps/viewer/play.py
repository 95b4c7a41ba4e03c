"""``tubesight view``: a folder of pictures, measured and shown pair by pair."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from tubesight.apps.run import RunOptions, sensor_for
from tubesight.apps.viewer.guard import PORT
from tubesight.apps.viewer.viewer import Controls, Viewer
from tubesight.core import Array, InputError, Status
from tubesight.methods import METHODS
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.sources.folder import FolderSource

# Pairs a second at first, and at most.
_RATE, _RATE_MAX = 5, 30


class Player:
    """Shows the pairs of a folder one after the other, again and again until it is stopped.

    Parameters
    ----------
    source, sensor
        Pictures, and what measures them.
    port
        Of the viewer.
    """

    def __init__(self, source: FolderSource, sensor: ShapeSensor, port: int = PORT) -> None:
        self._source, self._sensor = source, sensor
        self._changed, self._ended = threading.Event(), threading.Event()
        names = (sensor.method, *(name for name in METHODS if name != sensor.method))
        self.viewer = Viewer(sensor.rig, sensor.tube, port, Controls(names, self._use, None, ("base",), self._mark))
        gui = self.viewer.server.gui
        with gui.add_folder("recording"):
            self._playing = gui.add_checkbox("play", True)
            self._rate = gui.add_slider("pairs a second", 1, _RATE_MAX, 1, _RATE)
            self._place = gui.add_slider("pair", 1, max(len(source), 2), 1, 1)
        self._place.on_update(lambda _: self._changed.set())

    def run(self, pairs: int | None = None) -> None:
        """Show pairs until `stop`, or so many."""
        shown = 0
        with self.viewer:
            while not self._ended.is_set() and (pairs is None or shown < pairs):
                self._changed.clear()
                self._show(min(int(self._place.value), len(self._source)) - 1)
                shown += 1
                self._changed.wait(1 / self._rate.value if self._playing.value else None)
                if self._playing.value and not self._ended.is_set():
                    self._place.value = int(self._place.value) % len(self._source) + 1  # type: ignore[misc]

    def stop(self) -> None:
        """End `run`."""
        self._ended.set()
        self._changed.set()

    def _show(self, index: int) -> None:
        try:
            pair = self._source.read(index)
        except InputError as error:
            method = self._sensor.method
            failed = Reconstruction(self._source.stems[index], Status.BAD_IMAGE, (str(error),), None, None, {}, method)
            self.viewer.publish(failed, None)
            return
        result = self._sensor(pair)
        at = f"pair {index + 1} of {len(self._source)}, {result.total_ms:.1f} ms, {result.method}"
        self.viewer.publish(result, pair, None, at)

    def _use(self, method: str) -> None:
        self._sensor = replace(self._sensor, method=method)
        self._changed.set()

    def _mark(self, _: str, camera: str, px: Array) -> None:
        self._sensor = replace(self._sensor, base_px={**self._sensor.base_px, camera: px})
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
    player = Player(source, sensor, port)
    tell(f"open {player.viewer.address} in a browser on this machine; Ctrl-C ends")
    return player
