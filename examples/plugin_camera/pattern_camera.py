"""A camera of another package, to copy: the place of a vendor's driver is taken by a pattern that moves.

`source` is what the entry point names. It reads the text (`pattern:30` for 30 pictures a second), refuses what it does
not understand with a line that says what to do, and opens nothing: `Source.open` does, on the thread that will read.
"""

from __future__ import annotations

import time

import numpy as np

from tubesight.core import InputError
from tubesight.sources.reader import Picture, Source, Wanted


class PatternCamera:
    """The driver: replace what is in here."""

    def __init__(self, hz: float, size_px: tuple[int, int]) -> None:
        self._period_s, self._size_px = 1 / hz, size_px
        self._next_s = time.monotonic()
        self._noise = np.random.default_rng()

    def read(self) -> Picture:
        """Wait for a picture. A driver's own time stamp goes here, turned into the clock of `time.monotonic`."""
        self._next_s += self._period_s
        time.sleep(max(self._next_s - time.monotonic(), 0.0))
        width, height = self._size_px
        columns = 128 + 100 * np.sin((np.arange(width) + 200 * self._next_s) / 20)
        image = columns + self._noise.normal(0, 2, (height, width))
        return Picture(image.clip(0, 255).astype(np.uint8), self._next_s)

    def close(self) -> None:
        """Let the camera go."""


def source(text: str, wanted: Wanted) -> Source:
    """Make a source of ``pattern:HZ``."""
    try:
        hz = float(text.removeprefix("pattern:"))
    except ValueError:
        raise InputError(f"{text}: expected pattern:HZ, for example pattern:30") from None
    size_px = wanted.size_px or (640, 480)
    # Pixels as a sensor gives them, with noise: torn and frozen pictures are then found.
    return Source(f"pattern at {hz:g} Hz", lambda: PatternCamera(hz, size_px), raw=True)
