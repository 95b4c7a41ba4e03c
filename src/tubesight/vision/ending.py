"""Where the tube ends along its way."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tubesight.core import Array
from tubesight.vision.edges import left_of
from tubesight.vision.falls import grid, spacing
from tubesight.vision.fitting import solve
from tubesight.vision.signal import Signal

# What becomes of the end of a tube: found, never reached, or outside of the picture.
FOUND, NO_END, BORDER = 0, 1, 2
# The way at the end is a parabola through this many last places, a line through fewer than six.
LAST = 7
# The width there is the median of so many last ones.
WIDTHS = 5
# Lines along the tube whose mean tells whether it goes on, so many widths from each other.
LINES, SPREAD = 3, 0.2
# Samples are taken so many at a time.
CHUNK = 32
# The share falls below this part of its level on the last piece of the tube, for half a width or four samples.
SHARE = 0.5
QUIET_WIDTHS, QUIET_SAMPLES = 0.5, 4
# A place this near to the border of the picture is where the tube leaves it.
BORDER_PX = 2.0


class Ending(NamedTuple):
    """Where a tube ends: outcome, place (2,), unit way (2,) there and width of the tube; NaN where it was not found."""

    outcome: int
    px: Array
    heading: Array
    width_px: float


def find_end(signal: Signal, middle_px: Array, width_px: Array, reach_widths: float) -> Ending:
    """Follow the last part of a track (N, 2), (N,), extrapolated by its way and bend, until the tube ends.

    Parameters
    ----------
    reach_widths
        How far to look, in widths.
    """
    start, way, bend = last_way(middle_px)
    width = float(np.median(width_px[-WIDTHS:]))
    outcome, end = end_of_tube(signal, start, way, bend, width, reach_widths * width)
    left = left_of(way)
    heading = way + bend * end * left
    return Ending(outcome, start + end * way + bend * end**2 / 2 * left, heading / np.linalg.norm(heading), width)


def last_way(middle_px: Array) -> tuple[Array, Array, float]:
    """Place (2,), unit way (2,) and bend (1 / px, positive to the left) at the end of a track (N, 2)."""
    middle = middle_px[-LAST:]
    chord = np.linalg.norm(middle - middle[-1], axis=1)
    scale = max(float(chord.max()), 1e-9)
    design = np.vander(-chord / scale, 3 if len(middle) >= 6 else 2, increasing=True)
    coefficients = solve(design, middle)
    way = coefficients[1] / np.linalg.norm(coefficients[1])
    bend = float(2 * coefficients[2] @ left_of(way)) / scale**2 if len(coefficients) == 3 else 0.0
    return coefficients[0], way, bend


def end_of_tube(
    signal: Signal, start_px: Array, way: Array, bend: float, width_px: float, reach_px: float
) -> tuple[int, float]:
    """Distance from a place on the tube to its end, along its way.

    Parameters
    ----------
    start_px, way, bend
        (2,) a place on the tube, its unit way there and the curvature of the way (1 / px, positive to the left).
    width_px
        Width of the tube.
    reach_px
        How far to look.

    Returns
    -------
    tuple
        `FOUND`, `NO_END` or `BORDER`, and the distance (NaN where it was not found).
    """
    step = spacing(width_px)
    along = grid(-width_px, reach_px, step)
    left = left_of(way)
    path = start_px + along[:, None] * way + (bend * along**2 / 2)[:, None] * left
    sideways = SPREAD * width_px * (np.arange(LINES) - (LINES - 1) / 2)
    share = np.mean([signal(path + offset * left) for offset in sideways], axis=0)
    before = share[(along <= 0) & np.isfinite(share)]
    if not len(before):
        return BORDER, float("nan")
    inside = share >= float(np.median(before)) * SHARE
    quiet = max(int(QUIET_WIDTHS * width_px / step), QUIET_SAMPLES)
    high = np.array([signal.image.shape[1], signal.image.shape[0]]) - 1 - BORDER_PX
    for k in np.flatnonzero(along > 0):
        if k + quiet > len(along):
            break
        if np.isnan(share[k : k + quiet]).any():
            if ((path[k] >= BORDER_PX) & (path[k] <= high)).all():
                continue
            return BORDER, float("nan")
        if not inside[k : k + quiet].any():
            return FOUND, float(along[k])
    return NO_END, float("nan")
