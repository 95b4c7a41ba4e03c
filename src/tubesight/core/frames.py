"""Pictures of one instant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from tubesight.core.arrays import Image


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
