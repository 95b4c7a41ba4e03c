"""Going on where a walk is lost although the tube does not end: round corners of its image, and past its own crossings.

A tube that bends towards a camera has corners in its picture, at which no scan shows two edges; one that passes itself
leaves no edges where it does. Two rings about the last place tell which ways lead on from there: where they cross
something as wide as the tube that the walk has not been to. The straightest way on is taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from tubesight.core import Array, Mask
from tubesight.vision.ending import WIDTHS, last_way
from tubesight.vision.signal import TUBE, Signal
from tubesight.vision.stages import Stages
from tubesight.vision.walker import STEP_MIN_PX, STEP_WIDTHS, Track

# Radii of the rings, in widths: the first ones clear of the blob that a corner or a crossing is, the last ones beyond
# what a ball in front of the tube covers.
_RINGS = (1.1, 1.6, 2.1, 2.6, 3.1)
# Places of a ring, to a width.
_PLACES = 8
# A piece of a ring is tube where it is so many widths long; askew it is longer.
_WIDE = (0.5, 2.2)
# Two rings show the same way where it turns by less than this from one to the next (radians).
_TURN = 0.9
# A way leads on where it is so many widths away from where the walk has been.
_NEW_WIDTHS = 0.8
# A walk that finds fewer places than this by then was none of the tube.
_FEWEST = 4
# Corners of one picture: a helix has two a turn.
_CORNERS = 12
# A ring about a tip is so many widths larger than it: the soft edge of a ball is not tube.
_CLEAR_WIDTHS = 0.5
# Steps longer than this many usual ones are gaps.
_NO_GAP = 1.5
# How far back from the last place the rings may begin (places): the last ones before a corner may be beside the tube.
_BACK = (0, 1, 3)


def walk_on(run: Stages, signal: Signal, track: Track, way: Array) -> Track | None:
    """Extend a track past the place where it was lost; None where nothing leads on from there.

    Parameters
    ----------
    track
        With one place or more.
    way
        (2,) unit way at its start, for tracks too short to tell their own.
    """
    for back in _BACK:
        if back >= len(track.middle_px):
            break
        left = len(track.middle_px) - back
        known = Track(track.middle_px[:left], track.width_px[:left], track.gaps)
        if (longer := _past(run, signal, known, track, way)) is not None:
            return longer
    return None


def walks_on(run: Stages, signal: Signal, track: Track, way: Array) -> Iterator[Track]:
    """Yield a track, and as it goes on round one corner more each time."""
    for _ in range(_CORNERS):
        yield track
        longer = walk_on(run, signal, track, way)
        if longer is None:
            return
        track = longer


def other_ways(run: Stages, signal: Signal, track: Track, way: Array) -> Iterator[Track]:
    """Yield tracks that leave another one at its gaps, by ways that it did not take, and what they lead on to.

    Where a tube passes itself at a small angle the way it takes cannot be told from one that it crosses.
    """
    steps = np.linalg.norm(np.diff(track.middle_px, axis=0), axis=1)
    for k in np.flatnonzero(steps > _NO_GAP * np.median(steps)):
        known = Track(track.middle_px[: k + 1], track.width_px[: k + 1], ())
        other = _past(run, signal, known, track, way)
        if other is not None:
            yield from walks_on(run, signal, other, way)


def leads_on(signal: Signal, tip_px: Array, radius_px: float, track: Track) -> bool:
    """Whether something as wide as the tube leads away from a tip, beside the tube itself."""
    width = float(np.median(track.width_px[-WIDTHS:]))
    _, way, _ = last_way(track.middle_px)
    around = _crossed(signal, tip_px, way, float(np.fmax(radius_px, width / 2)) + _CLEAR_WIDTHS * width, width)
    return len(around) > 1


def _past(run: Stages, signal: Signal, known: Track, walked: Track, way: Array) -> Track | None:
    """Extend the `known` part of what was walked; None where nothing leads on."""
    place = known.middle_px[-1]
    if len(known.middle_px) >= _FEWEST:
        place, way, _ = last_way(known.middle_px)
    width = float(np.median(known.width_px[-WIDTHS:]))
    for start, forward in _ways_on(signal, place, way, width, walked.middle_px):
        more = run.walk(signal, start, forward, width)
        if len(more.middle_px) >= _FEWEST and _is_new(more.middle_px[:_FEWEST], walked.middle_px, width).all():
            back = _back_to(run, signal, more, walked.middle_px)
            middle, size = np.concatenate([back.middle_px, more.middle_px]), np.append(back.width_px, more.width_px)
            gap = float(np.linalg.norm(middle[0] - known.middle_px[-1])) / width
            return Track(
                np.concatenate([known.middle_px, middle]),
                np.append(known.width_px, size),
                (*known.gaps, gap, *more.gaps),
            )
    return None


def _back_to(run: Stages, signal: Signal, more: Track, been: Array) -> Track:
    """Places between the corner and where the walk beyond it began, in its order."""
    width = float(np.median(more.width_px[:WIDTHS]))
    way = more.middle_px[0] - more.middle_px[_FEWEST - 1]
    back = run.walk(signal, more.middle_px[0], way / np.linalg.norm(way), width)
    # Its first place is that where the other walk began; what follows a gap lies beyond the corner.
    steps = np.linalg.norm(np.diff(back.middle_px, axis=0), axis=1)
    good = (steps < STEP_WIDTHS * _NO_GAP * width + STEP_MIN_PX) & _is_new(back.middle_px[1:], been, width)
    count = len(good) if good.all() else int(np.argmin(good))
    return Track(back.middle_px[count:0:-1], back.width_px[count:0:-1], ())


def _ways_on(signal: Signal, place: Array, way: Array, width: float, been: Array) -> list[tuple[Array, Array]]:
    """Places (2,) and unit ways (2,) that lead on from a place, the straightest first."""
    rings = [_crossed(signal, place, way, ring * width, width) for ring in _RINGS]
    found = []
    for inner, outer in pairwise(rings):
        for angle, here in outer:
            if not _is_new(here[None], been, width)[0]:
                continue
            before = [there for other, there in inner if abs(other - angle) < _TURN]
            if before:
                step = here - min(before, key=lambda there: float(np.linalg.norm(here - there)))
                found.append((abs(angle), here, step / np.linalg.norm(step)))
    found.sort(key=lambda each: each[0])
    return [(here, forward) for _, here, forward in found]


def _crossed(signal: Signal, place: Array, way: Array, radius: float, width: float) -> list[tuple[float, Array]]:
    """Angles from a way at which a ring crosses something as wide as the tube, and the places (2,) there."""
    count = int(2 * np.pi * radius / width * _PLACES)
    # From behind, round to behind: the tube that leads there is not cut in two by the ends of the ring.
    angle = np.linspace(-np.pi, np.pi, count, endpoint=False)
    left = np.array([way[1], -way[0]])
    ring = place + radius * (np.cos(angle)[:, None] * way + np.sin(angle)[:, None] * left)
    inside = np.concatenate([[False], np.nan_to_num(signal(ring)) > TUBE, [False]])
    first, last = np.flatnonzero(inside[1:] & ~inside[:-1]), np.flatnonzero(inside[:-1] & ~inside[1:]) - 1
    middle = (angle[first] + angle[last]) / 2
    chord = 2 * radius * np.sin((angle[last] - angle[first]) / 2)
    wide = (chord > _WIDE[0] * width) & (chord < _WIDE[1] * width)
    return [(float(a), place + radius * (np.cos(a) * way + np.sin(a) * left)) for a in middle[wide]]


def _is_new(places: Array, been: Array, width: float) -> Mask:
    """Tell which places (N, 2) are away from where the walk has been (M, 2)."""
    off = np.linalg.norm(places[:, None] - been, axis=2).min(1)
    return np.asarray(off > _NEW_WIDTHS * width)
