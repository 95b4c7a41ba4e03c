"""Pieces of tube put in order: which one goes on where another one stops, from the base on.

Where a tube passes itself, the strand that goes straight on is the same one: place, way and bend continue. Each join of
two ends of pieces has a cost, how far it is from a curve whose bend changes evenly between them, and how much of it
lies beside the silhouette; what a chain leaves out costs as well. The best few chains are returned: which of them is
the tube's shape may only show in the other pictures.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tubesight.core import Array
from tubesight.vision.ending import LAST, last_way
from tubesight.vision.pieces import Piece, Silhouette

# The way and the bend at an end are those of so many last widths.
_END_WIDTHS = 2.5
# Deviation of the angle by which a join turns from that of an even bend (radians), and of its ends (widths).
_TURN_SD, _PLACE_SD = 0.35, 0.2
# The logarithm of the width changes by so much, and as much again over so many widths.
_WIDER_SD, _WIDER_WITHIN = 0.15, 3.0
# A bend is not continued further than to this angle (radians).
_TURN_MOST = 1.0
# Costs a width: of a join, of a join beside the silhouette, and of a piece that a chain leaves out.
_LONG, _BESIDE, _LEFT_OUT = 0.1, 1.0, 0.5
# What a corner of any angle costs, and joins that cost more are none.
_CORNER, _COST_MOST = 8.0, 25.0
# Samples of a join.
_SAMPLES = 16
# Chains that are followed at a time, and that are returned.
_FOLLOWED, _RETURNED = 40, 8


class _End(NamedTuple):
    """An end of a piece as one leaves it: place (2,), unit way (2,), bend (1 / px, positive to the left) and width."""

    px: Array
    way: Array
    bend: float
    width_px: float


class Chain(NamedTuple):
    """Pieces in order, each from base to tip, and the chain's cost."""

    pieces: tuple[Piece, ...]
    cost: float


def chains(silhouette: Silhouette, start_px: Array, way: Array, width_px: float) -> list[Chain]:
    """Return the likeliest orders of the pieces of a silhouette, the best first.

    Parameters
    ----------
    start_px, way
        (2,) where the tube starts, and its unit way there.
    width_px
        Width of the tube there.
    """
    pieces = [(p, _turned(p)) for p in silhouette.pieces]
    ends = [[_end_of(side, width_px) for side in both] for both in pieces]
    size = [float(np.linalg.norm(np.diff(p.middle_px, axis=0), axis=1).sum()) / width_px for p, _ in pieces]

    def joins(end: _End, used: tuple[tuple[int, int], ...]) -> list[tuple[float, int, int]]:
        taken = {k for k, _ in used}
        return [
            (cost, k, side)
            for k in range(len(pieces))
            if k not in taken
            for side in (0, 1)
            # Piece `k` is passed as its side `side`: it is entered where the other one is left.
            if (cost := _join(end, ends[k][1 - side], silhouette, width_px)) < _COST_MOST
        ]

    found: list[tuple[float, tuple[tuple[int, int], ...]]] = []
    followed: list[tuple[float, tuple[tuple[int, int], ...]]] = [(_LEFT_OUT * sum(size), ())]
    while followed:
        longer = []
        for cost, used in followed:
            end = ends[used[-1][0]][used[-1][1]] if used else _End(start_px, way, 0.0, width_px)
            longer += [(cost + more - _LEFT_OUT * size[k], (*used, (k, side))) for more, k, side in joins(end, used)]
        followed = sorted(longer)[:_FOLLOWED]
        found += followed
    return [Chain(tuple(pieces[k][side] for k, side in used), cost) for cost, used in sorted(found)[:_RETURNED]]


def _turned(piece: Piece) -> Piece:
    return Piece(piece.middle_px[::-1], piece.half_px[::-1])


def _end_of(piece: Piece, width_px: float) -> _End:
    from_end = np.linalg.norm(piece.middle_px - piece.middle_px[-1], axis=1)
    first = int(np.flatnonzero(from_end > _END_WIDTHS * width_px).max(initial=0))
    used = np.unique(np.linspace(first, len(from_end) - 1, LAST).astype(int))
    return _End(*last_way(piece.middle_px[used]), 2 * float(np.median(piece.half_px[first:])))


def _join(one: _End, other: _End, silhouette: Silhouette, width_px: float) -> float:
    """Cost of going on from one end to another one, which is left the other way."""
    chord = other.px - one.px
    size = max(float(np.linalg.norm(chord)), 1e-9)
    # Of a curve whose bend changes evenly from a to b the chord makes these angles with both ends.
    a, b = one.bend * size / 6, -other.bend * size / 6
    first = _angle(one.way, chord) - np.clip(2 * a + b, -_TURN_MOST, _TURN_MOST)
    last = _angle(chord, -other.way) - np.clip(a + 2 * b, -_TURN_MOST, _TURN_MOST)
    wider = np.log(other.width_px / one.width_px) / (_WIDER_SD * (1 + size / width_px / _WIDER_WITHIN))
    square = (_TURN_SD**2 + (_PLACE_SD * width_px / size) ** 2) * 2
    off = wider**2 / 2 + (_wrapped(first) ** 2 + _wrapped(last) ** 2) / square
    cost = off / (1 + off / _CORNER) + _LONG * size / width_px
    t = np.linspace(0, 1, _SAMPLES)[:, None]
    way = one.px + t * size * one.way * (1 - t) ** 2 + t**2 * (3 - 2 * t) * chord + t**2 * (1 - t) * size * other.way
    return float(cost + _BESIDE * np.mean(~silhouette.covers(way)) * size / width_px)


def _angle(one: Array, other: Array) -> float:
    """Angle from one way to another one, positive to the left (y down)."""
    return float(np.arctan2(one[1] * other[0] - one[0] * other[1], one @ other))


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
