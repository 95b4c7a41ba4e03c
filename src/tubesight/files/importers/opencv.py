"""OpenCV's FileStorage: YAML, XML or JSON with matrices under whatever keys a program chose.

Known are the keys of OpenCV's samples (``camera_matrix``, ``distortion_coefficients``; ``M1, D1, M2, D2``; ``R, T``)
and the names in common use; `_` and upper case do not count. The pose is ``X_second = R X_first + T``
(stereoCalibrate); its unit is that in which the squares of the board were given: millimetres unless told otherwise. A
skew in a camera matrix is left out, as OpenCV's projection does.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, InputError
from tubesight.files.importers.document import Document
from tubesight.files.importers.foreign import (
    UNITS,
    ForeignCamera,
    ForeignRig,
    Settings,
    camera_matrix,
    check_views,
    intrinsics,
    length_note,
    lens_of,
    pose_of,
    unit_of,
)
from tubesight.geometry.pose import Pose

# What a key stands for, by its name without `_` in lower case.
_STEMS = {
    "matrix": "m|k|cameramatrix|intrinsicmatrix|cameraintrinsics|intrinsics?|mtx|cammat",
    "distortion": "d|distcoe?f?fs?|distortioncoefficients|distortioncoeffs|distortion|dist",
    "size": "imagesize|imgsize|framesize|resolution|size",
}
_ROTATION = ("r", "rotation", "rotationmatrix", "rmat", "rot", "om", "rvec")
_TRANSLATION = ("t", "translation", "translationvector", "tvec", "trans")
_WIDTH, _HEIGHT = ("imagewidth", "width", "imgwidth"), ("imageheight", "height", "imgheight")
_SIDES = {"left": 1, "l": 1, "right": 2, "r": 2}
_KEY = {kind: re.compile(rf"(left|right|l|r)?(?:{stems})(left|right|l|r|\d)?") for kind, stems in _STEMS.items()}


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a matrix, lens or size is: a document and its key."""

    document: Document
    key: str


def recognise(document: Document) -> bool:
    """Tell a storage by a camera matrix or a pose of two cameras."""
    return not document.matlab and (has_cameras(document) or _pose_keys(document) is not None)


def has_cameras(document: Document) -> bool:
    """Whether there is a camera matrix."""
    return bool(_places(document, "matrix"))


def read(documents: Sequence[Document], settings: Settings) -> ForeignRig:
    """Read one camera a file, or a pair from one file, or from lenses and poses in a file each."""
    return gather(documents, settings, unit_of(settings, "mm"), assumed=settings.units is None)


def gather(
    documents: Sequence[Document], settings: Settings, unit: str, *, assumed: bool, matlab: bool = False
) -> ForeignRig:
    """Put together the cameras and the relative pose of files whose keys OpenCV's users would know.

    Parameters
    ----------
    assumed
        Whether neither the user nor the files told the unit.
    matlab
        Whether a skew is kept: MATLAB projects with it.
    """
    matrices = _collect(documents, "matrix")
    if not matrices:
        raise InputError(f"{documents[0].path}: no camera matrix in it; name the file with the lenses too")
    if len({isinstance(side, int) for side in matrices}) > 1:
        raise InputError(f"{documents[-1].path}: one file has numbered cameras, another has not; import them apart")
    distortions, sizes = _collect(documents, "distortion"), _collect(documents, "size")
    names = _default_names(sorted(matrices, key=str), matrices)
    cameras, notes = [], []
    for side, name in names.items():
        place = matrices[side]
        matrix = intrinsics(place.document, place.key)
        if matrix[0, 1] and not matlab:
            notes.append(f"{place.document.path}: the skew of {matrix[0, 1]:.4g} px was left out, as OpenCV does")
        if side not in distortions:
            raise place.document.refusal(place.key, "its distortion is missing; add it (zeros for an ideal lens)")
        lens, distortion, remark = _lens(distortions[side], settings)
        notes += remark
        size = _size(documents, place.document, sizes.get(side))
        made = camera_matrix(
            matrix[[0, 1], [0, 1]], matrix[:2, 2], matrix[0, 1] if matlab else 0.0, settings.first_pixel or 0
        )
        cameras.append(ForeignCamera(name, place.document.path, made, distortion, lens, size))
    poses, remark = _poses(documents, len(cameras), unit)
    if any(poses):
        remark = [length_note(unit, assumed)]
    return ForeignRig(tuple(cameras), poses, (*notes, *remark))


def _plain(key: str) -> str:
    return re.sub(r"[_\s-]", "", key).lower()


