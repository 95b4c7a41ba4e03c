"""Walking along the tube with scans normal to its way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tubesight.core import Array, Mask
from tubesight.vision.edges import (
    SIGMA_FIRST_PX,
    Profiles,
    blur_and_displacement,
    colour_profiles,
    left_of,
    measure_edges,
    wide_window,
    window,
)
from tubesight.vision.fitting import solve
from tubesight.vision.pairs import DROP_MIN, find_pair, first_pair
from tubesight.vision.signal import Signal

# A step longer than 1.6 half-widths loses the tube at its bends; half a width leaves room.
STEP_WIDTHS = 0.75
STEP_MIN_PX, STEP_MAX_PX = 4.0, 32.0
# A gap (something across the tube, a highlight) is coasted over for this many widths.
GAP_WIDTHS, GAP_MIN_PX = 2.5, 30.0
# It is told of where it is longer than this (widths).
GAP_TOLD = 1.0
MAX_STEPS = 2000
# The way is a parabola through this many last places (a line through fewer than five), older ones weighing less: by
# this share of their number each step counts 1 / e.
HISTORY, FADE = 6, 3.0
# The width is the median of this many last ones.
WIDTHS = 7
# Scans of the final measurement: this many along the tube, but no nearer to each other than lines that share pixels.
SCANS, FINE_STEP_PX = 32, 6.0
# The blur is measured on every so many-th of them.
BLUR_EVERY = 4
# Edges that lie farther outwards of those of the walk than this, most of the room that their measurement has, are
# looked for first: on sharp pictures of black tubes they lie 0.8 px outwards, on blurred ones 1.3 to 2.8.
WALK_OFF_PX = 1.1
# A step this many times the usual one bridges a gap: nothing is measured there.
GAP_STEPS = 2.5
# An edge stands out of line when it is farther than this from the median of its neighbours, or than so many robust
# deviations (1.4826 median absolute ones).
LINE_PX, LINE_SIGMAS, LINE_NEIGHBOURS = 0.3, 4 * 1.4826, 2


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A tube followed from one place on: middles (N, 2), widths (N,), and gaps bridged (widths of the tube)."""

    middle_px: Array
    width_px: Array
    gaps: tuple[float, ...]

    def widened(self, outwards_px: float) -> Track:
        """Move its edges outwards, as `measure` told."""
        return replace(self, width_px=self.width_px + 2 * outwards_px)


def walk_from_base(signal: Signal, start_px: Array, way: Array, width_px: float) -> Track | None:
    """Follow the tube from the first place behind its base that shows both edges; None where none does."""
    first = first_pair(signal, start_px, way, width_px)
    track = None if first is None else walk(signal, first[0], way, first[1])
    return track if track is not None and len(track.width_px) else None


def walk(signal: Signal, start_px: Array, direction: Array, width_px: float) -> Track:
    """Follow the tube from a place on it until it ends.

    Each step predicts the next middle, way and width from the last ones, looks for the pair of edges there, and
    coasts over gaps of up to `GAP_WIDTHS` widths. One lonely pair after a gap is chance.

    Parameters
    ----------
    start_px, direction
        (2,) a place on the tube and its unit way there.
    width_px
        Width of the tube there.
    """
    step = float(np.clip(STEP_WIDTHS * width_px, STEP_MIN_PX, STEP_MAX_PX))
    middles: list[Array] = []
    widths: list[float] = []
    places: list[float] = []
    gaps: list[float] = []
    place, stride, waiting, alone = 0.0, step, 0.0, False
    for _ in range(MAX_STEPS):
        middle, way = _predict(middles, places, place, start_px, direction)
        width = float(np.median(widths[-WIDTHS:])) if widths else width_px
        found = find_pair(signal, middle, way, width)
        if found is not None:
            middles.append(found[0])
            widths.append(found[1])
            places.append(place)
            alone = waiting > 0
            if alone:
                gaps.append(waiting / width)
            stride, waiting = step, 0.0
        elif waiting == 0 and stride == step and middles:
            # A sharp bend: half the step is tried before a gap is.
            stride = step / 2
            place -= step
        else:
            if alone:
                for values in (middles, widths, places, gaps):
                    values.pop()
                alone = False
            stride = step
            waiting = place - (places[-1] if places else 0.0)
            if waiting > max(GAP_WIDTHS * width, GAP_MIN_PX):
                break
        place += stride
    return Track(np.array(middles).reshape(-1, 2), np.array(widths), tuple(g for g in gaps if g > GAP_TOLD))


def _predict(
    middles: list[Array], places: list[float], place: float, start: Array, direction: Array
) -> tuple[Array, Array]:
    """Extrapolate the way: from the start, then by a line, then by a parabola through the last middles."""
    if len(middles) < 3:
        origin, since = (middles[-1], places[-1]) if middles else (start, 0.0)
        return origin + direction * (place - since), direction
    count = min(len(middles), HISTORY)
    # Steps of one: the history is scaled to it.
    unit = (places[-1] - places[-count]) / count
    t = (np.array(places[-count:]) - place) / unit
    design = np.vander(t, 3 if count >= 5 else 2, increasing=True)
    coefficients = solve(design, np.array(middles[-count:]), np.exp(2 * t / FADE))
    way = coefficients[1] / np.linalg.norm(coefficients[1])
    return np.asarray(coefficients[0]), np.asarray(way)


