"""Photographs with one thing wrong, and what the methods make of them: the task of the study `sensitivity`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tubesight.apps.reproduce.mockup import LENGTH_MM, TUBE, phantom_of, through_jpeg
from tubesight.apps.reproduce.session import PlainRig
from tubesight.apps.reproduce.shots import METHODS, Row, errors
from tubesight.core import Array, FramePair, Image
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Phantom, Placed, Scene, render, rig_around
from tubesight.simulate.scene import Colour, light_from_srgb, srgb_from_light

# Instants that make up a blurred picture, and a picture read row by row: between two of them the tip moves by at most
# 1 px in all cases.
_BLUR_STEPS, _ROW_STEPS = 13, 9


@dataclass(frozen=True, slots=True)
class Look:
    """How a photograph comes about; as it is, nothing is wrong.

    Attributes
    ----------
    size_px
        Of the cameras; their field of view stays.
    blur_px, noise_levels
        Standard deviations of the optics' blur and of the sensor's noise.
    exposure
        Factor on the light.
    clamp_shift_mm, clamp_tilt_deg
        How far the clamp is from where the base frame has it.
    tip_speed_mm_s
        Of the tip, while the tube bends further.
    delay_s
        How much later the second camera takes its picture.
    open_s
        How long the shutter is open, the same time before and after the instant of the truth.
    readout_s
        From the first to the last row of the picture; the middle row is read at the instant of the truth.
    """

    size_px: tuple[int, int] = (1920, 1080)
    blur_px: float = 0.6
    noise_levels: float = 1.5
    exposure: float = 1.0
    clamp_shift_mm: float = 0.0
    clamp_tilt_deg: float = 0.0
    tip_speed_mm_s: float = 0.0
    delay_s: float = 0.0
    open_s: float = 0.0
    readout_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Told:
    """What the methods are told.

    Attributes
    ----------
    rig
        To measure with; the true one when None.
    diameter_error_mm
        What the stated diameter of the tube is too large.
    """

    rig: PlainRig | None = None
    diameter_error_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class Disturbed:
    """A disturbed photograph of a tube; the task of `measured_disturbed`.

    Attributes
    ----------
    seed
        Of the scene's grain and noise.
    told
        The photograph is taken once and measured with each: half of a measurement's time is its photograph.
    """

    look: Look
    bending_deg: float
    ratio: float
    orientation_deg: float
    seed: int
    told: tuple[Told, ...] = (Told(),)


def measured_disturbed(shot: Disturbed) -> list[list[Row]]:
    """Photograph and measure, for all that is told, by every method: `tubesight.apps.reproduce.shots.errors`."""
    rig = rig_around(size_px=shot.look.size_px)
    images = {}
    for index, name in enumerate(rig.names):
        camera, pose = rig.cameras[name], rig.camera_from_base[name]
        scene = _scene(shot)

        def take(time_s: float) -> Image:
            return render(camera, pose, _phantom(shot, time_s), TUBE, scene, name)  # noqa: B023

        images[name] = _exposed(take, shot.look, index * shot.look.delay_s)
    pair = through_jpeg(FramePair(images))
    true = _phantom(shot, 0.0)
    return [_by_each_method(pair, rig if told.rig is None else told.rig.rig(), told, true) for told in shot.told]


def _by_each_method(pair: FramePair, rig: Rig, told: Told, true: Phantom) -> list[Row]:
    tube = replace(TUBE, diameter_mm=(TUBE.diameter_mm or 0.0) + told.diameter_error_mm)
    return [{"method": method} | errors(ShapeSensor(rig, tube, method)(pair), true) for method in METHODS]


def _phantom(shot: Disturbed, time_s: float) -> Phantom:
    """Where the tube is at an instant: it bends on, so that the tip has its speed, and sits in a displaced clamp."""
    # The tip of an arc that bends by d(theta) moves by half its length times d(theta), at small angles.
    turned = 2 * shot.look.tip_speed_mm_s * time_s / LENGTH_MM
    phantom = phantom_of(shot.bending_deg + float(np.degrees(turned)), shot.orientation_deg, shot.ratio)
    shift, tilt = shot.look.clamp_shift_mm, np.radians(shot.look.clamp_tilt_deg)
    if not shift and not tilt:
        return phantom
    # Towards both cameras alike.
    direction = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    return Placed(phantom, Pose.from_rotvec(tilt * direction, shift * direction))


def _scene(shot: Disturbed) -> Scene:
    look, plain = shot.look, Scene()
    tube, cloth = _brighter(plain.tube_bgr, look.exposure), _brighter(plain.cloth_bgr, look.exposure)
    return Scene(tube_bgr=tube, cloth_bgr=cloth, blur_px=look.blur_px, noise_levels=look.noise_levels, seed=shot.seed)


def _brighter(colour: Colour, factor: float) -> Colour:
    """Colour (sRGB levels) in light changed by a factor; levels above 255 are cut where the picture is made."""
    if factor == 1.0:
        return colour
    light = factor * light_from_srgb(colour)
    blue, green, red = (float(255 * (1.055 * x ** (1 / 2.4) - 0.055)) for x in light)
    return blue, green, red


def _exposed(take: Callable[[float], Image], look: Look, start_s: float) -> Image:
    """Picture that a shutter and a sensor of a given speed make of pictures of instants."""
    if look.open_s:
        times = start_s + look.open_s * ((np.arange(_BLUR_STEPS) + 0.5) / _BLUR_STEPS - 0.5)
        return _mean([take(float(t)) for t in times])
    if look.readout_s:
        shares = (np.arange(_ROW_STEPS) + 0.5) / _ROW_STEPS
        pictures = np.stack([take(start_s + look.readout_s * (float(share) - 0.5)) for share in shares])
        rows = np.arange(pictures.shape[1])
        return np.ascontiguousarray(pictures[rows * _ROW_STEPS // len(rows), rows])
    return take(start_s)


def _mean(pictures: list[Image]) -> Image:
    """Mean in linear light."""
    to_light = light_from_srgb(np.arange(256)).astype(np.float32)
    total: Array = np.zeros(pictures[0].shape)
    for picture in pictures:
        total += cv2.LUT(picture, to_light)
    return np.rint(srgb_from_light(total / len(pictures))).astype(np.uint8)
