"""Following a tube whose colours change along it: the walk goes on with the colours of its own end."""

from __future__ import annotations

import numpy as np

from tubesight.core import Image, Mask, Unmeasurable
from tubesight.vision.ending import WIDTHS, last_way
from tubesight.vision.signal import Signal
from tubesight.vision.silhouette import ALONG_WIDTHS, signal_of
from tubesight.vision.stages import Stages
from tubesight.vision.walker import MAX_STEPS, Track

# Colours are learned over a piece that ends this many widths before the last place: there its edges were still found.
_BACK_WIDTHS = ALONG_WIDTHS[1] + 0.4
# A place counts as new where it lies this many widths beyond the last one; a single one may be chance.
_BEYOND_WIDTHS, _NEW_MIN = 0.3, 2
# Fewest places that tell a way.
_PLACES_MIN = 4


def follow(
    stages: Stages, image: Image, background: Image | None, signal: Signal, track: Track
) -> tuple[Signal, Track]:
    """Walk on where a walk has stopped, with the colours of its last piece, until that finds nothing new.

    Light, highlights, and the tubes that a robot consists of change the colour along the way; the colours of its start
    then no longer tell it from its surroundings.

    Returns
    -------
    signal, track
        The signal of the last piece, and the whole track.
    """
    while _PLACES_MIN <= len(track.middle_px) < MAX_STEPS:
        place, way, _ = last_way(track.middle_px)
        width = float(np.median(track.width_px[-WIDTHS:]))
        colours = stages.learn(image, background, place - _BACK_WIDTHS * width * way, way, width)
        try:
            there = signal_of(image, background, colours)
        except Unmeasurable:
            break
        more = stages.walk(there, place, way, width)
        new: Mask = np.asarray((more.middle_px - place) @ way > _BEYOND_WIDTHS * width)
        if new.sum() < _NEW_MIN:
            break
        signal, track = there, _joined(track, more, new)
    return signal, track


def _joined(track: Track, more: Track, new: Mask) -> Track:
    return Track(
        np.concatenate([track.middle_px, more.middle_px[new]]),
        np.concatenate([track.width_px, more.width_px[new]]),
        track.gaps + more.gaps,
    )
