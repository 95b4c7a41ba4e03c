"""The scene behind the tube: cloth or clutter, the holder, soft shadows; drawn once for a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from tubesight.core import Array, readonly
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.simulate.phantom import Placed, straight
from tubesight.simulate.rays import Window, coverage, dot, plane_points
from tubesight.simulate.scene import Scene, lambert, light_from_srgb, srgb_from_light
from tubesight.simulate.sweep import Body, Surface, see

Plane = NDArray[np.float32]

# The holder ends above the picture in every sensible rig: half a metre of cameras at arm's length.
_HOLDER_LENGTH_MM = 150.0
# Its outline may be 0.05 px off: it is scenery, nothing is measured on it.
_HOLDER_TOLERANCE_PX = 0.05
# Distances of wall and lamp from the tube: those of the shadows in a photograph of a mock-up on a table.
_WALL_MM, _LAMP_MM = 220.0, 700.0
# Lines of a printed grid: their thickness as a share of the spacing, and how much light they swallow.
_LINE_SHARE, _LINE_DARKNESS = 0.08, 0.6
# Softness of shadows on the wall, px of a picture 1920 wide.
_SHADOW_BLUR_PX = 14.0
# Shadows are drawn at a quarter of the size: they hold no detail.
_SHADOW_SHRINK = 4


@dataclass(frozen=True, slots=True, eq=False)
class Clamp:
    """Where the tube leaves its holder: base point (mm) and direction, base frame."""

    base_mm: Array
    axis: Array

    @property
    def key(self) -> tuple[float, ...]:
        """Numbers to cache by."""
        return tuple(np.concatenate([self.base_mm, self.axis]).round(9).tolist())


@dataclass(frozen=True, slots=True, eq=False)
class Backdrop:
    """A camera's picture without the tube.

    Attributes
    ----------
    levels
        (H, W, 3) float32, sRGB gray levels before noise.
    holder
        What the camera sees of the holder, which may cover the tube; None without a holder.
    """

    levels: Plane
    holder: Surface | None


def grain(shape: tuple[int, int], rng: np.random.Generator) -> Plane:
    """Cloth (H, W): noise of about unit deviation at three scales (threads, weave, folds)."""
    total = np.zeros(shape, np.float32)
    for sigma, weight in ((0.8, 0.7), (3.0, 0.6), (30.0, 0.3)):
        shrink = 1 if sigma < 10 else 8
        small = rng.standard_normal((shape[0] // shrink + 2, shape[1] // shrink + 2), dtype=np.float32)
        soft = cv2.GaussianBlur(small, (0, 0), sigma / shrink)
        layer = cv2.resize(soft, None, fx=shrink, fy=shrink)[: shape[0], : shape[1]]
        total += np.float32(weight / layer.std()) * layer
    return total


def _clutter(shape: tuple[int, int], count: int, rng: np.random.Generator) -> Plane:
    """Random boxes, discs, triangles and rods in random colours, light tube-coloured ones among them."""
    height, width = shape
    picture = np.full((height, width, 3), rng.uniform(60, 200, 3), np.uint8)
    for _ in range(count):
        colour = tuple(rng.uniform(20, 245, 3)) if rng.random() < 0.75 else (float(rng.uniform(150, 240)),) * 3
        centre, size = rng.uniform((0, 0), (width, height)), rng.uniform(0.02, 0.16, 2) * width
        angle = float(rng.uniform(0, 180))
        shape_kind = rng.integers(4)
        corners = cv2.boxPoints((tuple(centre), tuple(size), angle)).astype(np.int32)
        if shape_kind == 0:
            cv2.fillConvexPoly(picture, corners, colour, cv2.LINE_AA)
        elif shape_kind == 1:
            axes = (int(size[0] / 2), int(size[1] / 2))
            cv2.ellipse(picture, (int(centre[0]), int(centre[1])), axes, angle, 0, 360, colour, -1, cv2.LINE_AA)
        elif shape_kind == 2:
            cv2.fillConvexPoly(picture, corners[:3], colour, cv2.LINE_AA)
        else:
            ends = [tuple(map(int, corners[i])) for i in (0, 2)]
            cv2.line(picture, ends[0], ends[1], colour, int(0.008 * width) + 1, cv2.LINE_AA)
    return light_from_srgb(np.arange(256)).astype(np.float32)[picture]


def _grid(camera: Camera, pose: Pose, scene: Scene) -> Plane:
    """Share of the light (H, W) that a grid of lines on the wall sends back."""
    width, height = camera.size_px
    wall_mm = float(pose.translation_mm[2]) + _WALL_MM
    at = plane_points(camera, Window(0, height, 0, width)) * wall_mm
    # Distance to the nearest line each way; a line darkens pixels by what it covers of them.
    off = np.abs(np.remainder(at / scene.grid_mm + 0.5, 1.0) - 0.5) * scene.grid_mm
    covered = np.clip((_LINE_SHARE / 2 * scene.grid_mm - off) * camera.focal_px / wall_mm + 0.5, 0.0, 1.0)
    return np.asarray(1 - _LINE_DARKNESS * np.nan_to_num(covered).max(-1), np.float32)


def _fall_of_light(shape: tuple[int, int], scene: Scene, rng: np.random.Generator) -> Plane:
    """Illumination (H, W): a ramp across the picture; the mean is one."""
    angle = rng.uniform(0, 2 * np.pi)
    down, across = (np.linspace(-1, 1, n, dtype=np.float32) for n in shape)
    return np.asarray(1 + scene.gradient * (across * np.cos(angle) + down[:, None] * np.sin(angle)), np.float32)


def vignette(camera: Camera, window: Window, scene: Scene) -> Plane:
    """Share of the light (rows, columns, 1) that the lens passes: falls with the square of the radius."""
    width, _ = camera.size_px
    x = (np.arange(window.left, window.right) - camera.matrix[0, 2]) / (width / 2)
    y = (np.arange(window.top, window.bottom) - camera.matrix[1, 2]) / (width / 2)
    return np.asarray(1 - scene.vignetting * (y[:, None] ** 2 + x**2), np.float32)[..., None]


def shade(surface: Surface, scene: Scene, albedo: Array, camera_from_base: Pose, lit: Array | float = 1.0) -> Array:
    """Light (rows, columns, 3) of a surface under the scene's lamp; `lit` is the lamp's visibility."""
    lamp = camera_from_base.rotate(scene.light_direction)
    to_eye = -surface.points_mm / np.maximum(np.linalg.norm(surface.points_mm, axis=-1, keepdims=True), 1e-12)
    half = lamp + to_eye
    half /= np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
    return lambert(scene, albedo, (surface.normals @ lamp) * lit, dot(surface.normals, half))


def holder_shadow(surface: Surface, scene: Scene, camera_from_base: Pose, clamp: Clamp) -> Array:
    """Visibility of the lamp (rows, columns) past the holder's face: 0 in its shadow, 1 outside."""
    points = camera_from_base.inverse().apply(surface.points_mm) - clamp.base_mm
    rise = -float(scene.light_direction @ clamp.axis)
    if rise <= 0 or not scene.holder_diameter_mm:
        return np.ones(surface.hit.shape)
    on_face = points + ((points @ clamp.axis) / rise)[..., None] * scene.light_direction
    radius = np.linalg.norm(on_face - (on_face @ clamp.axis)[..., None] * clamp.axis, axis=-1)
    # A lamp about 60 mm wide at 700 mm: the half shadow is a fifth of the holder's radius wide.
    edge = (radius / (scene.holder_diameter_mm / 2) - 1) / 0.2 + 0.5
    return np.asarray(np.clip(edge, 0.0, 1.0))


