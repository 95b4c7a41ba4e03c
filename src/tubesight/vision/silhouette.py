"""Choosing the segmenter from the picture: which colours are tube and which are background."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Image, Status, Unmeasurable
from tubesight.vision.edges import left_of
from tubesight.vision.signal import Signal, sample

# Where the colours are learned, in widths of the tube: along its first piece, inside and beside it.
_ALONG_WIDTHS = (0.4, 2.2)
_INSIDE_WIDTHS, _BESIDE_WIDTHS = 0.25, (0.85, 1.9)
# Contrast in linear light under which tube and background cannot be told apart above a picture's noise.
_CONTRAST_MIN = 0.012
# Chromatic share of the contrast above which it is called a difference of colour.
_COLOUR_SHARE = 0.25
_GAIN_STRIDE = 16


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
    s = np.linspace(*_ALONG_WIDTHS, 25) * width_px
    left = left_of(way)
    line = start_px + s[:, None] * way

    def band(low: float, high: float) -> Array:
        offsets = np.linspace(low, high, 9) * width_px
        return line[:, None, :] + offsets[:, None] * left

    beside = np.concatenate([band(*_BESIDE_WIDTHS), band(-_BESIDE_WIDTHS[1], -_BESIDE_WIDTHS[0])], 1)
    inside = band(-_INSIDE_WIDTHS, _INSIDE_WIDTHS)
    tube = _middle_colour(sample(image, inside))
    cloth = _middle_colour(sample(image, beside))
    if not (np.isfinite(tube).all() and np.isfinite(cloth).all()):
        raise Unmeasurable(Status.BASE_HIDDEN, detail="the first piece of the tube is not in the picture")
    if background is not None:
        gain = _gain(image, background)
        empty = sample(background, inside) * gain
        if float(np.nanmedian(np.abs(sample(image, inside) - empty).max(-1))) < _CONTRAST_MIN:
            raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="the picture equals its background at the base")
        return Signal(image, tube, cloth, background, gain, "background picture: there is one of this camera")
    contrast = tube - cloth
    if float(np.abs(contrast).max()) < _CONTRAST_MIN:
        raise Unmeasurable(Status.TUBE_NOT_FOUND, detail="no contrast at the base")
    return Signal(image, tube, cloth, None, np.ones_like(tube), _reason(tube, cloth))


def _middle_colour(samples: Array) -> Array:
    flat = samples.reshape(-1, samples.shape[-1])
    flat = flat[np.isfinite(flat).all(1)]
    return np.median(flat, axis=0) if len(flat) >= 20 else np.full(samples.shape[-1], np.nan)


def _reason(tube: Array, cloth: Array) -> str:
    if len(tube) == 3:
        level = np.array([tube.mean(), cloth.mean()]) + 1e-3
        chroma = np.abs(tube / level[0] - cloth / level[1]).max()
        if chroma > _COLOUR_SHARE:
            return "cloth colour: tube and surroundings differ in colour beside the base"
    side = "bright tube on darker" if tube.mean() > cloth.mean() else "dark tube on brighter"
    return f"contrast: {side} surroundings beside the base"


def _gain(image: Image, background: Image) -> Array:
    """Brightness (C,) of a picture over that of the background picture: median ratio over a coarse grid."""
    if image.shape != background.shape:
        raise ValueError(f"background picture: expected shape {image.shape}, got {background.shape}")
    height, width = image.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(0, width, _GAIN_STRIDE), np.arange(0, height, _GAIN_STRIDE)), -1).astype(
        float
    )
    now, empty = sample(image, grid), sample(background, grid)
    lit = (empty > 0.02) & (empty < 0.95)
    return np.array(
        [
            float(np.median((now / np.maximum(empty, 1e-6))[..., c][lit[..., c]])) if lit[..., c].sum() > 50 else 1.0
            for c in range(now.shape[-1])
        ]
    )