def _places(document: Document, kind: str) -> dict[int | None, str]:
    """Keys of a kind by camera: 1 for left, 2 for right, or the number; None where a file has one camera."""
    found: dict[int | None, str] = {}
    for key, value in document.data.items():
        match = _KEY[kind].fullmatch(_plain(key))
        # k1, k2: a single number is a coefficient, text describes something.
        if match is None or all(match.groups()) or not isinstance(value, Mapping | list | np.ndarray):
            continue
        side = match[1] or match[2]
        number = None if side is None else _SIDES.get(side) or int(side)
        if number in found:
            raise document.refusal(key, f"so is {found[number]}: which one is it? Remove one")
        found[number] = key
    return found


def _collect(documents: Sequence[Document], kind: str) -> dict[int | str, _Place]:
    """Find what files have of a kind: by number where they count their cameras, else by file."""
    found: dict[int | str, _Place] = {}
    for index, document in enumerate(documents):
        for number, key in _places(document, kind).items():
            side = f"file {index:04}" if number is None else number
            if side in found:
                raise document.refusal(key, f"{found[side].document.path.name} has it too; name one of the files")
            found[side] = _Place(document, key)
    return found


def _default_names(sides: Sequence[int | str], matrices: Mapping[int | str, _Place]) -> dict[int | str, str]:
    """Names of the cameras: of a numbered pair left and right, of others their number, of single files their own."""
    if isinstance(sides[0], int):
        pair = len(sides) == 2
        return {side: ("left", "right")[n] if pair else f"camera{side}" for n, side in enumerate(sides)}
    documents = {side: matrices[side].document for side in sides}
    return {side: document.text("camera_name") or document.path.stem for side, document in documents.items()}


def _lens(place: _Place, settings: Settings) -> tuple[str, Array, list[str]]:
    document, key = place.document, place.key
    name = document.text("distortion_model", "lens", "camera_model")
    fisheye = document.first("fisheye_model", "fisheye")
    if name == "pinhole":  # says nothing about the distortion
        name = None
    if name is None and fisheye is not None:
        name = "fisheye" if document.vector(fisheye, 1)[0] else None
    lens, distortion = lens_of(document, key, name, settings)
    if lens == "brown" and name is None and settings.lens is None and document.vector(key).size == 4:
        return lens, distortion, [
            f"{document.path}: {key} was read as k1, k2, p1, p2; for OpenCV's fisheye model add --lens equidistant"
        ]  # fmt: skip
    return lens, distortion, []


def _size(documents: Sequence[Document], own: Document, place: _Place | None) -> tuple[int, int] | None:
    if place is not None:
        return place.document.size(place.key)
    # A size in another file holds for this camera too, unless that file is another camera's.
    for document in (own, *(other for other in documents if None not in _places(other, "matrix"))):
        plain = {_plain(key): key for key in document.data}
        width, height = (next((plain[k] for k in keys if k in plain), None) for keys in (_WIDTH, _HEIGHT))
        if width is not None and height is not None:
            return document.size(width, height)
        general = _places(document, "size").get(None)
        if general is not None:
            return document.size(general)
    return None


def _pose_keys(document: Document) -> tuple[str | None, str | None] | None:
    plain = {_plain(key): key for key in document.data}
    rotation = next((plain[key] for key in _ROTATION if key in plain), None)
    translation = next((plain[key] for key in _TRANSLATION if key in plain), None)
    return None if rotation is None and translation is None else (rotation, translation)


def _poses(documents: Sequence[Document], count: int, unit: str) -> tuple[tuple[Pose | None, ...], list[str]]:
    """``camera_from_first`` of each camera, and remarks."""
    found = [(d, keys) for d in documents if (keys := _pose_keys(d)) is not None]
    if count != 2 or not found:
        lost = ["R and T were left out: they need two cameras"] if found and count != 2 else []
        return (None,) * count, lost or (["no R and T: the lenses alone were read"] if count > 1 else [])
    if len(found) > 1:
        raise InputError(f"{found[1][0].path}: {found[0][0].path.name} has R and T too; name one of the files")
    document, (rotation, translation) = found[0]
    if rotation is None or translation is None:
        raise document.refusal(str(rotation or translation), "R and T belong together; add the other one")
    pose = pose_of(document, rotation, _rotation(document, rotation), document.vector(translation, 3), unit)
    if all(document.first(key) for key in ("tvecs1", "tvecs2")):
        first, second = (document.array(key) for key in ("tvecs1", "tvecs2"))
        if first.ndim == 2 and first.shape == second.shape and first.shape[1] == 3:
            check_views(document, rotation, pose, first * UNITS[unit], second * UNITS[unit])
    return (Pose.identity(), pose), []


def _rotation(document: Document, key: str) -> Array:
    """Rotation matrix, also from a rotation vector."""
    if document.array(key).size == 3:
        return Pose.from_rotvec(document.vector(key, 3), np.zeros(3)).rotation
    return document.matrix(key, 3, 3)
