"""The simulator as cameras in real time: a tube that bends to and fro."""

from __future__ import annotations

import math
import threading
import time
from functools import lru_cache

import numpy as np

from tubesight.core import Image, InputError, Tip, Tube
from tubesight.geometry.rig import Rig
from tubesight.simulate import Arc, Scene, render, rig_around
from tubesight.sources.jpeg import to_gray
from tubesight.sources.reader import Picture, Source, Wanted

# What is photographed where nothing is given: the tube of the mock-up that the package is tested on.
SIM_TUBE = Tube(12.0, Tip("ball", 16.0), clamped=True)
SIM_SIZE = (1280, 720)
_HZ, _HZ_MAX = 30.0, 1000.0
# Half a swing in so many pictures: photographs are rendered (0.1 to 0.2 s each) before the first is shown.
_POSES = 16
# The tube swings about this shape by this much, at most this often a second; where pictures come faster it swings less
# far, so that its tip is never accelerated by more than 3 m/s^2.
_BEND_RAD, _SWING_RAD, _SWING_HZ = math.radians(45), math.radians(25), 1.35
_LENGTH_MM = 150.0
# Patterns of last bits that pictures differ by, since a sensor never gives the same picture twice.
_PATTERNS = 64


def sim_rig(size_px: tuple[int, int] | None, names: tuple[str, ...]) -> Rig:
    """Return the rig of simulated cameras where none is given."""
    angle = 90.0 if len(names) < 3 else 180.0 / len(names)
    return rig_around(angle, size_px=size_px or SIM_SIZE, names=names)


def sim_phantom(number: int, hz: float = _HZ) -> Arc:
    """Return the shape of the tube in picture `number`: to and fro as a sine."""
    swing = math.cos(math.pi * number / (_POSES - 1)) * min(1.0, (_SWING_HZ * 2 * (_POSES - 1) / hz) ** 2)
    return Arc(_BEND_RAD - swing * _SWING_RAD, math.radians(20) - swing * _SWING_RAD, _LENGTH_MM)


@lru_cache(maxsize=8)
def _photographs(rig: Rig, camera: str, tube: Tube, scene: Scene, gray: bool, hz: float) -> tuple[Image, ...]:
    """All pictures of half a swing."""
    pictures = []
    for number in range(_POSES):
        phantom = sim_phantom(number, hz)
        image = render(rig.cameras[camera], rig.camera_from_base[camera], phantom, tube, scene, f"{number}/{camera}")
        pictures.append(to_gray(image) if gray else image)
    return tuple(pictures)


def sim_picture(wanted: Wanted, number: int, hz: float = _HZ) -> Image:
    """Photograph `number` of the camera wanted."""
    if wanted.rig is None:
        raise ValueError("the simulator needs a rig")
    tube, scene = wanted.tube or SIM_TUBE, wanted.scene or Scene()
    step = number % (2 * _POSES - 2)
    pose = step if step < _POSES else 2 * _POSES - 2 - step
    image = _photographs(wanted.rig, wanted.camera, tube, scene, wanted.gray, hz)[pose]
    first = number % _PATTERNS
    return np.bitwise_xor(image, _last_bits(image.shape)[first : first + len(image)])


@lru_cache(maxsize=4)
def _last_bits(shape: tuple[int, ...]) -> Image:
    """Random last bits, some rows more than a picture has."""
    return np.random.default_rng(0).integers(0, 2, (shape[0] + _PATTERNS, *shape[1:]), np.uint8)


def sim_source(text: str, wanted: Wanted) -> Source:
    """``sim:`` or ``sim:HZ``: pictures at whole multiples of 1/HZ of the machine's clock, so that cameras agree."""
    given = text.removeprefix("sim:")
    try:
        hz = float(given) if given else _HZ
    except ValueError:
        hz = math.nan
    if not 0 < hz <= _HZ_MAX:
        raise InputError(f"{text}: expected sim: or sim:HZ with at most {_HZ_MAX:g} pictures a second")
    # Rendered here and not on opening: a camera that takes seconds for its first picture counts as dead.
    sim_picture(wanted, 0, hz)
    return Source(f"simulated {wanted.camera}", lambda: _SimReader(hz, wanted), raw=True)


class _SimReader:
    def __init__(self, hz: float, wanted: Wanted) -> None:
        self._hz, self._wanted = hz, wanted
        self._number = math.ceil(time.monotonic() * hz)
        self._wake = threading.Event()

    def read(self) -> Picture | None:
        # A camera that is not read loses pictures.
        self._number = max(self._number + 1, math.floor(time.monotonic() * self._hz))
        self._wake.wait(max(self._number / self._hz - time.monotonic(), 0.0))
        if self._wake.is_set():
            return None
        return Picture(sim_picture(self._wanted, self._number, self._hz), self._number / self._hz)

    def close(self) -> None:
        self._wake.set()
