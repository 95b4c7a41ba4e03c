"""The viewer: takes results as they come and shows the newest, in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tubesight.apps.viewer.cameras import Cameras, shrunk
from tubesight.apps.viewer.guard import PORT, open_server
from tubesight.apps.viewer.panel import PICTURE_PX, Panel
from tubesight.apps.viewer.scene import Scene3D
from tubesight.core import Array, FramePair, Tube
from tubesight.geometry.rig import Rig
from tubesight.outputs.overlay import draw_views
from tubesight.outputs.publish import Slot
from tubesight.sensor import Reconstruction

# People see no more than 30 results a second; pictures and plots are larger and change more slowly.
_SHAPE_S, _PICTURE_S, _PLOT_S = 1 / 30, 0.2, 0.25
# How many times deviations are enlarged at first, and at most: they are far thinner than the tube's line on a screen.
_ENLARGE, _ENLARGE_MAX = 10, 50


@dataclass(frozen=True, slots=True)
class Controls:
    """What people can do in the viewer; what is None is not offered.

    Attributes
    ----------
    methods, on_method
        Names of pipelines, the one in use first, and what to do when another is chosen.
    on_record
        Called with whether to record.
    marks, on_mark
        What can be marked on a picture (base, tip), and a function that is then called with one of these, a camera's
        name and a pixel (2,).
    """

    methods: Sequence[str] = ()
    on_method: Callable[[str], None] | None = None
    on_record: Callable[[bool], None] | None = None
    marks: Sequence[str] = ()
    on_mark: Callable[[str, str, Array], None] | None = None


class Viewer:
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
    """

    def __init__(self, rig: Rig, tube: Tube, port: int = PORT, controls: Controls | None = None) -> None:
        self.rig, self._controls = rig, controls or Controls()
        self.server = open_server(port)
        self._panel = Panel(self.server)
        self._mark = ""
        self._add_controls()
        self._scene = Scene3D(self.server, rig, tube.diameter_mm)
        self._cameras = Cameras(self.server, rig, self._clicked)
        self._slot: Slot[tuple[Reconstruction, FramePair | None, float, str]] = Slot()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def __enter__(self) -> Viewer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._slot.close()
        self._thread.join(2.0)
        self.server.stop()

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

    def _add_controls(self) -> None:
        gui, controls = self.server.gui, self._controls
        with gui.add_folder("controls"):
            enlarged = gui.add_slider("uncertainty, times", 0, _ENLARGE_MAX, 1, _ENLARGE, hint="0 hides it")
            enlarged.on_update(lambda event: setattr(self, "_enlarge", int(event.target.value)))
            self._enlarge = _ENLARGE
            if controls.on_method is not None and controls.methods:
                chosen, on_method = gui.add_dropdown("pipeline", tuple(controls.methods)), controls.on_method
                chosen.on_update(lambda event: on_method(event.target.value))
            if controls.on_record is not None:
                record, on_record = gui.add_checkbox("record", False), controls.on_record
                record.on_update(lambda event: on_record(event.target.value))
            if controls.on_mark is not None:
                buttons = gui.add_button_group("mark on a picture in 3-D", tuple(controls.marks))
                buttons.on_click(lambda event: setattr(self, "_mark", str(event.target.value)))

    def _clicked(self, camera: str, px: Array) -> None:
        if self._mark and self._controls.on_mark is not None:
            self._controls.on_mark(self._mark, camera, px)
            self._mark = ""

    def _run(self) -> None:
        pictures_at = plots_at = 0.0
        while not self._ended.is_set():
            taken = self._slot.take(None)
            if taken is None:
                return
            started = time.monotonic()
            result, pair, time_s, remarks = taken
            with self.server.atomic():
                self._panel.show(result, time_s, remarks)
                self._scene.show(result, self._enlarge or None)
            if pair is not None and started - pictures_at > _PICTURE_S:
                pictures_at = started
                self._show_pictures(pair, result)
            if started - plots_at > _PLOT_S:
                plots_at = started
                self._panel.show_plots()
                self._scene.show_way()
            self._ended.wait(max(_SHAPE_S - (time.monotonic() - started), 0.0))

    def _show_pictures(self, pair: FramePair, result: Reconstruction) -> None:
        drawn = draw_views(pair, result, self.rig, PICTURE_PX // len(self.rig.names))
        self._panel.show_picture(shrunk(drawn, drawn.shape[1]))
        for name, image in pair.images.items():
            self._cameras.show(name, image)
