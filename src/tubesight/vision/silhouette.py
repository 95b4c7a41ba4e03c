"""Choosing the segmenter from the picture: which colours are tube and which are background."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tubesight.core import Array, Image, Status, Unmeasurable
from tubesight.vision.edges import left_of
from tubesight.vision.signal import LINEAR_LIGHT, Signal, planes, sample

# Where the colours are learned, in widths of the tube: along its first piece, inside and beside it.
ALONG_WIDTHS, ALONG_COUNT = (0.4, 2.2), 9
INSIDE_WIDTHS, INSIDE_COUNT = 0.25, 3
BESIDE_WIDTHS, BESIDE_COUNT = (0.85, 1.9), 4
# Fewest samples a colour is learned from.
SAMPLES_MIN = 12
# Contrast in linear light under which tube and background cannot be told apart above a picture's noise.
CONTRAST_MIN = 0.012
# Chromatic share of the contrast above which it is called a difference of colour.
COLOUR_SHARE = 0.25
# What is said of a segmenter.
REASONS = (
    "background picture: there is one of this camera",
    "cloth colour: tube and surroundings differ in colour beside the base",
    "contrast: bright tube on darker surroundings beside the base",
    "contrast: dark tube on brighter surroundings beside the base",
)
# The gain is the median of so many ratios in each direction, of pixels that are neither dark nor saturated.
GAIN_GRID, GAIN_MIN_COUNT, LIT = 24, 50, (0.02, 0.95)


def choose(image: Image, background: Image | None, start_px: Array, way: Array, width_px: float) -> Signal:
    """Learn the colours where the tube has to be and choose the segmenter.

    A background picture is used where there is one; otherwise the tube's and the cloth's colours beside the base, by
    colour or by contrast of either sign.

    Parameters
    ----------
    image, background
        The picture, and the same scene without the tube or None.
    start_px, way
        (2,) base of the tube and its unit way there.
    width_px
        Width of the tube there.

    Raises
    ------
    Unmeasurable
        If nothing stands out there.
    """
    colours = learn(image, background, start_px, way, width_px)
    return signal_of(image, background, colours)


def signal_of(image: Image, background: Image | None, colours: tuple[Array, Array, Array, float]) -> Signal:
    """Choose the segmenter from colours that were learned (`learn`)."""
    tube, cloth, gain, difference = colours
    if not (np.isfinite(tube).all() and np.isfinite(cloth).all()):
        raise Unmeasurable(Status.BASE_HIDDEN, detail="the first piece of the tube is not in the picture")
    if background is not None:
        if not difference >= CONTRAST_MIN:
            raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="the picture equals its background at the base")
        return Signal(image, tube, cloth, background, gain, REASONS[0])
    if max(abs(a - b) for a, b in zip(tube.tolist(), cloth.tolist(), strict=True)) < CONTRAST_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no contrast at the base")
    return Signal(image, tube, cloth, None, gain, REASONS[reason(tube.tolist(), cloth.tolist())])


def learn(
    image: Image, background: Image | None, start_px: Array, way: Array, width_px: float
) -> tuple[Array, Array, Array, float]:
    """Learn the colours of the tube and of its surroundings where it starts.

    Returns
    -------
    tube, cloth, gain, difference
        (C,) colours in linear light, NaN where too little of the place is in the picture; (C,) brightness of the
        picture over that of the background picture (1 without one); and how much they differ inside of the tube.
    """
    image = planes(image)
    s = np.linspace(*ALONG_WIDTHS, ALONG_COUNT) * width_px
    line = (start_px + s[:, None] * way)[:, None, :]
    left = left_of(way) * width_px
    inside = line + np.linspace(-INSIDE_WIDTHS, INSIDE_WIDTHS, INSIDE_COUNT)[:, None] * left
    side = np.linspace(*BESIDE_WIDTHS, BESIDE_COUNT)[:, None] * left
    now = sample(image, inside)
    tube = _middle_colour(now)
    cloth = _middle_colour(sample(image, np.concatenate([line + side, line - side], 1)))
    if background is None:
        return tube, cloth, np.ones_like(tube), float("nan")
    gain = _gain(image, planes(background))
    off = np.abs(now - sample(background, inside) * gain).max(-1)
    off = off[np.isfinite(off)]
    return tube, cloth, gain, float(np.median(off)) if len(off) else float("nan")


def _middle_colour(samples: Array) -> Array:
    flat = samples.reshape(-1, samples.shape[-1])
    flat = flat[np.isfinite(flat).all(1)]
    return np.median(flat, axis=0) if len(flat) >= SAMPLES_MIN else np.full(samples.shape[-1], np.nan)


def reason(tube: Sequence[float] | Array, cloth: Sequence[float] | Array) -> int:
    """Which of the `REASONS` two colours of one or three numbers give."""
    one, other, chroma = 0.0, 0.0, 0.0
    for c in range(len(tube)):
        one += tube[c] / len(tube)
        other += cloth[c] / len(tube)
    for c in range(len(tube)):
        chroma = max(chroma, abs(tube[c] / (one + 1e-3) - cloth[c] / (other + 1e-3)))
    if len(tube) == 3 and chroma > COLOUR_SHARE:
        return 1
    return 2 if one > other else 3


def _gain(image: Image, background: Image) -> Array:
    """Brightness (C,) of a picture over that of the background picture: median ratio over a coarse grid."""
    if image.shape != background.shape:
        raise ValueError(f"background picture: expected shape {image.shape}, got {background.shape}")
    rows, columns = ((2 * np.arange(GAIN_GRID) + 1) * n // (2 * GAIN_GRID) for n in image.shape[:2])
    now, empty = LINEAR_LIGHT[image[np.ix_(rows, columns)]], LINEAR_LIGHT[background[np.ix_(rows, columns)]]
    gain = np.ones(image.shape[2])
    for c in range(image.shape[2]):
        lit = (empty[..., c] > LIT[0]) & (empty[..., c] < LIT[1])
        if lit.sum() > GAIN_MIN_COUNT:
            gain[c] = np.median(now[..., c][lit] / empty[..., c][lit])
    return gain
