"""Which way a tube leaves a place that is marked on it."""

from __future__ import annotations

import numpy as np

from tubesight.core import Array, Image
from tubesight.vision.edges import left_of
from tubesight.vision.see import Start
from tubesight.vision.signal import sample

# Ways tried: a first piece of two widths is within a quarter of a width of one of them.
_WAYS = 72
# Where colours are compared, in widths: along the first piece, inside of it and to both sides.
_ALONG, _INSIDE, _BESIDE = (0.4, 2.2), 0.3, (0.7, 1.2)
# Light that counts as dark when colours are compared.
_DARK = 0.02
# Ways whose contrast is below this share of the best one's are not tubes; a mark in the middle of one has two ways.
_SHARE, _MOST = 0.4, 3


def starts_at(image: Image, px: Array, width_px: float) -> list[Start]:
    """Ways in which a tube of a known width may leave a place, the clearest first.

    Parameters
    ----------
    px
        (2,) the place, on the tube.
    width_px
        Width of the tube there.

    Returns
    -------
    list
        At most three; empty where nothing stands out.
    """
    angle = np.arange(_WAYS) * (2 * np.pi / _WAYS)
    ways = np.stack([np.cos(angle), np.sin(angle)], -1)
    contrast = np.array([_contrast(image, px, way, width_px) for way in ways])
    highest = (contrast >= np.roll(contrast, 1)) & (contrast > np.roll(contrast, -1))
    peaks = np.flatnonzero(highest & (contrast > _SHARE * contrast.max()) & (contrast > 0))
    return [Start(px, ways[k], width_px) for k in peaks[np.argsort(-contrast[peaks])][:_MOST]]


def _contrast(image: Image, px: Array, way: Array, width_px: float) -> float:
    """Relative difference of the colours inside a first piece and on the more similar side of it; 0 at the border."""
    line = px + np.linspace(*_ALONG, 12)[:, None] * width_px * way

    def colour(low: float, high: float) -> Array:
        offsets = np.linspace(low, high, 5)[:, None] * width_px * left_of(way)
        samples = sample(image, line[:, None] + offsets)
        return np.asarray(np.median(samples.reshape(-1, samples.shape[-1]), axis=0))

    tube = colour(-_INSIDE, _INSIDE)
    sides = [colour(sign * _BESIDE[0], sign * _BESIDE[1]) for sign in (1, -1)]
    off = [float(np.abs(tube - side).max() / (tube.max() + side.max() + _DARK)) for side in sides]
    return float(np.nan_to_num(min(off)))
