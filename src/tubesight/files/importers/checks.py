"""The checks that every foreign rig has to pass before it becomes one of ours."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tubesight.core import InputError
from tubesight.files.importers.foreign import ForeignRig, Settings
from tubesight.files.rig import refuse_camera_name
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# The housings of two cameras leave 1 mm between their lenses at least, and whoever looks at a tube stands nearer than
# 3 m to it: a baseline outside is in another unit (0.11 m read as millimetres, 110 mm read as metres).
_BASELINE_MM = (1.0, 3000.0)
# Part of the baseline that has to point to the side before left and right are told apart: 60 degrees off still does.
_SIDEWAYS = 0.5
# Distance of the principal point from the middle of the picture, as part of width and height, past which in both
# directions a wrong size is looked for. Lenses are off by 0.02, badly calibrated ones by 0.12 in one direction; a size
# that is wrong by a factor of 4/3 puts it 0.125 off in both.
_OFF_CENTRE = 0.11
# How near to the middle the principal point has to come once the size is mended; 4:3 in place of 16:9 leaves 0.07.
_CENTRED = 0.1
# Sizes of common sensors and videos. Where no file tells the size, the one is assumed in whose middle the principal
# points are, and said so: pictures of another size are refused later, so that a wrong one cannot go unnoticed.
_COMMON_SIZES = (
    (320, 240), (640, 360), (640, 480), (752, 480), (800, 600), (848, 480), (960, 540), (1024, 768), (1280, 720),
    (1280, 800), (1280, 960), (1280, 1024), (1440, 1080), (1600, 1200), (1920, 1080), (1920, 1200), (1928, 1448),
    (2048, 1536), (2448, 2048), (2592, 1944), (3840, 2160),
)  # fmt: skip
# Neighbours of that list differ by 0.06 in one direction.
_COMMON_OFF = 0.05


def assemble(foreign: ForeignRig, settings: Settings) -> tuple[Rig, tuple[str, ...]]:
    """Check a foreign rig and make it ours, with remarks; the base frame is that of the first camera.

    Raises
    ------
    InputError
        If the size of the pictures is unknown or wrong, left and right are swapped, a length is in another unit, or a
        number is none a camera can have.
    """
    names = _names(foreign, settings)
    sizes, assumed = _sizes(foreign, settings)
    cameras = {}
    for name, camera, size in zip(names, foreign.cameras, sizes, strict=True):
        try:
            cameras[name] = Camera(camera.matrix, size, camera.distortion, camera.lens)
        except ValueError as error:
            raise InputError(f"{camera.path}: {name}: {error}; calibrate again") from error
        if size not in settings.sizes or camera.size_px is None:
            _refuse_wrong_size(cameras[name], name, camera.path)
        else:
            _refuse_outside(cameras[name], name, camera.path)
    poses = {name: pose for name, pose in zip(names, foreign.from_first, strict=True) if pose is not None}
    if len(poses) > 1:
        for camera, name in zip(foreign.cameras[1:], names[1:], strict=True):
            if name in poses:
                _refuse_baseline(poses[name], names[0], name, camera.path, settings)
                _refuse_swapped(poses[name], names[0], name, camera.path)
    else:
        poses = {}
    return Rig(cameras, poses, names[0]), (*foreign.notes, *([assumed] if assumed else []))


def rig_name(text: str) -> str:
    """Nearest name a camera may have in a rig file."""
    name = re.sub(r"[^\w.-]+", "_", text.strip()).strip("_.-") or "camera"
    try:
        refuse_camera_name(name, text)
    except InputError:
        return f"{name}_camera"
    return name


def _names(foreign: ForeignRig, settings: Settings) -> tuple[str, ...]:
    first = foreign.cameras[0].path
    if not settings.names:
        names = tuple(rig_name(camera.name) for camera in foreign.cameras)
        if len(set(names)) < len(names):
            raise InputError(f"{first}: two cameras are named {names[0]!r}; name them with --names")
        return names
    if len(settings.names) != len(foreign.cameras):
        count = len(foreign.cameras)
        raise InputError(f"{first}: --names has {len(settings.names)} names for {count} camera(s); give {count}")
    for name in settings.names:
        refuse_camera_name(name, "--names")
        if settings.names.count(name) > 1:
            raise InputError(f"--names: {name!r} is there twice; use another name")
    return settings.names


def _sizes(foreign: ForeignRig, settings: Settings) -> tuple[tuple[tuple[int, int], ...], str | None]:
    """Size of each camera's pictures, and a remark where it had to be assumed."""
    count, path = len(foreign.cameras), foreign.cameras[-1].path
    if settings.sizes and len(settings.sizes) not in (1, count):
        raise InputError(f"--size: give it once, or once for each of the {count} cameras")
    told = settings.sizes * count if len(settings.sizes) == 1 else settings.sizes
    own = tuple(camera.size_px for camera in foreign.cameras)
    assumed = None
    if not told and None in own:
        told, assumed = _assumed_sizes(foreign)
    for camera, stated in zip(foreign.cameras, told, strict=False):
        if camera.size_px not in (None, stated):
            raise InputError(
                f"{camera.path}: wrong image size: the file says {_by(camera.size_px)}, --size says {_by(stated)}; "
                "leave --size out"
            )
    sizes = told or tuple(size for size in own if size is not None)
    if len(set(sizes)) > 1 and len(settings.sizes) != count:
        raise InputError(
            f"{path}: wrong image size: the cameras have {' and '.join(map(_by, sizes))} pixels; mend the size, or "
            "confirm it with a --size for each camera"
        )
    return sizes, assumed


