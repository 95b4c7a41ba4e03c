"""The two edges of the tube on one scan across it."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array
from tubesight.vision.edges import left_of, profiles
from tubesight.vision.falls import falls, grid, reach_of, spacing
from tubesight.vision.signal import Signal

# A scan looks this far to both sides of where the edges are expected (widths, pixels); where no pair there is sure, it
# reaches as far as a pair may be off instead, unless nothing there looks like tube (share). Where the width is not
# known it reaches this far beyond both half widths.
NEAR_WIDTHS, NEAR_PX = 0.08, 4.5
MARGIN_WIDTHS, MARGIN_PX = 0.7, 10.0
SHARE_SEEN = 0.3
# Falls are not seen on the last pixels of a scan.
END_PX = 3.0
# The best pair of a clear tube scores near 2; a pair is sure above this, and 0 lets each deviation cost a full edge.
SCORE_SURE = 1.0
# Fall of the tube's share under which an edge is noise.
DROP_MIN = 0.2
# Agreement with the prediction: how far the width and the middle may be off, in widths (and pixels).
WIDTH_OFF, MIDDLE_OFF = 0.12, 0.25
OFF_PX = 1.5
# Narrower pairs are noise. (The likeness of a tube of 2 px, mixed with what is beside it, is this narrow.)
WIDTH_MIN_PX = 1.2
# The tube may be hidden in the clamp's shadow or rim: its first pair of edges is looked for from here on, in widths.
FIRST_WIDTHS, FIRST_STEP, FIRST_COUNT = 0.3, 0.15, 18


def first_pair(signal: Signal, start_px: Array, way: Array, width_px: float) -> tuple[Array, float] | None:
    """Find the first place from the base on where the tube shows both edges: its middle (2,) and width."""
    for k in range(FIRST_COUNT):
        place = (FIRST_WIDTHS + k * FIRST_STEP) * width_px
        found = find_pair(signal, start_px + place * way, way, width_px)
        if found is not None:
            return found
    return None


def find_pair(
    signal: Signal, middle_px: Array, direction: Array, width_px: float, known_width: bool = True
) -> tuple[Array, float] | None:
    """Find the tube's two edges on one scan across its way.

    Parameters
    ----------
    middle_px, direction
        (2,) predicted middle and unit way of the tube.
    width_px
        Predicted width.
    known_width
        False where `width_px` is only an upper bound.

    Returns
    -------
    tuple or None
        Middle (2,) and width, or None where no pair of edges looks like the tube.
    """
    middle, near = width_px / 2, NEAR_WIDTHS * width_px + NEAR_PX
    score, left, right, seen = -np.inf, 0.0, 0.0, True
    if known_width:
        score, left, right, seen = _best_pair(
            signal, middle_px, direction, width_px, True, middle - near, middle + near
        )
    if score < SCORE_SURE and seen:
        low, high = wide(width_px, known_width)
        score, left, right, _ = _best_pair(signal, middle_px, direction, width_px, known_width, low, high)
    if not score >= 0:
        return None
    return middle_px + left_of(direction) * (left - right) / 2, left + right


def wide(width_px: float, known_width: bool) -> tuple[float, float]:
    """Where edges of a pair may lie on both sides: with a known width, those whose score can be positive."""
    if not known_width:
        reach = width_px * (0.5 + MARGIN_WIDTHS) + MARGIN_PX
        return -reach, reach
    most = np.sqrt(2.0)  # two full edges allow deviations of this many units together
    off = most * (MIDDLE_OFF * width_px + OFF_PX) + most / 2 * (WIDTH_OFF * width_px + OFF_PX) + END_PX
    return width_px / 2 - off, width_px / 2 + off


def _best_pair(
    signal: Signal, middle: Array, way: Array, width: float, known_width: bool, low: float, high: float
) -> tuple[float, float, float, bool]:
    """Score of the best pair of edges, their distances from the middle to both sides, and whether there is any tube.

    Edges are looked for between `low` and `high` on both sides.
    """
    along = grid(low, high, spacing(width))
    left = left_of(way)
    share = profiles(signal, np.stack([middle, middle]), np.stack([left, -left]), along, (0.0,))
    seen = bool((share > SHARE_SEEN).any())
    place, drop, _, peak = falls(share, along, reach_of(width))
    good = peak & (drop > DROP_MIN)
    if not good.any(1).all():
        return -np.inf, 0.0, 0.0, seen
    a, b = place[0, good[0]], place[1, good[1]]
    sizes, offs = a[:, None] + b, (a[:, None] - b) / 2
    score = np.minimum(drop[0, good[0]], 1.0)[:, None] + np.minimum(drop[1, good[1]], 1.0)
    score -= (offs / (MIDDLE_OFF * width + OFF_PX)) ** 2
    if known_width:
        score -= ((sizes - width) / (WIDTH_OFF * width + OFF_PX)) ** 2
    score = np.where(sizes > WIDTH_MIN_PX, score, -np.inf)
    i, j = np.unravel_index(int(score.argmax()), score.shape)
    return float(score[i, j]), float(a[i]), float(b[j]), seen