def cast_shadow(levels: Plane, scene: Scene, camera: Camera, pose: Pose, points_mm: Array, thickness_mm: float) -> None:
    """Darken the wall behind by the soft shadow of a line of points (N, 3) in the base frame, in place.

    The wall stands across the optical axis behind the base, the lamp near the tube.
    """
    width, height = camera.size_px
    points = pose.apply(points_mm)
    lamp = points.mean(0) + _LAMP_MM * pose.rotate(scene.light_direction)
    wall = points[:, 2].max() + _WALL_MM
    if lamp[2] > points[:, 2].min() - 1:
        return
    on_wall = lamp + (points - lamp) * ((wall - lamp[2]) / (points[:, 2] - lamp[2]))[:, None]
    at = camera.project(on_wall)
    # Far outside the picture a lens polynomial is without meaning, and OpenCV's integers end.
    at = at[np.isfinite(at).all(-1) & (np.abs(at - (width / 2, height / 2)) < 2 * width).all(-1)]
    if len(at) < 2:
        return
    mask = np.zeros((height // _SHADOW_SHRINK + 1, width // _SHADOW_SHRINK + 1), np.float32)
    thickness = max(int(thickness_mm * camera.focal_px / wall * 1.5 / _SHADOW_SHRINK), 1)
    cv2.polylines(mask, [(at / _SHADOW_SHRINK).astype(np.int32)], False, 1.0, thickness)
    soft = cv2.GaussianBlur(mask, (0, 0), _SHADOW_BLUR_PX * width / 1920 / _SHADOW_SHRINK)
    # Gray levels follow light to the power of 1 / 2.2 closely enough for a shadow.
    factor = (1 - scene.shadow * soft) ** np.float32(1 / 2.2)
    levels *= cv2.resize(factor, None, fx=_SHADOW_SHRINK, fy=_SHADOW_SHRINK)[:height, :width, None]


@lru_cache(maxsize=8)
def _drawn(camera: Camera, pose: Pose, scene: Scene, key: tuple[float, ...] | None) -> Backdrop:
    width, height = camera.size_px
    # The camera's own numbers name its backdrop: another camera sees another part of the cloth.
    rng = scene.random("backdrop", *camera.matrix.ravel(), *pose.translation_mm.round(6))
    cloth = light_from_srgb(scene.cloth_bgr)
    if scene.clutter:
        light = _clutter((height, width), scene.clutter, rng)
    else:
        light = cloth.astype(np.float32) * (1 + scene.texture * grain((height, width), rng))[..., None]
    if scene.grid_mm:
        light *= _grid(camera, pose, scene)[..., None]
    light *= _fall_of_light((height, width), scene, rng)[..., None]
    light *= vignette(camera, Window(0, height, 0, width), scene)
    holder = None
    if key is not None:
        clamp = Clamp(readonly(key[:3], (3,), "base"), readonly(key[3:], (3,), "axis"))
        holder = _draw_holder(light, camera, pose, scene, clamp, cloth)
    if scene.blur_px:
        cv2.GaussianBlur(light, (0, 0), scene.blur_px, dst=light)
    return Backdrop(srgb_from_light(light), holder)


def _draw_holder(light: Plane, camera: Camera, pose: Pose, scene: Scene, clamp: Clamp, cloth: Array) -> Surface | None:
    """Put the holder into the picture, in place, and return what the camera sees of it."""
    # Any rotation that takes +z to the tube's direction will do: the holder is round.
    x = np.cross(clamp.axis, np.eye(3)[np.argmin(np.abs(clamp.axis))])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(clamp.axis, x), clamp.axis], -1)
    stem = Placed(straight(_HOLDER_LENGTH_MM), Pose(rotation, clamp.base_mm - _HOLDER_LENGTH_MM * clamp.axis))
    body = Body(stem, scene.holder_diameter_mm / 2, flat_end=True, tolerance_px=_HOLDER_TOLERANCE_PX)
    holder = see(body, camera, pose)
    if holder is not None:
        alpha = coverage(holder.edge)[..., None]
        own = shade(holder, replace(scene, specular=0.0), cloth, pose) * vignette(camera, holder.window, scene)
        light[holder.window.slices] = light[holder.window.slices] * (1 - alpha) + own * alpha
    return holder


def backdrop(camera: Camera, camera_from_base: Pose, scene: Scene, clamp: Clamp | None) -> Backdrop:
    """Return the picture without the tube, with the holder at `clamp`; the last few are remembered."""
    with_holder = clamp is not None and scene.holder_diameter_mm > 0
    return _drawn(camera, camera_from_base, scene, clamp.key if clamp is not None and with_holder else None)


def holder_covers(back: Backdrop, surface: Surface, depth_mm: float) -> Array:
    """Share of each pixel (rows, columns) of a body's window that the holder hides.

    The holder hides what lies `depth_mm` behind its front: less would cut at the face that the tube comes out of.
    """
    covered = np.zeros(surface.hit.shape)
    holder = back.holder
    if holder is None:
        return covered
    a, b = holder.window, surface.window
    top, bottom, left, right = max(a.top, b.top), min(a.bottom, b.bottom), max(a.left, b.left), min(a.right, b.right)
    if top < bottom and left < right:
        common = Window(top, bottom, left, right)
        inner, outer = common.within(b), common.within(a)
        behind = surface.distance_mm[inner] > holder.distance_mm[outer] + depth_mm
        covered[inner] = coverage(holder.edge[outer]) * behind
    return covered
