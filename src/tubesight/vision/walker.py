"""Walking along the tube with scans normal to its way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from tubesight.core import Array, Mask
from tubesight.vision.edges import (
    SPACING_PX,
    blur_of,
    colour_profiles,
    left_of,
    measure_edges,
    profiles,
    refine,
    steepest,
)
from tubesight.vision.signal import Signal

# A step longer than 1.6 half-widths loses the tube at its bends; half a width leaves room.
_STEP_WIDTHS = 0.5
_STEP_MIN_PX, _STEP_MAX_PX = 4.0, 16.0
# A scan reaches this far beyond the half width, in widths and pixels: room for the prediction's error and the plateaus.
_MARGIN_WIDTHS, _MARGIN_PX = 0.7, 10.0
# Fall of the tube's share under which an edge is noise.
_DROP_MIN = 0.2
# Agreement with the prediction: how far the width and the middle may be off, in widths (and pixels).
_WIDTH_OFF, _MIDDLE_OFF = 0.12, 0.25
_OFF_PX = 1.5
# A gap (something across the tube, a highlight) is coasted over for this many widths.
_GAP_WIDTHS = 2.5
# Distance between the scans of the final measurement.
_FINE_STEP_PX = 6.0
_MAX_STEPS = 4000


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A tube followed from one place on: middles (N, 2), widths (N,), and gaps bridged (widths of the tube)."""

    middle_px: Array
    width_px: Array
    gaps: tuple[float, ...]


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
    half = width_px * (0.5 + _MARGIN_WIDTHS) + _MARGIN_PX
    along = np.arange(-half, half + SPACING_PX, SPACING_PX)
    left = left_of(direction)
    profile = profiles(signal, middle_px[None], left[None], along)[0]
    smooth, slope = steepest(profile, along)
    reach = int(3.0 / SPACING_PX)
    falls = _peaks(slope)
    rises = _peaks(-slope)
    drop_left = _drop(smooth, falls, reach)
    drop_right = _drop(smooth[::-1], len(along) - 1 - rises, reach)
    falls, drop_left = falls[drop_left > _DROP_MIN], drop_left[drop_left > _DROP_MIN]
    rises, drop_right = rises[drop_right > _DROP_MIN], drop_right[drop_right > _DROP_MIN]
    if not len(falls) or not len(rises):
        return None
    width = along[falls][:, None] - along[rises][None]
    middle = (along[falls][:, None] + along[rises][None]) / 2
    score = np.minimum(drop_left, 1.0)[:, None] + np.minimum(drop_right, 1.0)[None]
    score -= (middle / (_MIDDLE_OFF * width_px + _OFF_PX)) ** 2
    if known_width:
        score -= ((width - width_px) / (_WIDTH_OFF * width_px + _OFF_PX)) ** 2
    score = np.where(width > 2.0, score, -np.inf)
    i, j = np.unravel_index(int(score.argmax()), score.shape)
    # The best pair of a clear tube scores near 2; 0 lets each deviation cost a full edge.
    if score[i, j] < 0:
        return None
    edges = refine(np.stack([profile, profile[::-1]]), along, np.array([along[falls[i]], -along[rises[j]]]))
    high, low = edges[0], -edges[1]
    if not (np.isfinite(high) and np.isfinite(low) and high - low > 2.0):
        return None
    return middle_px + left * (high + low) / 2, float(high - low)


def _peaks(slope: Array) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    inner = slope[1:-1]
    return np.flatnonzero((inner > slope[:-2]) & (inner >= slope[2:]) & (inner > 0)) + 1


def _drop(smooth: Array, index: np.ndarray[tuple[int], np.dtype[np.intp]], reach: int) -> Array:
    last = len(smooth) - 1
    return np.asarray(smooth[np.clip(index - reach, 0, last)] - smooth[np.clip(index + reach, 0, last)])


