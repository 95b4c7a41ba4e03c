"""The viewer: takes results as they come and shows the newest, in a thread of its own."""

from __future__ import annotations

import math
import time

from tubesight.apps.viewer.cameras import Cameras, shrunk
from tubesight.apps.viewer.controls import ControlFolder, Controls
from tubesight.apps.viewer.guard import PORT
from tubesight.apps.viewer.page import Page
from tubesight.apps.viewer.panel import CONTROLS, PICTURE_PX, Panel
from tubesight.apps.viewer.scene import Scene3D
from tubesight.core import FramePair, Tube
from tubesight.geometry.rig import Rig
from tubesight.outputs.overlay import draw_views
from tubesight.sensor import Reconstruction

# People see no more than 30 results a second; pictures and plots are larger and change more slowly.
_SHAPE_S, _PICTURE_S, _PLOT_S = 1 / 30, 0.2, 0.25


class Viewer(Page[tuple[Reconstruction, FramePair | None, float, str]]):
    """Shows results in a browser. Use it as a context manager.

    `publish` never waits: results that come faster than they are shown replace each other.

    Parameters
    ----------
    rig, tube
        Cameras, and what is known of the tube.
    port
        On this machine; 0 takes any free one.
    controls
        What people can do.

    Attributes
    ----------
    controls
        Where they do it.
    """

    def __init__(self, rig: Rig, tube: Tube, port: int = PORT, controls: Controls | None = None) -> None:
        super().__init__(port, "viewer")
        self.rig = rig
        self._panel = Panel(self.server)
        self.controls = ControlFolder(self.server.gui, controls or Controls(), CONTROLS)
        self._scene = Scene3D(self.server, rig, tube.diameter_mm)
        self._cameras = Cameras(self.server, rig, self.controls.clicked)

    def publish(
        self, result: Reconstruction, pair: FramePair | None, time_s: float | None = None, remarks: str = ""
    ) -> None:
        """Hand over a result; returns at once.

        Parameters
        ----------
        pair
            Its pictures, which are not changed or kept for long; None shows none.
        time_s
            When, for the plots; now where it is not given.
        remarks
            Rates, latency and the like, in words.
        """
        self._slot.put((result, pair, time.monotonic() if time_s is None else time_s, remarks))

    def _run(self) -> None:
        pictures_at = plots_at = 0.0
        before_s = -math.inf
        while not self._ended.is_set():
            taken = self._slot.take(None)
            if taken is None:
                return
            started = time.monotonic()
            result, pair, time_s, remarks = taken
            if time_s < before_s:
                # A recording that is played again, or from another place.
                self._panel.forget()
                self._scene.forget()
            before_s = time_s
            with self.server.atomic():
                self._panel.show(result, time_s, remarks)
                self._scene.show(result, self.controls.enlarge or None)
            if pair is not None and started - pictures_at > _PICTURE_S:
                pictures_at = started
                self._show_pictures(pair, result)
            if started - plots_at > _PLOT_S:
                plots_at = started
                self._panel.show_plots()
                self._scene.show_way()
                self.controls.show()
            self._ended.wait(max(_SHAPE_S - (time.monotonic() - started), 0.0))

    def _show_pictures(self, pair: FramePair, result: Reconstruction) -> None:
        drawn = draw_views(pair, result, self.rig, PICTURE_PX // len(self.rig.names))
        self._panel.show_picture(shrunk(drawn, drawn.shape[1]))
        for name, image in pair.images.items():
            self._cameras.show(name, image)
