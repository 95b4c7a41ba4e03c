"""Something opaque before the tube: a textured sheet that hides a part of it in one picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from tubesight.core import Array, FramePair, Tube
from tubesight.geometry.rig import Rig
from tubesight.simulate.backdrop import grain
from tubesight.simulate.phantom import Phantom
from tubesight.simulate.scene import Colour, Scene, light_from_srgb, srgb_from_light

# A sheet reaches this far to both sides of the tube, diameters of it.
_REACH = 6.0
# Corners are drawn to this part of a pixel (bits): nothing is measured on the sheet's edges.
_SHIFT = 4
# Step along the tube by which its way in the picture is told (share of its length).
_STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Cover:
    """A sheet before the tube in one picture.

    Attributes
    ----------
    camera
        Name of the camera that it stands before.
    start, end
        Shares of the tube's length between which it hides it.
    colour_bgr
        8-bit sRGB colour.
    slant_rad
        By how much its two edges are turned from lying across the tube.
    texture
        Relative amplitude of its grain.
    """

    camera: str
    start: float
    end: float
    colour_bgr: Colour = (70.0, 110.0, 60.0)
    slant_rad: float = 0.0
    texture: float = 0.15

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.end <= 1:
            raise ValueError(f"start, end: expected 0 <= start < end <= 1, got {self.start}, {self.end}")
        if not abs(self.slant_rad) < np.pi / 2:
            raise ValueError(f"slant_rad: expected less than a right angle, got {self.slant_rad}")


def cover(
    pair: FramePair, rig: Rig, phantom: Phantom, tube: Tube, sheet: Cover, scene: Scene | None = None
) -> FramePair:
    """Hide a part of the tube in one picture of a pair (`render_pair`).

    Raises
    ------
    ValueError
        If the tube has no diameter.
    """
    if tube.diameter_mm is None:
        raise ValueError("a simulated tube needs its diameter_mm")
    look = scene or Scene()
    image = pair.images[sheet.camera]
    one, other = (_edge(rig, phantom, tube.diameter_mm, sheet, share) for share in (sheet.start, sheet.end))
    corners = np.rint(np.concatenate([one, other[::-1]]) * 2**_SHIFT).astype(np.int32)
    alpha = np.zeros(image.shape[:2], np.uint8)
    cv2.fillPoly(alpha, [corners], 255, cv2.LINE_AA, _SHIFT)
    soft = alpha.astype(np.float32) / 255
    if look.blur_px:
        cv2.GaussianBlur(soft, (0, 0), look.blur_px, dst=soft)
    rng = look.random("cover", pair.name, sheet.camera, sheet.start, sheet.end)
    light = light_from_srgb(sheet.colour_bgr) * (1 + sheet.texture * grain(image.shape[:2], rng))[..., None]
    share = soft[..., None]
    mixed = srgb_from_light(light_from_srgb(image) * (1 - share) + light * share)
    mixed += share * look.noise_levels * rng.standard_normal(image.shape, dtype=np.float32)
    images = {**pair.images, sheet.camera: np.clip(np.rint(mixed), 0, 255).astype(np.uint8)}
    return FramePair(images, name=pair.name)


def _edge(rig: Rig, phantom: Phantom, diameter_mm: float, sheet: Cover, share: float) -> Array:
    """Two ends (2, 2) of an edge of the sheet across the tube at a share of its length, pixels."""
    length = phantom.length_mm
    near = np.clip(share + np.array([-_STEP, _STEP]), 0, 1) * length
    before, behind, here = rig.project(sheet.camera, phantom.at(np.append(near, share * length)))
    way = (behind - before) / np.linalg.norm(behind - before)
    across = np.array([way[1], -way[0]])
    slanted = np.cos(sheet.slant_rad) * across + np.sin(sheet.slant_rad) * way
    depth = rig.camera_from_base[sheet.camera].apply(phantom.at(share * length))[2]
    reach = _REACH * diameter_mm * rig.cameras[sheet.camera].focal_px / depth
    return np.stack([here + reach * slanted, here - reach * slanted])