def _assumed_sizes(foreign: ForeignRig) -> tuple[tuple[tuple[int, int], ...], str]:
    """Size of pictures of cameras whose files do not tell it: a common one with the principal points in its middle."""
    path = next(camera.path for camera in foreign.cameras if camera.size_px is None)
    if any(camera.size_px for camera in foreign.cameras):
        raise InputError(f"{path}: the file does not tell the size of the pictures; add --size WIDTHxHEIGHT")
    centres = np.array([camera.matrix[:2, 2] for camera in foreign.cameras])
    off = [float(np.abs(centres / size - 0.5).max()) for size in _COMMON_SIZES]
    best = int(np.argmin(off))
    if off[best] > _COMMON_OFF:
        raise InputError(f"{path}: the file does not tell the size of the pictures; add --size WIDTHxHEIGHT")
    size = _COMMON_SIZES[best]
    return (size,) * len(centres), (
        f"{path}: the file does not tell the size of the pictures; {_by(size)} was assumed, the common size with the "
        "principal point nearest to its middle: if yours is another, import again with --size WIDTHxHEIGHT"
    )


def _by(size: tuple[int, int] | None) -> str:
    return "x".join(map(str, size or ()))


def _refuse_outside(camera: Camera, name: str, path: Path) -> None:
    cx, cy = camera.matrix[:2, 2]
    # A principal point on the first pixel is one that nobody set.
    if not camera.contains((cx, cy), margin_px=1.0):
        raise InputError(
            f"{path}: wrong image size: the principal point ({cx:.1f}, {cy:.1f}) of {name} lies outside its pictures "
            f"of {_by(camera.size_px)}; give the size at which it was calibrated"
        )


def _refuse_wrong_size(camera: Camera, name: str, path: Path) -> None:
    """Refuse a size with the principal point outside, or one that another scale or the other order would explain."""
    centre, size = camera.matrix[:2, 2], np.array(camera.size_px, float)
    _refuse_outside(camera, name, path)
    part = centre / size
    if (np.abs(part - 0.5) <= _OFF_CENTRE).any():
        return
    for other, reason in (
        (centre / size[::-1], "width and height are exchanged"),
        (part / (2 * part.mean()), "the calibration had pictures of another size"),
    ):
        if (np.abs(other - 0.5) < _CENTRED).all():
            raise InputError(
                f"{path}: wrong image size: the principal point ({centre[0]:.1f}, {centre[1]:.1f}) of {name} in "
                f"{_by(camera.size_px)} tells that {reason}; mend the size (of a crop: confirm it with --size)"
            )


def _refuse_baseline(pose: Pose, first: str, name: str, path: Path, settings: Settings) -> None:
    baseline = float(np.linalg.norm(pose.translation_mm))
    if baseline <= 0:
        raise InputError(f"{path}: {first} and {name} are at one place; calibrate again")
    low, high = _BASELINE_MM
    if settings.units is None and not low <= baseline <= high:
        guess = "metres" if baseline < low else "millimetres"
        raise InputError(
            f"{path}: {first} and {name} are {baseline:.4g} mm apart: the lengths look like {guess}; name their unit "
            f"with --units {'m' if baseline < low else 'mm'}"
        )


def _refuse_swapped(pose: Pose, first: str, name: str, path: Path) -> None:
    """Refuse left and right that each see the other on the wrong side."""
    sides = [_side(first), _side(name)]
    if sorted(sides) != [-1, 1]:
        return
    there, back = pose.inverse().translation_mm, pose.translation_mm
    baseline = float(np.linalg.norm(back))
    if there[0] * sides[1] < -_SIDEWAYS * baseline and back[0] * sides[0] < -_SIDEWAYS * baseline:
        where = "left" if there[0] < 0 else "right"
        raise InputError(
            f"{path}: left and right look swapped: {name} is {abs(there[0]):.4g} mm to the {where} of {first}; "
            f"exchange the files, or the names with --names {name},{first}"
        )


def _side(name: str) -> int:
    words: Sequence[str] = re.findall(r"[a-z]+", name.lower())
    return ("right" in words) - ("left" in words)
