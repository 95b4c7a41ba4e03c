"""The page of `tubesight capture` and of calibration folders: pictures, the board in them, what is covered."""

from __future__ import annotations

import html
import math
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from tubesight.apps.calibrate import board_of
from tubesight.apps.viewer.cameras import shrunk
from tubesight.apps.viewer.guard import PORT
from tubesight.apps.viewer.page import Page
from tubesight.apps.viewer.panel import badge
from tubesight.calibration.coverage import draw_coverage
from tubesight.calibration.look import Collection, Look, look_at
from tubesight.core import Image, InputError
from tubesight.files.dataset import camera_folders, list_pairs
from tubesight.files.images import read_image

# Pictures in the page are this wide, and shown so many times a second at most.
_PICTURE_PX, _PERIOD_S = 720, 0.1
# Windows that were opened or changed are looked for this often.
_AGAIN_S = 0.3
# Gray level of the ground, and room around each picture.
_GROUND, _ROOM_PX = 24, 8


class BoardPage(Page[tuple[Mapping[str, Image], Mapping[str, Look], Collection, str, bool]]):
    """Shows looks at a board in the browser. Use it as a context manager.

    Parameters
    ----------
    port
        On this machine; 0 takes any free one.
    """

    def __init__(self, port: int = PORT) -> None:
        super().__init__(port, "board page")
        gui = self.server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._state = gui.add_html(badge("waiting", "no picture yet", False))
        self._cameras = gui.add_html("")
        self._todo = gui.add_html("")
        gui.add_markdown(
            "Bright dots: the board now. Green dots: corners of the pairs that are kept. Tinted cells: no corner yet."
        )

    def show(
        self, images: Mapping[str, Image], looks: Mapping[str, Look], collection: Collection, word: str, good: bool
    ) -> None:
        """Show a pair; returns at once.

        Parameters
        ----------
        images, looks
            By camera: its picture, and what it shows of the board.
        collection
            The pairs kept so far.
        word, good
            What became of the pair or what to do, and whether that is good.
        """
        self._slot.put((images, looks, collection, word, good))

    def _run(self) -> None:
        drawn: list[Image] = []
        shown: dict[int, float] = {}
        while not self._ended.is_set():
            taken = self._slot.take(_AGAIN_S)
            if taken is not None:
                drawn, shown = self._show(*taken), {}
            # Each window has pictures of its own shape; one that was opened or changed gets them anew.
            for number, client in self.server.get_clients().items():
                if drawn and shown.get(number) != client.camera.aspect:
                    shown[number] = client.camera.aspect
                    client.scene.set_background_image(
                        arranged(drawn, client.camera.aspect), format="jpeg", jpeg_quality=85
                    )
            self._ended.wait(_PERIOD_S)

    def _show(
        self, images: Mapping[str, Image], looks: Mapping[str, Look], collection: Collection, word: str, good: bool
    ) -> list[Image]:
        """Show what there is to say, and return each camera's picture."""
        with self.server.atomic():
            self._state.content = badge(f"{len(collection)} of {collection.wanted} pairs", word, good)
            self._cameras.content = "".join(_camera(name, look, collection) for name, look in looks.items())
            self._todo.content = _list(collection.lacking())
        return [self._drawn(name, images.get(name), looks, collection) for name in collection.looks]

    def _drawn(self, name: str, image: Image | None, looks: Mapping[str, Look], collection: Collection) -> Image:
        kept = [look.corners.px for look in collection.looks[name] if look.corners is not None]
        look = looks[name]
        now = look.corners.px if look.corners is not None else np.zeros((0, 2))
        picture = draw_coverage(image, look.size_px, np.concatenate([*kept, np.zeros((0, 2))]), now, _PICTURE_PX)
        cv2.putText(picture, name, (12, 30), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (255, 255, 255), 2, cv2.LINE_AA)
        return shrunk(picture, _PICTURE_PX)


class BoardFolder:
    """Goes once through a calibration folder and shows where its boards were.

    Parameters
    ----------
    folder, board_path
        One subfolder of pictures per camera; the board.
    port
        Of the page.

    Raises
    ------
    InputError
        If folder or board cannot be used.
    """

    def __init__(self, folder: Path, board_path: Path, port: int = PORT) -> None:
        self._board = board_of(board_path)
        names = camera_folders(folder)
        if not names:
            raise InputError(f"{folder}: has no subfolder of pictures; name the folder with one per camera")
        self._pairs = list_pairs(folder, names)
        self._collection = Collection(names, len(self._pairs))
        self._ended = threading.Event()
        self.page = BoardPage(port)

    def run(self, pairs: int | None = None) -> None:
        """Look at all pairs, and show what they cover until `stop`; or look at so many."""
        with self.page:
            for stem, paths in self._pairs[:pairs]:
                if self._ended.is_set():
                    return
                images = {name: read_image(path) for name, path in paths.items()}
                looks = {name: look_at(image, self._board) for name, image in images.items()}
                seen = {name: look for name, look in looks.items() if look.corners is not None}
                self._collection.add(seen)
                missing = [name for name in looks if name not in seen]
                word = f"{stem}: no board in {' and '.join(missing)}" if missing else f"{stem}: board in all cameras"
                self.page.show(images, looks, self._collection, word, not missing)
            if pairs is None:
                self._ended.wait()

    def stop(self) -> None:
        """End `run`."""
        self._ended.set()


def arranged(pictures: Sequence[Image], aspect: float) -> Image:
    """Arrange pictures on a ground of a given width over height, in as many columns as show them largest."""
    height, width = (max(p.shape[k] for p in pictures) + 2 * _ROOM_PX for k in (0, 1))

    def canvas(columns: int) -> tuple[float, int, int]:
        rows = math.ceil(len(pictures) / columns)
        wide = max(columns * width, rows * height * aspect)
        return wide, columns, rows

    wide, columns, rows = min(canvas(n) for n in range(1, len(pictures) + 1))
    ground = np.full((round(wide / aspect), round(wide), 3), _GROUND, np.uint8)
    left, top = (ground.shape[1] - columns * width) // 2, (ground.shape[0] - rows * height) // 2
    for k, picture in enumerate(pictures):
        y, x = top + k // columns * height + _ROOM_PX, left + k % columns * width + _ROOM_PX
        ground[max(y, 0) : y + picture.shape[0], max(x, 0) : x + picture.shape[1]] = picture
    return ground


def _camera(name: str, look: Look, collection: Collection) -> str:
    seen = "no board"
    if look.corners is not None:
        seen = f"board, {'sharp' if look.sharp else 'blurred'} ({look.blur_px:.1f} px)"
    quality, turned = collection.covered(name), collection.turned_deg(name)
    covered = html.escape(f"corners cover {quality.coverage_words}; tilts span {turned:.0f}")
    return (
        f'<div style="margin:0.6em 0.8em"><b>{html.escape(name)}</b>: {html.escape(seen)}'
        f'<div style="font-size:0.85em;opacity:0.8">{covered}&deg;</div></div>'
    )


def _list(todo: list[str]) -> str:
    items = "".join(f"<li>{html.escape(line)}</li>" for line in todo) or "<li>nothing is lacking</li>"
    style = "margin:0.2em 0;padding-left:1.2em"
    return f'<div style="margin:0.4em 0.8em"><b>Next</b><ul style="{style}">{items}</ul></div>'
