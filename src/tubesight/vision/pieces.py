"""Pieces of tube in a picture: where its silhouette is as wide as one tube, whatever lies between.

Where a tube passes itself, turns sharply towards the camera or is covered, its silhouette is no band as wide as the
tube. The rest is: the middle lines of the silhouette (Zhang & Suen 1984), cut where they branch and where the
silhouette is wider or narrower, are the pieces that `chains` puts in order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from tubesight.core import Array, Mask
from tubesight.vision.signal import TUBE, Signal

# The tube is this wide in the shrunk picture: half a pixel of it, by which the middle line is off, is a twentieth.
_SHRUNK_PX = 10.0
# A first look is so many times coarser, and takes what is so much like tube: the tube is then 2.5 pixels wide.
_COARSER, _FAINT = 4, 0.25
# A silhouette may be one tube where it is so many widths at the base wide (nearer to the camera or farther from it),
# and where it does not widen or narrow faster than this (widths by width): strands that part do.
_ONE_TUBE, _STEADY = (0.45, 2.0), 0.3
# Highlights of up to two fifths of the tube's width are closed.
_CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
# Shorter pieces (widths) are spurs of the middle line.
_SHORTEST = 0.8
# Ends of pieces are cut by this much (widths): there the middle line bends towards what it meets.
_CUT = 0.3
# A picture with a longer middle line (pixels of it) shows no tube but texture; of more pieces the longest are kept.
_LINE_MOST, _PIECES_MOST = 20_000, 24
# Neighbours of a pixel, round it (rows, columns).
_ROUND = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))


class Piece(NamedTuple):
    """Middles (N, 2), about a pixel of the shrunk picture apart, and half widths (N,) of one piece of tube, pixels."""

    middle_px: Array
    half_px: Array


class Silhouette(NamedTuple):
    """What looks like tube (h, w), where it begins (2,) and how large its pixels (2,) are, and its pieces."""

    mask: Mask
    corner_px: Array
    pixel_px: Array
    pieces: tuple[Piece, ...]

    def covers(self, points_px: Array) -> Mask:
        """Which points (N, 2) of the picture lie on the silhouette."""
        height, width = self.mask.shape
        column, row = np.floor((points_px - self.corner_px + 0.5) / self.pixel_px).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.asarray(inside & self.mask[np.where(inside, row, 0), np.where(inside, column, 0)])


def silhouette_of(signal: Signal, width_px: float) -> Silhouette:
    """Find the pieces of a tube of a given width."""
    height, width = signal.image.shape[:2]
    pixel = max(width_px / _SHRUNK_PX, 1.0)
    size = max(round(width / pixel), 1), max(round(height / pixel), 1)
    rows, columns = _around(signal, size)
    mask = (np.nan_to_num(signal.picture(size, rows, columns)) > TUBE).astype(np.uint8)
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _CLOSING), np.uint8)
    # What fills the picture ends at its border.
    mask[[0, -1]] = mask[:, [0, -1]] = 0
    line = cv2.ximgproc.thinning(255 * mask) > 0
    across = 2 * cv2.distanceTransform(mask, cv2.DIST_L2, 5) * pixel / width_px
    clean = line & (across > _ONE_TUBE[0]) & (across < _ONE_TUBE[1])
    clean &= cv2.dilate(_forks(line).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    if np.count_nonzero(clean) > _LINE_MOST:
        clean[:] = False
    scale = np.array([width, height]) / size
    corner = np.array([columns.start, rows.start]) * scale
    pieces = []
    cut, fewest = int(_CUT * width_px / pixel), max(int(_SHORTEST * width_px / pixel), 3)
    for way in _lines(clean):
        for steady in _steady(across[way[:, 1], way[:, 0]], pixel / width_px):
            inner = way[steady][cut : steady.stop - steady.start - cut]
            if len(inner) >= fewest:
                half = across[inner[:, 1], inner[:, 0]] * width_px / 2
                pieces.append(Piece(_smooth(corner + (inner + 0.5) * scale - 0.5), half))
    pieces.sort(key=lambda piece: -len(piece.half_px))
    return Silhouette(mask > 0, corner, scale, tuple(pieces[:_PIECES_MOST]))


def _around(signal: Signal, size: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of the shrunk picture, shrunk to a size (W, H), beyond which nothing looks like tube."""
    small = max(size[0] // _COARSER, 1), max(size[1] // _COARSER, 1)
    seen = np.nan_to_num(signal.picture(small)) > _FAINT

    def extent(axis: int, full: int) -> slice:
        line = np.asarray(seen.any(axis))
        found = np.flatnonzero(line)
        if not len(found):
            return slice(0, full)
        step = full / len(line)
        return slice(max(int((found[0] - 1) * step), 0), min(int((found[-1] + 2) * step) + 1, full))

    return extent(1, size[1]), extent(0, size[0])


def _steady(across: Array, step: float) -> list[slice]:
    """Stretches of a line on which its width (N,), sampled every `step` widths, changes slowly."""
    reach = max(round(0.5 / step), 1)
    padded = np.pad(across, reach, mode="edge")
    slow = np.abs(padded[2 * reach :] - padded[: -2 * reach]) < _STEADY * 2 * reach * step
    edges = np.flatnonzero(np.diff(np.concatenate([[False], slow, [False]]).astype(int)))
    return [slice(first, last) for first, last in edges.reshape(-1, 2)]


def _forks(line: Mask) -> Mask:
    """Where a line of pixels branches: going round such a pixel, one comes to it three times or more."""
    padded = np.pad(line, 1)
    height, width = line.shape
    around = [padded[1 + row : 1 + row + height, 1 + column : 1 + column + width] for row, column in _ROUND]
    entries = sum((~one & other).astype(np.uint8) for one, other in zip(around, (*around[1:], around[0]), strict=True))
    return line & (entries > 2)


def _lines(pixels: Mask) -> Iterator[Array]:
    """Pixels (N, 2) of each line, in order."""
    _, labels = cv2.connectedComponents(pixels.astype(np.uint8), connectivity=8)
    rows, columns = np.nonzero(pixels)
    own = labels[rows, columns]
    order = np.argsort(own, kind="stable")
    places = np.stack([columns, rows], 1)[order]
    for group in np.split(places, np.flatnonzero(np.diff(own[order])) + 1):
        left = {(x, y) for x, y in group.tolist()}
        while left:
            yield _line_in(left)


def _line_in(left: set[tuple[int, int]]) -> Array:
    """Take a line out of a set of pixels, from one of its ends to where it stops: (N, 2)."""

    def beside(x: int, y: int) -> list[tuple[int, int]]:
        # Straight neighbours first: the line does not cut its own corners.
        around = sorted(_ROUND, key=lambda off: abs(off[0]) + abs(off[1]))
        return [(x + column, y + row) for row, column in around if (x + column, y + row) in left]

    here = min(left, key=lambda place: len(beside(*place)))
    way = [here]
    left.discard(here)
    while ahead := beside(*here):
        here = ahead[0]
        left.discard(here)
        way.append(here)
    return np.array(way)


def _smooth(points: Array) -> Array:
    """Average points (N, 2) over seven neighbours; ends stay."""
    n = min(3, (len(points) - 1) // 2)
    padded = np.concatenate([2 * points[0] - points[n:0:-1], points, 2 * points[-1] - points[-2 : -n - 2 : -1]])
    return np.stack([np.convolve(padded[:, k], np.full(2 * n + 1, 1 / (2 * n + 1)), "valid") for k in (0, 1)], 1)
