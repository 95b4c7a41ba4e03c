"""What people can do in the viewer, and the part of the panel where they do it."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, cast, get_args

import viser

from tubesight.apps.live.options import PictureMode
from tubesight.apps.switch import SensorSwitch
from tubesight.core import Array, InputError
from tubesight.methods import METHODS

# How many times deviations are enlarged at first, and at most: they are far thinner than the tube's line on a screen.
_ENLARGE, _ENLARGE_MAX = 10, 50
_START, _STOP = "start recording", "stop recording"


class Recordable(Protocol):
    """Recordings that can be begun and ended; see `tubesight.apps.live.steering.SessionRecording`."""

    pictures: PictureMode

    @property
    def folder(self) -> Path:
        """Where they are written."""

    @property
    def running(self) -> bool:
        """Whether one runs."""

    @property
    def name(self) -> str:
        """Name of the file that is written, or a new one."""

    def start_named(self, name: str, pictures: PictureMode) -> None:
        """Begin one; raise `InputError` where that cannot be."""

    def stop(self) -> None:
        """End it."""

    def words(self) -> str:
        """Say what is written, and where."""


@dataclass(frozen=True, slots=True)
class Controls:
    """What people can do in the viewer; what is None is not offered.

    Attributes
    ----------
    methods, on_method
        Names of pipelines, the one in use first, and what to do when another is chosen.
    marks, on_mark
        What can be marked on a picture (base, tip), and a function that is then called with one of these, a camera's
        name and a pixel (2,).
    recording
        What can be begun and ended.
    """

    methods: Sequence[str] = ()
    on_method: Callable[[str], None] | None = None
    marks: Sequence[str] = ()
    on_mark: Callable[[str, str, Array], None] | None = None
    recording: Recordable | None = None


def controls_of(switch: SensorSwitch, recording: Recordable | None = None) -> Controls:
    """Return what can be done with a sensor wherever its results are shown: another method, a mark on the base."""
    now = switch.current.method
    names = (now, *(name for name in METHODS if name != now))
    return Controls(names, switch.use, ("base",), lambda _, camera, px: switch.mark(camera, px), recording)


class ControlFolder:
    """The controls in the panel.

    Parameters
    ----------
    gui, controls, order
        Where, what, and at which place of the panel.

    Attributes
    ----------
    enlarge
        How many times deviations are to be enlarged; 0 hides them.
    """

    def __init__(self, gui: viser.GuiApi, controls: Controls, order: float) -> None:
        self.enlarge, self._mark, self._on_mark = _ENLARGE, "", controls.on_mark
        self._recording = RecordingFolder(gui, controls.recording, order) if controls.recording is not None else None
        with gui.add_folder("controls", order=order):
            if controls.on_method is not None and controls.methods:
                chosen, on_method = gui.add_dropdown("pipeline", tuple(controls.methods)), controls.on_method
                chosen.on_update(lambda event: on_method(event.target.value))
            if controls.on_mark is not None:
                buttons = gui.add_button_group(
                    "mark in 3-D", tuple(controls.marks), hint="then click its place on a camera's picture in the scene"
                )
                buttons.on_click(lambda event: setattr(self, "_mark", str(event.target.value)))
            enlarged = gui.add_slider("uncertainty", 0, _ENLARGE_MAX, 1, _ENLARGE, hint="enlarged so often; 0 hides it")
            enlarged.on_update(lambda event: setattr(self, "enlarge", int(event.target.value)))

    def clicked(self, camera: str, px: Array) -> None:
        """Take a click on a camera's picture; it counts where something is being marked."""
        if self._mark and self._on_mark is not None:
            self._on_mark(self._mark, camera, px)
            self._mark = ""

    def show(self) -> None:
        """Bring what changes by itself up to date."""
        if self._recording is not None:
            self._recording.show()


class RecordingFolder:
    """File name, button, and what is written, in words."""

    def __init__(self, gui: viser.GuiApi, recording: Recordable, order: float) -> None:
        self._recording, self._failure = recording, ""
        with gui.add_folder("recording", order=order):
            self._name = gui.add_text("file", recording.name, hint=f"in {recording.folder}")
            modes: tuple[str, ...] = get_args(PictureMode)
            self._pictures = gui.add_dropdown("pictures", modes, initial_value=recording.pictures)
            self._button = gui.add_button(_START)
            self._said = gui.add_html("")
        self._button.on_click(lambda _: self._pressed())
        self.show()

    def _pressed(self) -> None:
        recording = self._recording
        self._failure = ""
        try:
            if recording.running:
                recording.stop()
            else:
                recording.start_named(str(self._name.value), cast("PictureMode", self._pictures.value))
        except InputError as error:
            self._failure = str(error)
        self.show()

    def show(self) -> None:
        """Say what is written."""
        running = self._recording.running
        label, content = (
            _STOP if running else _START,
            said(self._failure or self._recording.words(), bool(self._failure)),
        )
        if self._button.label != label:
            self._button.label, self._button.color = label, "red" if running else None
            self._name.disabled = self._pictures.disabled = running
            self._name.value = self._recording.name  # type: ignore[misc]
        if self._said.content != content:
            self._said.content = content


def said(text: str, bad: bool = False) -> str:
    """HTML of a sentence below other things of the panel."""
    colour = "color:#d0463b;" if bad else "opacity:0.8;"
    style = f"font-size:0.85em;{colour}margin:0.2em 0.8em 0.6em;overflow-wrap:anywhere"
    return f'<div style="{style}">{html.escape(text)}</div>'
