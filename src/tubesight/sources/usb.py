"""Cameras of this machine: Video4Linux and OpenCV's other ways, with exposure and focus held."""

from __future__ import annotations

import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tubesight.core import InputError
from tubesight.sources.buffers import PictureBuffers
from tubesight.sources.devices import list_devices
from tubesight.sources.jpeg import decode_picture, to_gray
from tubesight.sources.reader import Picture, Source, Wanted

# A stamp further from this machine's clock than this is of another clock.
_SAME_CLOCK_S = 5.0
# Video4Linux: 1 is exposure by hand, and drivers of other systems want 0.25 (OpenCV's own convention).
_MANUAL_EXPOSURE = 1.0 if sys.platform == "linux" else 0.25
_KEYS = ("format", "fps", "exposure", "gain", "focus")
_FORMATS = ("MJPG", "YUYV")


@dataclass(frozen=True, slots=True)
class UsbSettings:
    """Settings of a camera, from ``DEVICE?format=MJPG&fps=60&exposure=100&gain=0&focus=30``.

    Attributes
    ----------
    format
        Four letters of the pixel format; most cameras give their larger sizes at full rate as motion JPEG only.
    fps
        Pictures a second to ask for; None for the camera's own.
    exposure, gain, focus
        In the driver's units. Where given the automatic is off. Autofocus is off in any case: a calibration holds for
        one focus.
    """

    format: str = "MJPG"
    fps: float | None = None
    exposure: float | None = None
    gain: float | None = None
    focus: float | None = None


def parse_settings(text: str) -> tuple[str, UsbSettings]:
    """Split a device from its settings."""
    device, _, query = text.partition("?")
    given: dict[str, str] = {}
    for part in filter(None, query.split("&")):
        key, equals, value = part.partition("=")
        if key not in _KEYS or not equals:
            raise InputError(f"{text}: {part!r} is no setting of a camera; known are {', '.join(_KEYS)}, as fps=60")
        given[key] = value
    form = given.pop("format", "MJPG").upper()
    if form not in _FORMATS:
        raise InputError(f"{text}: format {form!r} is not known; use {' or '.join(_FORMATS)}")
    try:
        numbers = {key: float(value) for key, value in given.items()}
    except ValueError:
        raise InputError(f"{text}: settings are numbers, as exposure=100") from None
    return device, UsbSettings(form, **numbers)


def usb_source(text: str, wanted: Wanted) -> Source:
    """Open a camera by index, node, or ``usb:`` with a part of its name or its serial number.

    Raises
    ------
    InputError
        If there is no such camera, or more than one.
    """
    device, settings = parse_settings(text)
    place = _named(device.removeprefix("usb:")) if device.startswith("usb:") else device
    if place.isdecimal() and sys.platform == "linux":
        place = f"/dev/video{place}"
    if place.startswith("/dev/") and not Path(place).exists():
        raise InputError(f"{place}: there is no such camera; `ls /dev/video*` lists those that are there")
    name = place if place.startswith("/dev/") else f"camera {place}"
    return Source(name, lambda: _UsbReader(name, place, settings, wanted), raw=True)


def _named(text: str) -> str:
    cameras = list_devices()
    found = [d for d in cameras if text and (text == d.serial or text.lower() in d.name.lower())]
    if len(found) == 1:
        # By the link that stays when cameras are plugged in again, where there is one.
        return found[0].by_id or found[0].by_path or found[0].node
    seen = ", ".join(f"{d.name} ({d.serial or d.by_path or d.node})" for d in (found or cameras)) or "none"
    what = "no camera has" if not found else f"{len(found)} cameras have"
    raise InputError(f"usb:{text}: {what} that name or serial number (there are: {seen}); see `tubesight devices`")


class _UsbReader:
    def __init__(self, name: str, place: str, settings: UsbSettings, wanted: Wanted) -> None:
        self._name, self._wanted, self._buffers = name, wanted, PictureBuffers()
        backend = cv2.CAP_V4L2 if sys.platform == "linux" else cv2.CAP_ANY
        self._device = cv2.VideoCapture(int(place) if place.isdecimal() else place, backend)
        # The bytes of a JPEG are wanted as they are: damage can be told, and a recording keeps them.
        self._coded = False
        _apply(self._device, settings, wanted)
        if settings.format == "MJPG":
            self._device.set(cv2.CAP_PROP_CONVERT_RGB, 0)
            form = int(self._device.get(cv2.CAP_PROP_FOURCC))
            self._coded = form == cv2.VideoWriter.fourcc(*"MJPG")
            if not self._coded:
                self._device.set(cv2.CAP_PROP_CONVERT_RGB, 1)

    def read(self) -> Picture:
        good, image = self._device.read()
        arrived = time.monotonic()
        if not good or image is None:
            raise InputError(f"{self._name}: the camera gives no pictures; does another program use it?")
        stamp = self._device.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        time_s = stamp if 0 <= arrived - stamp < _SAME_CLOCK_S else arrived
        coded = b""
        pixels = np.asarray(image, dtype=np.uint8)
        if self._coded and (pixels.ndim == 1 or 1 in pixels.shape[:2]):
            coded = pixels.tobytes()
            pixels = decode_picture(coded, self._name, self._wanted.gray, self._buffers)
        elif self._wanted.gray:
            pixels = to_gray(pixels)
        wanted, got = self._wanted.size_px, pixels.shape[1::-1]
        if wanted is not None and got != tuple(wanted):
            raise InputError(
                f"{self._name}: gives {got[0]} x {got[1]}, not {wanted[0]} x {wanted[1]}; "
                "ask for a size that it has with --size"
            )
        return Picture(pixels, time_s, coded)

    def close(self) -> None:
        self._device.release()


def _apply(device: cv2.VideoCapture, settings: UsbSettings, wanted: Wanted) -> None:
    """Ask for format, size and rate, and hold focus and exposure; drivers ignore what they cannot."""
    device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.format))
    if wanted.size_px is not None:
        device.set(cv2.CAP_PROP_FRAME_WIDTH, wanted.size_px[0])
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted.size_px[1])
    if settings.fps is not None:
        device.set(cv2.CAP_PROP_FPS, settings.fps)
    # One picture in the driver: the newest counts.
    device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    device.set(cv2.CAP_PROP_AUTOFOCUS, 0)
    if settings.focus is not None:
        device.set(cv2.CAP_PROP_FOCUS, settings.focus)
    if settings.exposure is not None:
        device.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
        device.set(cv2.CAP_PROP_EXPOSURE, settings.exposure)
    if settings.gain is not None:
        device.set(cv2.CAP_PROP_GAIN, settings.gain)


def is_device(text: str) -> bool:
    """Whether text names a camera of this machine."""
    return bool(re.match(r"(\d{1,3}|/dev/[^?]+|usb:.*)(\?|$)", text))
