"""Falls of the tube's share along a line: where an edge may be, before it is measured."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Mask

# Binomial smoothing over five samples: a Gaussian of one sample.
SMOOTHING = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16
# The fall over an edge is measured over this much to both sides of it, and over no more than this share of the width of
# a thin tube: farther inside lies its other edge.
REACH_PX, REACH_WIDTHS = 3.0, 0.4
# Samples along a line: this many over the width of a tube, and how near and far at most.
SAMPLES_PER_WIDTH, SPACING_MIN_PX, SPACING_MAX_PX = 16.0, 0.5, 1.0


def spacing(width_px: float) -> float:
    """Spacing of samples that finds the edges of a tube of a given width."""
    return min(max(width_px / SAMPLES_PER_WIDTH, SPACING_MIN_PX), SPACING_MAX_PX)


def grid(low: float, high: float, step: float) -> Array:
    """Places from `low` on, `step` apart, the last one less than a step beyond `high`."""
    return np.asarray(low + step * np.arange(int((high - low) / step) + 2.0))


def reach_of(width_px: float) -> float:
    """How far to both sides of an edge of a tube of a given width its fall is measured."""
    return min(REACH_PX, REACH_WIDTHS * width_px)


def falls(profile: Array, along: Array, reach_px: float = REACH_PX) -> tuple[Array, Array, Array, Mask]:
    """Falls of profiles (N, L).

    Parameters
    ----------
    along
        (L,) places of the samples, equally spaced.
    reach_px
        How far to both sides the fall is measured.

    Returns
    -------
    place, drop, slope, peak
        (N, L) each: refined place of the steepest fall near the sample, fall over the pixels around it, falling slope
        per pixel of the smoothed profile, and whether it is steepest at this sample. NaN counts as background.
    """
    step = float(along[1] - along[0])
    filled = np.where(np.isfinite(profile), profile, 0.0)
    padded = np.pad(filled, ((0, 0), (2, 2)), mode="edge")
    smooth = np.lib.stride_tricks.sliding_window_view(padded, 5, axis=1) @ SMOOTHING
    slope = np.zeros_like(smooth)
    slope[:, 1:-1] = (smooth[:, :-2] - smooth[:, 2:]) / (2 * step)
    peak = np.zeros(smooth.shape, dtype=bool)
    before, here, after = slope[:, :-2], slope[:, 1:-1], slope[:, 2:]
    peak[:, 1:-1] = (here > before) & (here >= after) & (here > 0)
    reach = int(reach_px / step)
    last = smooth.shape[1] - 1
    index = np.arange(last + 1)
    drop = smooth[:, np.maximum(index - reach, 0)] - smooth[:, np.minimum(index + reach, last)]
    place = np.broadcast_to(along, smooth.shape).copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = 0.5 * (before - after) / (before - 2 * here + after)
    place[:, 1:-1] += np.where(peak[:, 1:-1], step * offset, 0.0)
    return place, drop, slope, peak


def nearest_fall(profile: Array, along: Array, drop_min: float) -> Array:
    """Place (N,) of the fall nearest to 0 among the strong ones of each profile (N, L); NaN where none is."""
    place, drop, slope, peak = falls(profile, along)
    strong = peak & (slope >= 0.5 * slope.max(1, keepdims=True)) & (drop > drop_min)
    distance = np.where(strong, np.abs(place), np.inf)
    best = distance.argmin(1)
    rows = np.arange(len(profile))
    return np.where(np.isfinite(distance[rows, best]), place[rows, best], np.nan)
