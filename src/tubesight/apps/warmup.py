"""``tubesight warmup``: compile and keep what results need, before it is needed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tubesight.core import FramePair, Image, Tip, Tube
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, render_pair, rig_around

Progress = Callable[[str, int, int], None]

# Compiled code does not depend on the size of pictures: small ones in which free tubes are found too.
_SIZE_PX = (1280, 720)
# One tube for each kind of tip, since each kind has code of its own. Free tubes are seen stage by stage: so is a
# clamped one where something covers it, and that must not wait for a compiler.
_TIPS = Tip("ball", 16.0), Tip("round"), Tip("flat")
_TUBES = tuple(Tube(12.0, tip, clamped) for clamped in (True, False) for tip in _TIPS)
_METHODS = ("silhouette", "cone_ray")


@dataclass(frozen=True, slots=True)
class Warmed:
    """Something that was run once.

    Attributes
    ----------
    name
        What: the tube, its tip, the kind of picture and the method.
    seconds
        How long that took; a fraction of a second where its code was there already.
    ok
        Whether it gave a shape.
    """

    name: str
    seconds: float
    ok: bool


def warm_up(progress: Progress | None = None) -> tuple[Warmed, ...]:
    """Measure one simulated pair with each kind of tube, of tip, of picture and of method.

    Parameters
    ----------
    progress
        Called before each with its name, the number done and their total, and once at the end.
    """
    rig = rig_around(90.0, size_px=_SIZE_PX)
    rendered = [(tube, render_pair(rig, Arc(np.radians(40.0), 1.0, 160.0), tube).images) for tube in _TUBES]
    work = [(*seen, kind, method) for seen in rendered for kind in _PICTURES for method in _METHODS]
    done = []
    for k, (tube, images, kind, method) in enumerate(work):
        name = f"{'clamped' if tube.clamped else 'free'} tube, {tube.tip.shape} tip, {kind}, {method}"
        if progress is not None:
            progress(name, k, len(work))
        pair = FramePair({camera: _PICTURES[kind](image) for camera, image in images.items()})
        start = time.perf_counter()
        ok = bool(ShapeSensor(rig, tube, method)(pair))
        done.append(Warmed(name, time.perf_counter() - start, ok))
    if progress is not None:
        progress("ready", len(work), len(work))
    return tuple(done)


def _gray(image: Image) -> Image:
    return image if image.ndim == 2 else np.ascontiguousarray(image[..., 1])


def _luma(image: Image) -> Image:
    """Y plane of a buffer of YUYV, which is not contiguous."""
    buffer = np.empty((*image.shape[:2], 2), np.uint8)
    buffer[..., 0] = _gray(image)
    return buffer[..., 0]


_PICTURES: dict[str, Callable[[Image], Image]] = {"colour": lambda image: image, "gray": _gray, "YUYV": _luma}
