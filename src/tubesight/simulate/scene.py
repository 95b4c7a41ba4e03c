"""What a simulated photograph looks like apart from its geometry, and how light becomes gray levels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tubesight.core import Array

Colour = tuple[float, float, float]
_Real = TypeVar("_Real", np.float32, np.float64)

# sRGB (IEC 61966-2-1): the linear part below this light, and the exponent and offset of the rest.
_SRGB_KNEE, _SRGB_SLOPE, _SRGB_OFFSET, _SRGB_EXPONENT = 0.0031308, 12.92, 0.055, 2.4

# A lamp 100 mm wide at 700 mm reaches 4 degrees past the limb, the light walls of a room much further.
_WRAP = 0.2


@dataclass(frozen=True, slots=True)
class Scene:
    """Light, colours and optics of a simulated photograph.

    Attributes
    ----------
    tube_bgr, cloth_bgr
        8-bit sRGB colours (blue, green, red) in full light.
    specular
        Strength of the highlight: 0 matt, 0.3 plastic, 1 and above metal.
    light
        Direction towards the lamp in the base frame; normalised here.
    ambient
        Share of the light that reaches surfaces turned away from the lamp.
    holder_diameter_mm
        Diameter of the cylinder of cloth colour that the tube hangs from; 0 for none (the base is then a flat cut).
    shadow
        Darkness of the tube's soft shadow on the wall behind it, 0 to 1.
    texture, gradient, vignetting
        Relative amplitude of the cloth's grain, of the fall of light across the picture, of the corners' darkness.
    clutter
        Number of coloured shapes behind the tube instead of the plain cloth.
    bands_mm
        (start, end) by arc length of each band painted on the tube; one that reaches the end covers the tip.
    band_bgr
        Colour of the bands.
    grid_mm
        Spacing of a grid of dark lines on the wall behind the tube; 0 for none.
    blur_px
        Standard deviation of the Gaussian blur of the optics, in linear light.
    noise_levels
        Standard deviation of the sensor noise, 8-bit gray levels.
    seed
        Changes grain, clutter and noise.
    """

    tube_bgr: Colour = (225.0, 228.0, 230.0)
    cloth_bgr: Colour = (160.0, 70.0, 32.0)
    specular: float = 0.05
    light: tuple[float, float, float] = (0.5, 0.7, -0.55)
    ambient: float = 0.25
    holder_diameter_mm: float = 40.0
    shadow: float = 0.4
    texture: float = 0.05
    gradient: float = 0.25
    vignetting: float = 0.08
    clutter: int = 0
    bands_mm: tuple[tuple[float, float], ...] = ()
    band_bgr: Colour = (45.0, 40.0, 200.0)
    grid_mm: float = 0.0
    blur_px: float = 0.6
    noise_levels: float = 1.5
    seed: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.light).all() and np.linalg.norm(self.light) > 0):
            raise ValueError(f"light: expected a direction, got {self.light}")
        for name in ("blur_px", "noise_levels", "holder_diameter_mm", "clutter", "specular", "grid_mm"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: expected zero or more, got {getattr(self, name)}")
        if not all(start < end for start, end in self.bands_mm):
            raise ValueError(f"bands_mm: expected pairs (start, end) with start < end, got {self.bands_mm}")

    @property
    def light_direction(self) -> Array:
        """Unit vector (3,) towards the lamp, base frame."""
        return np.asarray(np.array(self.light) / np.linalg.norm(self.light))

    def random(self, *what: object) -> np.random.Generator:
        """Return the random generator of one thing in the picture: equal for equal names and seed, on every machine."""
        return np.random.default_rng(crc32("/".join(map(str, (self.seed, *what))).encode()))


def light_from_srgb(levels: ArrayLike) -> Array:
    """Turn sRGB gray levels (0 to 255) into linear light (0 to 1)."""
    e = np.asarray(levels, float) / 255
    low = e <= _SRGB_KNEE * _SRGB_SLOPE
    return np.where(low, e / _SRGB_SLOPE, ((np.maximum(e, 0) + _SRGB_OFFSET) / (1 + _SRGB_OFFSET)) ** _SRGB_EXPONENT)


def srgb_from_light(light: NDArray[_Real]) -> NDArray[_Real]:
    """Turn linear light (0 to 1, brighter is cut) into sRGB gray levels (0 to 255), in the precision given."""
    v = np.clip(light, 0, 1)
    curved = (1 + _SRGB_OFFSET) * v ** (1 / _SRGB_EXPONENT) - _SRGB_OFFSET
    return np.asarray(255 * np.where(v <= _SRGB_KNEE, _SRGB_SLOPE * v, curved), light.dtype)


def lambert(scene: Scene, albedo: ArrayLike, cosine: Array, specular_cosine: Array | None = None) -> Array:
    """Light (..., 3) that a surface sends to the camera.

    Parameters
    ----------
    albedo
        (3,) linear colour.
    cosine
        (...) cosine between normal and lamp, times the lamp's visibility.
    specular_cosine
        (...) cosine between normal and the half vector (Blinn 1977); none for a matt surface.
    """
    # A lamp of finite size lights a little round the limb: the cosine is let down to zero at -_WRAP.
    diffuse = np.maximum(cosine + _WRAP, 0) / (1 + _WRAP)
    light = np.asarray(albedo) * (scene.ambient + (1 - scene.ambient) * diffuse)[..., None]
    if specular_cosine is not None and scene.specular:
        # Exponent 40: a highlight about 10 degrees wide, as on polished plastic and drawn metal.
        light = light + (scene.specular * np.maximum(specular_cosine, 0) ** 40 * (cosine > 0))[..., None]
    return np.asarray(light)