def walk(signal: Signal, start_px: Array, direction: Array, width_px: float) -> Track:
    """Follow the tube from a place on it until it ends.

    Each step predicts the next middle, way and width from the last ones, looks for the pair of edges there, and
    coasts over gaps of up to `_GAP_WIDTHS` widths.

    Parameters
    ----------
    start_px, direction
        (2,) a place on the tube and its unit way there.
    width_px
        Width of the tube there.
    """
    step = float(np.clip(_STEP_WIDTHS * width_px, _STEP_MIN_PX, _STEP_MAX_PX))
    middles: list[Array] = []
    widths: list[float] = []
    places: list[float] = []
    gaps: list[float] = []
    place, waiting = 0.0, 0.0
    pending = 0
    for _ in range(_MAX_STEPS):
        middle, way = _predict(middles, places, place, start_px, direction)
        width = float(np.median(widths[-7:])) if widths else width_px
        found = find_pair(signal, middle, way, width)
        if found is not None:
            middles.append(found[0])
            widths.append(found[1])
            places.append(place)
            pending = pending + 1 if waiting > 0 or pending else 0
            if waiting > 0:
                gaps.append(waiting / width)
                waiting = 0.0
            if pending >= 2:
                pending = 0
        else:
            if pending:  # one lonely pair after a gap is chance
                middles.pop()
                widths.pop()
                waiting = place - (places[-2] if len(places) > 1 else 0.0)
                places.pop()
                gaps.pop()
                pending = 0
            waiting += step
            if waiting > _GAP_WIDTHS * width:
                break
        place += step
    return Track(np.array(middles).reshape(-1, 2), np.array(widths), tuple(g for g in gaps if g > 1.0))


def _predict(
    middles: list[Array], places: list[float], place: float, start: Array, direction: Array
) -> tuple[Array, Array]:
    """Extrapolate the way: from the start, then by a line, then by a parabola through the last middles."""
    if len(middles) < 3:
        origin, since = (middles[-1], places[-1]) if middles else (start, 0.0)
        return origin + direction * (place - since), direction
    count = min(len(middles), 8)
    t = np.array(places[-count:]) - place
    order = 2 if count >= 5 else 1
    design = np.vander(t, order + 1, increasing=True)
    weights = np.exp(t / (4 * abs(t[-1] - t[0]) / count + 1e-9))[:, None]
    coefficients = np.linalg.lstsq(design * weights, np.array(middles[-count:]) * weights, rcond=None)[0]
    way = coefficients[1] / np.linalg.norm(coefficients[1])
    return np.asarray(coefficients[0]), np.asarray(way)


def measure(signal: Signal, track: Track) -> tuple[Array, float, Array]:
    """Measure both edges on scans normal to a followed tube.

    Returns
    -------
    edges_px, blur_px, doubt_px
        (N, 2, 2) left and right edges in order, without scans on which an edge stands out of line, the width of the
        picture's edges, and (2,) how far each whole row may be off.
    """
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track.middle_px, axis=0), axis=1))])
    spline = CubicSpline(chord, track.middle_px)
    count = max(int(chord[-1] / _FINE_STEP_PX) + 1, 2)
    s = np.linspace(0.0, chord[-1], count)
    gap = np.diff(chord)[np.clip(np.searchsorted(chord, s, side="right") - 1, 0, len(chord) - 2)]
    s = s[gap <= 2.5 * np.median(np.diff(chord))]
    middle, way = spline(s), spline(s, 1)
    left = left_of(way / np.linalg.norm(way, axis=1, keepdims=True))
    half = np.interp(s, chord, track.width_px) / 2
    reach = float(half.max()) + 2 * _MARGIN_PX
    along = np.arange(0.0, reach, SPACING_PX)
    lines = [colour_profiles(signal, middle, side, along, float(half.min())) for side in (left, -left)]
    guesses = [refine(profiles(signal, middle, side, along), along, half) for side in (left, -left)]
    guesses = [np.where(np.isfinite(guess), guess, half) for guess in guesses]
    blur = min(blur_of(side, guess) for side, guess in zip(lines, guesses, strict=True))
    found = [measure_edges(side, guess, blur) for side, guess in zip(lines, guesses, strict=True)]
    offset = np.stack([e.position_px for e in found], 1)
    edges = np.stack([middle + left * offset[:, :1], middle - left * offset[:, 1:]], 1)
    drop = np.stack([e.drop for e in found], 1)
    good: Mask = np.asarray(np.isfinite(offset).all(1) & (np.nan_to_num(drop) > _DROP_MIN).all(1))
    good[good] = _in_line(s[good], offset[good])
    return edges[good], blur, np.array([e.doubt_px for e in found])


def _in_line(s: Array, offset: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Tell which scans' edges (N, 2) lie on a smooth line: within 4 robust deviations of a running median."""
    keep = np.ones(len(s), dtype=bool)
    for side in range(2):
        padded = np.pad(offset[:, side], 4, mode="reflect") if len(s) > 4 else offset[:, side]
        running = (
            np.median(np.lib.stride_tricks.sliding_window_view(padded, 9), axis=1)
            if len(s) > 4
            else np.full(len(s), np.median(offset[:, side]))
        )
        off = np.abs(offset[:, side] - running)
        keep &= off <= max(0.3, 4 * 1.4826 * float(np.median(off)))
    return keep
