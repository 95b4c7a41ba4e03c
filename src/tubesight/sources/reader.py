"""The one protocol of everything that gives pictures of one camera, and what is asked of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from tubesight.core import Image, InputError, Tube
from tubesight.geometry.rig import Rig
from tubesight.simulate import Scene

# A camera that gives nothing for so long is dead: webcams take up to 3 s for their first picture.
TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture and when it was taken.

    Attributes
    ----------
    image
        (H, W) gray or (H, W, 3) BGR, 8 bit.
    time_s
        Of a live camera on the clock of `time.monotonic`; of a file from its beginning; NaN where it is not known.
    coded
        The picture as the camera sent it, empty where it came as pixels.
    skipped
        Pictures before this one that were passed over undecoded, since this one had come in the meantime.
    """

    image: Image
    time_s: float
    coded: bytes = b""
    skipped: int = 0


class Reader(Protocol):
    """Pictures of one camera, one after the other.

    A reader is used by one thread. It is opened by calling what made it, and opened anew after a failure.
    """

    def read(self) -> Picture | None:
        """Wait for the next picture; None at the end.

        Raises
        ------
        BrokenPictureError
            If this picture is damaged; the next may be good.
        InputError
            If the camera is dead.
        """

    def close(self) -> None:
        """Let the camera go."""


class BrokenPictureError(InputError):
    """A picture arrived damaged: cut off, torn, or not decodable. The camera itself is alive."""


@dataclass(frozen=True, slots=True, eq=False)
class Wanted:
    """What is asked of a source; each heeds what concerns it.

    Attributes
    ----------
    camera
        Name of the camera in the rig.
    size_px
        (width, height); None for the camera's own.
    gray
        Whether colour is not needed: gray JPEGs decode in two thirds of the time.
    timeout_s
        A camera that gives nothing for so long is dead.
    rig, tube, scene
        What the simulator photographs, with which cameras.
    """

    camera: str
    size_px: tuple[int, int] | None = None
    gray: bool = False
    timeout_s: float = TIMEOUT_S
    rig: Rig | None = None
    tube: Tube | None = None
    scene: Scene | None = None


@dataclass(frozen=True, slots=True)
class Source:
    """A way to open one camera.

    Attributes
    ----------
    name
        For messages.
    open
        Opens the camera, on the thread that will read it.
    live
        Whether pictures come by themselves. Others (videos, folders, recordings) wait for their reader, who reads them
        at the times they carry.
    raw
        Whether pictures that carry no code of their own are pixels as the sensor gave them, with its noise.
    """

    name: str
    open: Callable[[], Reader]
    live: bool = True
    raw: bool = False


def existing(text: str) -> Path:
    """Turn text into a path that is there."""
    path = Path(text)
    if not path.exists():
        raise InputError(
            f"{text}: no such file or folder; a source is an index, /dev/video0, usb:NAME, http://..., rtsp://..., "
            "a video, a folder, a recording, sim: or fault:SCRIPT:SOURCE"
        )
    return path
