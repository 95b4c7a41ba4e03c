"""Finding a tube anywhere in a picture, where no clamp says where it starts."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tubesight.core import Array, Image, Mask, Status, Unmeasurable

# The search works on a picture of about this width: a tube 8 px wide in a 1080p picture is still 3 px there.
_WIDTH_PX = 720
# Surroundings are the median over a window of this share of the picture's width: wider than twice any tube it should
# find.
_WINDOW = 0.09
# A tube is at least this many times longer than wide.
_ELONGATION_MIN = 4.0
_AREA_MIN_PX = 60


@dataclass(frozen=True, slots=True, eq=False)
class Seed:
    """A place on the middle of a tube: pixel (2,), unit way (2,) up to its sign, width in pixels."""

    px: Array
    way: Array
    width_px: float


def find_seed(image: Image, background: Image | None, near_px: Array | None = None) -> Seed:
    """Find the most tube-like region and a place in its middle.

    What differs from the background picture, or else from the median of its surroundings, by colour or brightness of
    either sign, is foreground; the longest slender connected region of it is the tube.

    Parameters
    ----------
    near_px
        (2,) a place that the region has to lie at, or None.

    Raises
    ------
    Unmeasurable
        If nothing slender stands out.
    """
    factor = max(image.shape[1] / _WIDTH_PX, 1.0)
    small = _shrink(image, factor)
    difference = _difference(small, None if background is None else _shrink(background, factor))
    best: tuple[float, Mask, float] | None = None
    for level in _levels(difference):
        count, labels, stats, _ = cv2.connectedComponentsWithStats(
            (difference > level).astype(np.uint8), connectivity=8
        )
        for label in range(1, count):
            if stats[label, cv2.CC_STAT_AREA] < _AREA_MIN_PX:
                continue
            mask = labels == label
            if near_px is not None and not _is_near(mask, near_px / factor):
                continue
            width, length = _slenderness(mask)
            if length < _ELONGATION_MIN * width:
                continue
            score = length * float(np.sqrt(difference[mask].mean()))
            if best is None or score > best[0]:
                best = (score, mask, width)
    if best is None:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="nothing slender stands out in the picture")
    seed, way = _middle(best[1], best[2])
    return Seed(seed * factor + (factor - 1) / 2, way, best[2] * factor)


def _shrink(image: Image, factor: float) -> Image:
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _difference(image: Image, background: Image | None) -> Array:
    """Largest difference over the channels, smoothed."""
    behind = background
    if behind is None:
        window = int(_WINDOW * image.shape[1]) | 1
        behind = np.asarray(cv2.medianBlur(image, min(window, 255)), dtype=np.uint8)
    difference = np.abs(image.astype(float) - behind.astype(float))
    if difference.ndim == 3:
        difference = difference.max(-1)
    return np.asarray(cv2.GaussianBlur(difference, (0, 0), 0.8))


def _levels(difference: Array) -> list[float]:
    """Thresholds to try: above the noise, up to half of the strongest difference."""
    noise = 6 * float(np.median(difference)) + 6.0
    top = float(np.percentile(difference, 99.7))
    return [float(level) for level in np.geomspace(noise, max(noise, 0.6 * top), 4)]


def _is_near(mask: Mask, px: Array) -> bool:
    rows, columns = np.nonzero(mask)
    return bool(np.hypot(columns - px[0], rows - px[1]).min() < 6)


def _slenderness(mask: Mask) -> tuple[float, float]:
    """Width (twice the median ridge of the distance transform) and length (area over width) of a region."""
    ridge, depth = _ridge(mask)
    width = 2 * float(np.median(depth[ridge])) if ridge.any() else 1e9
    return width, float(mask.sum()) / max(width, 1.0)


def _ridge(mask: Mask) -> tuple[Mask, Array]:
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    highest = cv2.dilate(depth, np.ones((3, 3), np.uint8))
    return np.asarray((depth >= highest - 1e-6) & (depth > 0.9)), np.asarray(depth, dtype=float)


def _middle(mask: Mask, width: float) -> tuple[Array, Array]:
    """Place on the ridge that looks most like a tube of that width near the region's middle, and the way there."""
    ridge, depth = _ridge(mask)
    rows, columns = np.nonzero(ridge & (np.abs(2 * depth - width) < 0.25 * width + 1))
    points = np.stack([columns, rows], 1).astype(float)
    order = np.argsort(_geodesic(mask, points[0])[rows, columns])
    seed = points[order[len(order) // 2]]
    near = points[np.linalg.norm(points - seed, axis=1) < 2.5 * width + 3]
    _, _, axes = np.linalg.svd(near - near.mean(0), full_matrices=False)
    return near.mean(0), axes[0]


def _geodesic(mask: Mask, start: Array) -> Array:
    """Count steps within the region from the end farthest from `start` (two sweeps of breadth-first search)."""
    distance = _flood(mask, (int(start[1]), int(start[0])))
    far = np.unravel_index(int(np.where(np.isfinite(distance), distance, -1).argmax()), distance.shape)
    return _flood(mask, (int(far[0]), int(far[1])))


def _flood(mask: Mask, start: tuple[int, int]) -> Array:
    distance = np.full(mask.shape, np.inf)
    front = np.zeros(mask.shape, np.uint8)
    front[start] = 1
    allowed, seen, step = mask.astype(np.uint8), front.copy(), 0
    distance[start] = 0
    kernel = np.ones((3, 3), np.uint8)
    while front.any():
        step += 1
        front = np.asarray(cv2.dilate(front, kernel), dtype=np.uint8) & allowed & (1 - seen)
        seen |= front
        distance[front > 0] = step
    return distance
