"""The compiled stages with the signatures of their readable twins (`tubesight.vision.stages`)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tubesight.core import Array, Image, Tube
from tubesight.geometry.camera import Camera
from tubesight.vision import entry_kernels as entry
from tubesight.vision import see_kernels
from tubesight.vision.ending import FOUND, Ending
from tubesight.vision.signal import Signal, planes
from tubesight.vision.silhouette import REASONS
from tubesight.vision.tip import Contour
from tubesight.vision.view import TipView, View
from tubesight.vision.walker import GAP_TOLD, Track

_NOTHING = np.empty((0, 0, 1), np.uint8)


def _flat(signal: Signal) -> tuple[Image, Image, tuple[float, ...]]:
    background = signal.background
    return signal.image, _NOTHING if background is None else background, signal.numbers


def _pair(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())


@lru_cache(maxsize=64)
def _optics(camera: Camera) -> tuple[tuple[float, ...], tuple[float, ...], bool]:
    """Flat form of a camera: a brown lens is a rational one without denominator."""
    m, k = camera.matrix, np.zeros(8)
    k[: len(camera.distortion)] = camera.distortion
    return (m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2]), tuple(k), camera.lens == "equidistant"


def learn(
    image: Image, background: Image | None, start_px: Array, way: Array, width_px: float
) -> tuple[Array, Array, Array, float]:
    """See `silhouette.learn`."""
    image = planes(image)
    behind = _NOTHING if background is None else planes(background)
    if background is not None and behind.shape != image.shape:
        raise ValueError(f"background picture: expected shape {image.shape}, got {behind.shape}")
    colours, difference = entry.learn(image, behind, _pair(start_px), _pair(way), width_px)
    tube, cloth, gain = colours[:, : image.shape[2]]
    return tube, cloth, gain, difference


def find_pair(
    signal: Signal, middle_px: Array, direction: Array, width_px: float, known_width: bool
) -> tuple[Array, float] | None:
    """See `pairs.find_pair`."""
    flat = _flat(signal)
    x, y, width = entry.find_pair(*flat, _pair(middle_px), _pair(direction), width_px, known_width)
    return None if np.isnan(width) else (np.array([x, y]), width)


def walk(signal: Signal, start_px: Array, direction: Array, width_px: float) -> Track:
    """See `walker.walk`."""
    return _track(*entry.walk(*_flat(signal), _pair(start_px), _pair(direction), width_px, False))


def walk_from_base(signal: Signal, start_px: Array, way: Array, width_px: float) -> Track | None:
    """See `walker.walk_from_base`."""
    track = _track(*entry.walk(*_flat(signal), _pair(start_px), _pair(way), width_px, True))
    return track if len(track.width_px) else None


def _track(middles: Array, widths: Array, gaps: Array) -> Track:
    return Track(middles, widths, tuple(gap for gap in gaps.tolist() if gap > GAP_TOLD))


def measure(signal: Signal, track: Track) -> tuple[Array, float, Array, float]:
    """See `walker.measure`."""
    middles, widths = np.ascontiguousarray(track.middle_px), np.ascontiguousarray(track.width_px)
    edges, blur, left, right, outwards = entry.measure(*_flat(signal), middles, widths)
    return edges, blur, np.array([left, right]), outwards


def find_end(signal: Signal, middle_px: Array, width_px: Array, reach_widths: float) -> Ending:
    """See `ending.find_end`."""
    middles, widths = np.ascontiguousarray(middle_px), np.ascontiguousarray(width_px)
    outcome, px, heading, width = entry.find_end(*_flat(signal), middles, widths, reach_widths)
    return Ending(outcome, np.array(px), np.array(heading), width)


def ball(
    signal: Signal,
    centre_px: Array,
    heading: Array,
    expected: float,
    half: float,
    blur_px: float,
    outwards_px: float,
    careful: bool,
) -> Contour:
    """See `tip.ball`."""
    places = _pair(centre_px), _pair(heading)
    return _contour(True, entry.ball(*_flat(signal), *places, expected, half, blur_px, outwards_px, careful))


def round_end(
    signal: Signal, centre_px: Array, heading: Array, radius: float, blur_px: float, outwards_px: float
) -> Contour:
    """See `tip.round_end`."""
    places = _pair(centre_px), _pair(heading)
    return _contour(False, entry.round_end(*_flat(signal), *places, radius, blur_px, outwards_px))


def face(signal: Signal, end_px: Array, heading: Array, width_px: float, blur_px: float, outwards_px: float) -> Contour:
    """See `tip.face`."""
    places = _pair(end_px), _pair(heading)
    return _contour(False, entry.face(*_flat(signal), *places, width_px, blur_px, outwards_px))


def _contour(ball: bool, found: tuple[int, Array, tuple[float, ...]]) -> Contour:
    outcome, points, (x, y, radius, rms, doubt, seen) = found
    return Contour(outcome, points, np.array([x, y]), radius, rms, doubt, ball and outcome == FOUND, seen)


def tangent_cone(camera: Camera, contour_px: Array) -> tuple[Array, Array, Array, float, float]:
    """See `rays.tangent_cone`."""
    numbers, kept = entry.tangent_cone(*_optics(camera), camera.focal_px, contour_px)
    return np.array(numbers[:3]), np.array(numbers[3:5]), kept, numbers[5], numbers[6]


def tube_rays(
    camera: Camera, edges_px: Array, heading: Array, tip_px: Array, near_px: float, room_px: float, base_px: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """See `rays.tube_rays`."""
    flat, places = _optics(camera), (_pair(heading), _pair(tip_px))
    edges, unit, middle, px, base, rough = entry.tube_rays(*flat, edges_px, *places, near_px, room_px, _pair(base_px))
    return edges, unit, middle, px, np.array([*base, 1.0]), rough


_SHAPES = {"round": see_kernels.ROUND, "flat": see_kernels.FLAT, "ball": see_kernels.BALL}


def see_from_base(
    name: str,
    image: Image,
    background: Image | None,
    camera: Camera,
    tube: Tube,
    start_px: Array,
    way: Array,
    width_px: float,
) -> View | None:
    """See `see.see`, in one call; None where a stage does not succeed at its first attempt, and for other tubes."""
    if tube.tip.shape not in _SHAPES or tube.diameter_mm is None:
        return None
    image = planes(image)
    behind = _NOTHING if background is None else planes(background)
    if background is not None and behind.shape != image.shape:
        return None
    ratio = (tube.tip.diameter_mm or tube.diameter_mm) / tube.diameter_mm if tube.tip.shape == "ball" else 1.0
    why, edges, unit, rays, centreline, points, few, seen = entry.see_from_base(
        image,
        behind,
        _pair(start_px),
        _pair(way),
        width_px,
        *_optics(camera),
        camera.focal_px,
        _SHAPES[tube.tip.shape],
        ratio,
    )
    if why == see_kernels.DOUBTFUL:
        return None
    numbers = np.array([*few[:2], 1.0, *few[2:6], *seen[:5]])
    tip = TipView.of_own(numbers[7:10], numbers[10:], seen[5], points, seen[6], seen[7])
    return View.of_own(
        name, edges, unit, rays, centreline, numbers[:3], tip, numbers[3:5], numbers[5:7], few[6], REASONS[why], ()
    )
