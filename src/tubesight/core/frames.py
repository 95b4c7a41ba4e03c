"""Pictures as cameras give them, and pictures of one instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tubesight.core.arrays import Image


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One picture of one camera.

    Attributes
    ----------
    camera
        Name.
    image
        (H, W) gray or (H, W, 3) BGR, 8 bit.
    time_s
        When it was taken, on the clock that all cameras of a rig share; where a camera does not tell, when it arrived.
    number
        Counts the camera's pictures; a gap is a picture lost before it got here.
    coded
        The picture as the camera sent it (a whole JPEG), empty where it came as pixels.
    decoded_s
        When its pixels were there, on this machine's clock (`time.monotonic`); NaN for stored pictures.
    """

    camera: str
    image: Image
    time_s: float
    number: int = 0
    coded: bytes = b""
    decoded_s: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """Pictures of one instant by camera name (two or more cameras).

    Attributes
    ----------
    images
        By camera name: (H, W) gray or (H, W, 3) BGR, 8 bit.
    name
        The pictures' common stem.
    time_s
        Time of the instant; NaN where it is not known.
    """

    images: Mapping[str, Image]
    name: str = ""
    time_s: float = float("nan")
