"""What an importer makes, and what the importers share: units, lenses, poses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tubesight.core import Array
from tubesight.files.importers.document import Document
from tubesight.geometry.lens import LENSES
from tubesight.geometry.pose import Pose

# Millimetres in a unit of length.
UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
_UNIT_WORDS = {
    "millimeter": "mm", "millimetre": "mm", "centimeter": "cm", "centimetre": "cm", "meter": "m", "metre": "m",
    "inch": "in", "inche": "in",
}  # fmt: skip

# The names other tools have for our lenses.
_LENS_NAMES = {
    "brown": ("brown", "brownconrady", "plumbbob", "radtan", "radialtangential", "none"),
    "rational": ("rational", "rationalpolynomial"),
    "equidistant": ("equidistant", "fisheye", "kannalabrandt"),
}

# How far the poses of the board in both cameras may contradict the relative pose, in baselines; tools that solve for
# all together are exact, a transposed rotation is off by far more than one.
_VIEWS_AGREE = 0.1


@dataclass(frozen=True, slots=True)
class Settings:
    """What the user says about files that leave it open; None takes what the format says.

    Attributes
    ----------
    names
        Names of the cameras in the order of the files.
    sizes
        (width, height) of the pictures, one for all cameras or one for each.
    units
        Unit of lengths, one of `UNITS`.
    lens
        One of `LENSES`.
    first_pixel
        Coordinate of the centre of the first pixel: 0, or 1 as MATLAB counts.
    """

    names: tuple[str, ...] = ()
    sizes: tuple[tuple[int, int], ...] = ()
    units: str | None = None
    lens: str | None = None
    first_pixel: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ForeignCamera:
    """A camera as a file describes it; `matrix` counts pixels from 0, `size_px` is None where the file is silent."""

    name: str
    path: Path
    matrix: Array
    distortion: Array
    lens: str
    size_px: tuple[int, int] | None


@dataclass(frozen=True, slots=True, eq=False)
class ForeignRig:
    """Cameras and their poses ``camera_from_first`` in mm, None where the files know the lens alone."""

    cameras: tuple[ForeignCamera, ...]
    from_first: tuple[Pose | None, ...]
    notes: tuple[str, ...] = ()


def unit_of(settings: Settings, default: str, stated: str | None = None) -> str:
    """Tell the unit of lengths: the user's, the file's, or the format's."""
    if settings.units is not None:
        return settings.units
    if stated:
        word = stated.lower()
        unit = word if word in UNITS else _UNIT_WORDS.get(word.removesuffix("s"))
        if unit is None:
            raise ValueError(f"unknown unit {stated[:20]!r}; name it with --units, one of {', '.join(UNITS)}")
        return unit
    return default


def length_note(unit: str, assumed: bool = False) -> str:
    """Remark on the unit of lengths."""
    return f"lengths were read as {unit}" + ("; name another unit with --units" if assumed else ", the rig is in mm")


def lens_of(document: Document, key: str, name: str | None, settings: Settings) -> tuple[str, Array]:
    """Lens and coefficients in our order from those under a key, which are in OpenCV's order.

    Parameters
    ----------
    name
        What the file calls the lens; None where it is known by the number of coefficients: 4 or 5 are Brown-Conrady's,
        8, 12 or 14 the rational model's with thin prism and tilt.
    """
    given = document.vector(key)
    lens = settings.lens
    if name is not None:
        plain = re.sub(r"[^a-z0-9]", "", name.lower())
        lens = next((ours for ours, theirs in _LENS_NAMES.items() if plain in theirs), None)
        if lens is None:
            raise document.refusal(
                key, f"the lens {name[:40]!r} is not supported ({', '.join(LENSES)} are); calibrate with one of these"
            )
        if settings.lens not in (None, lens):
            raise document.refusal(key, f"the file says {name[:40]!r}, --lens says {settings.lens!r}; leave --lens out")
    if lens is None:
        lens = "rational" if given.size > 5 else "brown"
    count = len(LENSES[lens].coefficients)
    fits = {"brown": (0, 4, 5, 8, 12, 14), "rational": (8, 12, 14), "equidistant": (4,)}[lens]
    if given.size not in fits:
        raise document.refusal(
            key, f"a lens with {given.size} coefficients is not supported ({lens} has {count}); calibrate with {lens}"
        )
    if given[count:].any():
        more = "thin prism or tilted sensor" if lens == "rational" else "rational"
        raise document.refusal(key, f"the coefficients of a {more} lens are not supported in a {lens} one; calibrate")
    return lens, np.concatenate([given[:count], np.zeros(max(count - given.size, 0))])


def intrinsics(document: Document, key: str) -> Array:
    """Camera matrix (3, 3) under a key, which has to be one and not its transpose."""
    matrix = document.matrix(key, 3, 3)
    if matrix[1, 0] or not np.array_equal(matrix[2], (0, 0, 1)):
        why = "it is transposed" if np.array_equal(matrix[:, 2], (0, 0, 1)) else "it is no camera matrix"
        raise document.refusal(
            key, f"expected rows (fx, skew, cx), (0, fy, cy), (0, 0, 1): {why}; write the file again"
        )
    return matrix


def camera_matrix(focal_px: Array, centre_px: Array, skew_px: float, first_pixel: int) -> Array:
    """Rows (fx, skew, cx), (0, fy, cy), (0, 0, 1), with pixels counted from 0."""
    (fx, fy), (cx, cy) = focal_px, centre_px - first_pixel
    return np.array([[fx, skew_px, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pose_of(document: Document, key: str, rotation: Array, translation: Array, unit: str) -> Pose:
    """Pose from a rotation under a key, which has to be one, and a translation in some unit."""
    try:
        return Pose(rotation, translation * UNITS[unit])
    except ValueError as error:
        raise document.refusal(key, f"{error}; calibrate again, or mend the file") from error


def check_views(document: Document, key: str, pose: Pose, first: Array, second: Array) -> None:
    """Hold a relative pose against the places (N, 3) of the board in both cameras, in mm."""
    off = float(np.median(np.linalg.norm(pose.apply(first) - second, axis=-1)))
    if off > _VIEWS_AGREE * float(np.linalg.norm(pose.translation_mm)):
        raise document.refusal(
            key,
            f"contradicts the places of the board in the two cameras by {off:.3g} mm; is the rotation transposed, or "
            "the direction the other one? Write the file again",
        )
