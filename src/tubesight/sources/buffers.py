"""Memory that pictures are decoded into."""

from __future__ import annotations

import sys

import numpy as np

from tubesight.core import Image

# Pictures of one camera that are held at once: those being paired and measured, shown, recorded, and some to spare.
_MOST = 16


class PictureBuffers:
    """Buffers of one camera, each used again when nobody holds the picture in it: for one thread.

    Pictures of megabytes that are allocated anew each time scatter over the heap, which grows for hours.
    """

    def __init__(self) -> None:
        self._own: list[Image] = []

    def take(self, shape: tuple[int, ...]) -> Image:
        """Return memory (H, W, C) that nobody else holds; it is the caller's until the last reference to it is gone."""
        self._own = [buffer for buffer in self._own if buffer.shape == shape]
        for k in range(len(self._own)):
            # One reference is that of the list, one that of the argument; arrays that look into it hold one each.
            if sys.getrefcount(self._own[k]) == 2:
                return self._own[k]
        made = np.empty(shape, np.uint8)
        if len(self._own) < _MOST:
            self._own.append(made)
        return made
