"""Photographs of a phantom: geometry, light, optics and sensor together."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.special import ndtri

from tubesight.core import Array, FramePair, Image, Tube
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate.backdrop import (
    Backdrop,
    Clamp,
    Plane,
    backdrop,
    cast_shadow,
    holder_covers,
    holder_shadow,
    shade,
    vignette,
)
from tubesight.simulate.bands import paint_of
from tubesight.simulate.phantom import Phantom
from tubesight.simulate.rays import Window, coverage
from tubesight.simulate.scene import Scene, light_from_srgb, srgb_from_light
from tubesight.simulate.sweep import Body, see

Device = tuple[Phantom, Tube]

# Points of the line that throws the shadow.
_SHADOW_POINTS = 60
# Noise is drawn from 256 equally likely values of a normal distribution, cut at 2.9 deviations: ten times faster than
# exact draws, and no different after rounding to gray levels.
_NORMAL = ndtri((np.arange(256) + 0.5) / 256)
_NORMAL /= _NORMAL.std()


def paint(levels: Plane, camera: Camera, scene: Scene, window: Window, alpha: Array, light: Array) -> None:
    """Put a layer on a picture, in place: blurred by the optics and mixed in linear light.

    Parameters
    ----------
    levels
        (H, W, 3) sRGB gray levels.
    alpha
        (rows, columns) share of each pixel of the window covered.
    light
        (rows, columns, 3) linear light of the layer.
    """
    margin = int(np.ceil(4 * scene.blur_px)) if scene.blur_px else 0
    outer = window.grown(margin, camera.size_px)
    layer = np.zeros((*outer.shape, 4))
    layer[window.within(outer)] = np.concatenate(
        [light * vignette(camera, window, scene) * alpha[..., None], alpha[..., None]], -1
    )
    if scene.blur_px:
        cv2.GaussianBlur(layer, (0, 0), scene.blur_px, dst=layer, borderType=cv2.BORDER_REPLICATE)
    behind = light_from_srgb(levels[outer.slices])
    levels[outer.slices] = srgb_from_light(behind * (1 - layer[..., 3:]) + layer[..., :3])


def expose(levels: Plane, scene: Scene, rng: np.random.Generator) -> Image:
    """Add sensor noise and round to 8 bits."""
    noisy = levels.copy()
    if scene.noise_levels:
        draws = np.frombuffer(rng.bytes(levels.size), np.uint8).reshape(levels.shape)
        noisy += (scene.noise_levels * _NORMAL).astype(np.float32)[draws]
    np.clip(np.rint(noisy, out=noisy), 0, 255, out=noisy)
    return noisy.astype(np.uint8)


def _draw_tube(
    levels: Plane, back: Backdrop, camera: Camera, pose: Pose, device: Device, clamp: Clamp, scene: Scene
) -> None:
    body = Body.of(*device)
    surface = see(body, camera, pose)
    if surface is None:
        return
    alpha = coverage(surface.edge) * (1 - holder_covers(back, surface, body.radius_mm))
    lit = holder_shadow(surface, scene, pose, clamp)
    light = shade(surface, scene, paint_of(surface, body, scene, camera, pose), pose, lit)
    paint(levels, camera, scene, surface.window, alpha, light)


def clamp_of(phantom: Phantom) -> Clamp:
    """Where a phantom leaves its holder."""
    return Clamp(phantom.at(np.zeros(1))[0], phantom.tangent(np.zeros(1))[0])


def _depth_mm(camera_from_base: Pose, phantom: Phantom) -> float:
    return float(camera_from_base.apply(phantom.at(np.array([phantom.length_mm / 2])))[0, 2])


def render(
    camera: Camera,
    camera_from_base: Pose,
    phantom: Phantom,
    tube: Tube,
    scene: Scene,
    name: str = "",
    others: Sequence[Device] = (),
) -> Image:
    """Photograph a phantom.

    Parameters
    ----------
    phantom
        The centreline, base frame.
    tube
        Diameter and tip.
    name
        Changes the noise from picture to picture.
    others
        More devices of the same colour, with no holder and no shadow. Of two devices the one whose middle is nearer to
        the camera covers the other.

    Returns
    -------
    Image
        (H, W, 3) BGR.

    Raises
    ------
    ValueError
        If the tube has no diameter or comes too near the camera.
    """
    back = backdrop(camera, camera_from_base, scene, clamp_of(phantom))
    levels = back.levels.copy()
    if scene.shadow:
        line = phantom.at(np.linspace(0, phantom.length_mm, _SHADOW_POINTS))
        cast_shadow(levels, scene, camera, camera_from_base, line, tube.diameter_mm or 0.0)
    for device in sorted([(phantom, tube), *others], key=lambda device: -_depth_mm(camera_from_base, device[0])):
        _draw_tube(levels, back, camera, camera_from_base, device, clamp_of(phantom), scene)
    return expose(levels, scene, scene.random("noise", name, *camera.matrix.ravel()))


def render_pair(
    rig: Rig,
    phantom: Phantom,
    tube: Tube,
    scene: Scene | None = None,
    name: str = "",
    others: Sequence[Device] = (),
) -> FramePair:
    """Photograph a phantom with every camera of a rig."""
    look = scene or Scene()
    images = {
        camera: render(
            rig.cameras[camera], rig.camera_from_base[camera], phantom, tube, look, f"{name}/{camera}", others
        )
        for camera in rig.names
    }
    return FramePair(images, name=name)


def render_background(rig: Rig, phantom: Phantom, scene: Scene | None = None, name: str = "background") -> FramePair:
    """Photograph the scene without the tube but with its holder, which stands where `phantom` leaves it."""
    look = scene or Scene()
    images = {}
    for camera in rig.names:
        back = backdrop(rig.cameras[camera], rig.camera_from_base[camera], look, clamp_of(phantom))
        images[camera] = expose(back.levels, look, look.random("noise", name, camera))
    return FramePair(images, name=name)
