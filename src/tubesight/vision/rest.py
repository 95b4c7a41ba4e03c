"""What a view leaves out: strands as wide as the tube that leave its outline.

A walk that takes a short cut past a loop sees a tube with smooth edges; what it passed by is still in the picture.
"""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.geometry.polyline import lengths_along, points_at
from tubesight.vision.edges import left_of
from tubesight.vision.signal import TUBE, Signal
from tubesight.vision.view import View

# Samples beside the tube: so far from its middle, and from each other along it (widths).
_ASIDE, _APART = 1.0, 0.25
# A strand beside it is so many widths wide, and farther than this from all of the tube's middle line.
_STRAND, _OWN = 0.75, 0.8
# Nothing is looked for so near to the base, where the holder's rim and shadow are (widths).
_BASE = 1.0


def leaves_out(view: View, way_px: Array, signal: Signal) -> bool:
    """Whether something as wide as the tube leaves the tube of a view, to the sides or beyond its tip.

    Parameters
    ----------
    way_px
        (N, 2) the whole middle line of the tube in the picture, base and tip included.
    """
    width = float(np.median(view.widths_px))
    along = lengths_along(way_px)
    places = np.arange(_BASE * width, along[-1], _APART * width)
    if len(places) < 2:
        return False
    middle = points_at(way_px, along, places)
    slope = np.gradient(middle, axis=0)
    left = left_of(slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-9))
    tip = view.tip.contour_px
    radius = float(np.linalg.norm(tip - view.tip.px, axis=1).mean()) if len(tip) else 0.0
    most = int(np.ceil(_STRAND / _APART))
    for side in (1.0, -1.0):
        beside = middle + side * _ASIDE * width * left
        like = np.nan_to_num(signal(beside)) > TUBE
        if like.sum() < most:
            continue
        found = beside[like]
        own = np.linalg.norm(found[:, None] - middle, axis=2).min(1) <= _OWN * width
        like[like] = ~own & (np.linalg.norm(found - view.tip.px, axis=1) > radius + width)
        if (np.convolve(like, np.ones(most), "valid") >= most).any():
            return True
    return False