def measure(signal: Signal, track: Track) -> tuple[Array, float, Array, float]:
    """Measure both edges on scans normal to a followed tube.

    Returns
    -------
    edges_px, blur_px, doubt_px, outwards_px
        (N, 2, 2) left and right edges in order, without scans on which an edge stands out of line, the width of the
        picture's edges, (2,) how far each whole row may be off, and how far outwards of those of the walk the edges
        lie, where that is so far that they had to be looked for.
    """
    middle, way, half = _scans(track)
    if not len(half):
        return np.empty((0, 2, 2)), SIGMA_FIRST_PX, np.ones(2), 0.0
    normal = np.stack([left_of(way), -left_of(way)], 1)
    depth, sides = float(half.min()), np.stack([half, half], 1)

    def lines(along: Array, every: int = 1) -> list[Profiles]:
        origin = middle[::every, None] + normal[::every] * sides[::every, :, None]
        return [colour_profiles(signal, origin[:, k], normal[::every, k], along, depth) for k in range(2)]

    blurs, off = np.array([blur_and_displacement(side) for side in lines(wide_window(), BLUR_EVERY)]).T
    if off.mean() > WALK_OFF_PX:
        sides = sides + off
        blurs = np.array([blur_and_displacement(side)[0] for side in lines(wide_window(), BLUR_EVERY)])
    else:
        off = np.zeros(2)
    blur = float(blurs.min())
    found = [measure_edges(side, np.zeros(len(half)), blur) for side in lines(window(blur, depth))]
    offset = sides + np.stack([e.position_px for e in found], 1)
    edges = middle[:, None] + normal * offset[..., None]
    drop = np.stack([e.drop for e in found], 1)
    good: Mask = np.asarray(np.isfinite(offset).all(1) & (np.nan_to_num(drop) > DROP_MIN).all(1))
    good[good] = _in_line(offset[good])
    return edges[good], blur, np.array([e.doubt_px for e in found]), float(off.mean())


def walked_edges(track: Track) -> Array:
    """Edges (N, 2, 2), left and right, as the walk found them: good to a third of a pixel, also on very thin tubes."""
    left = left_of(np.gradient(track.middle_px, axis=0))
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
    half = track.width_px[:, None] / 2
    return np.stack([track.middle_px + half * left, track.middle_px - half * left], 1)


def _scans(track: Track) -> tuple[Array, Array, Array]:
    """Middles (N, 2), unit ways (N, 2), half widths (N,) of scans along a track: cubic pieces between its places."""
    p = track.middle_px
    steps = np.maximum(np.linalg.norm(np.diff(p, axis=0), axis=1), 1e-9)
    chord = np.concatenate([[0.0], np.cumsum(steps)])
    slope = np.empty_like(p)
    slope[1:-1] = (p[2:] - p[:-2]) / (chord[2:] - chord[:-2])[:, None]
    slope[0], slope[-1] = (p[1] - p[0]) / steps[0], (p[-1] - p[-2]) / steps[-1]
    count = max(min(int(chord[-1] / FINE_STEP_PX) + 1, SCANS), 2)
    s = np.arange(count) * (chord[-1] / (count - 1))
    k = np.clip(np.searchsorted(chord, s, side="right") - 1, 0, len(steps) - 1)
    whole = steps[k] <= GAP_STEPS * np.median(steps)
    s, k = s[whole], k[whole]
    h = steps[k][:, None]
    t = (s - chord[k])[:, None] / h
    a, b, m, n = p[k], p[k + 1], slope[k] * h, slope[k + 1] * h
    middle = a + t * (m + t * (3 * (b - a) - 2 * m - n + t * (2 * (a - b) + m + n)))
    way = m + t * (2 * (3 * (b - a) - 2 * m - n) + 3 * t * (2 * (a - b) + m + n))
    half = (track.width_px[k] * (1 - t[:, 0]) + track.width_px[k + 1] * t[:, 0]) / 2
    return middle, way / np.linalg.norm(way, axis=1, keepdims=True), half


def _in_line(offset: Array) -> Mask:
    """Tell which scans' edges (N, 2) lie on a smooth line."""
    keep = np.ones(len(offset), dtype=bool)
    n = LINE_NEIGHBOURS
    for row in offset.T:
        if len(row) > n:
            running = np.median(
                np.lib.stride_tricks.sliding_window_view(np.pad(row, n, mode="reflect"), 2 * n + 1), axis=1
            )
        else:
            running = np.full(len(row), np.median(row) if len(row) else 0.0)
        off = np.abs(row - running)
        keep &= off <= max(LINE_PX, LINE_SIGMAS * float(np.median(off)) if len(off) else 0.0)
    return keep
