"""Small pictures of tubes drawn from a formula, for tests of the stages of seeing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]


def drawn_tube(
    size: tuple[int, int] = (150, 210),
    width: float = 16.0,
    bend: float = 0.0015,
    tube: tuple[float, ...] = (0.7, 0.75, 0.8),
    cloth: tuple[float, ...] = (0.35, 0.1, 0.05),
    ball: float = 1.4,
    start: float = 18.0,
    length: float = 95.0,
    noise: float = 0.01,
    seed: int = 0,
    steep: float = 2.2,
) -> Picture:
    """Draw a tube (H, W, C) that hangs from the middle of the upper part and bends to the right, with a ball."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    s = np.clip(y - start, 0, length)
    middle = size[1] / 2 + bend * s**2
    across = np.abs(x - middle) / np.hypot(1, 2 * bend * s)
    inside = np.minimum(width / 2 - across, np.minimum(y - start, start + length - y))
    end = np.hypot(x - (size[1] / 2 + bend * length**2), y - (start + length))
    field = np.maximum(inside, ball * width / 2 - end)
    share = 1 / (1 + np.exp(-steep * field))[..., None]
    shade = 1 - 0.25 * np.clip(x - middle, -width, width)[..., None] / width
    light = share * np.array(tube) * shade + (1 - share) * np.array(cloth)
    light = np.clip(light + noise * rng.standard_normal(light.shape), 0, 1)
    return np.asarray(np.round(255 * light ** (1 / 2.2)), np.uint8)
