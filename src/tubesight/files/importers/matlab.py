"""MATLAB's Computer Vision Toolbox, saved as a struct, or as matrices under OpenCV's names.

``toStruct(stereoParams)``: ``IntrinsicMatrix`` is transposed (``K`` is not), ``[x2 y2 z2] = [x1 y1 z1]
RotationOfCamera2 + TranslationOfCamera2``, ``RadialDistortion = (k1, k2[, k3])``, ``TangentialDistortion = (p1, p2)``,
``ImageSize = (rows, columns)``, and the centre of the first pixel is (1, 1), here (0, 0) (MathWorks on
stereoParametersToOpenCV). Matrices under OpenCV's names (``cameraMatrix1, distCoeffs1, ..., R, t, units``) are taken as
OpenCV counts: from 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from tubesight.core import Array, InputError
from tubesight.files.importers import opencv
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


def recognise(document: Document) -> bool:
    """Tell any other ``.mat``: what it lacks is said when it is read."""
    return document.matlab


def read(documents: Sequence[Document], settings: Settings) -> ForeignRig:
    """Read a struct of a pair, or a struct for each camera (lenses alone), or matrices under OpenCV's names."""
    structs = [next(_structs(document), None) for document in documents]
    found = [struct for struct in structs if struct is not None]
    if not found:
        return _matrices(documents, settings)
    if len(found) < len(documents):
        lost = documents[structs.index(None)]
        raise InputError(f"{lost.path}: no camera parameters in it; in MATLAB, save toStruct(...) of them")
    if "CameraParameters1" not in found[0].data:
        cameras = tuple(_camera(struct, struct.path.stem, settings) for struct in found)
        return ForeignRig(cameras, (None,) * len(cameras))
    if len(found) > 1:
        raise InputError(f"{documents[1].path}: a stereo calibration is one file; name one")
    return _stereo(found[0], settings)


def _structs(document: Document) -> Iterator[Document]:
    """Find the structs of a pair or of a camera: the file itself or one of its variables."""
    for inner in (document, *(document.inner(k) for k, v in document.data.items() if isinstance(v, Mapping))):
        keys = set(inner.data)
        if "MappingCoefficients" in keys:
            raise inner.refusal(
                "MappingCoefficients", "Scaramuzza's fisheye lens is not supported; calibrate with brown or equidistant"
            )
        if "CameraParameters1" in keys or ("RadialDistortion" in keys and keys & {"K", "IntrinsicMatrix"}):
            yield inner


def _matrices(documents: Sequence[Document], settings: Settings) -> ForeignRig:
    document = documents[0]
    if not any(opencv.has_cameras(d) for d in documents):
        raise InputError(
            f"{document.path}: no calibration in it that is known here; in MATLAB: s = toStruct(stereoParams); "
            "save('rig.mat', '-struct', 's')"
        )
    stated = next((text for d in documents if (text := d.text("units", "WorldUnits"))), None)
    unit = _unit(document, settings, stated)
    foreign = opencv.gather(documents, settings, unit, assumed=settings.units is None and not stated, matlab=True)
    if settings.first_pixel is not None:
        return foreign
    note = "the first pixel was read as (0, 0), as OpenCV counts; if the numbers are MATLAB's own, add --first-pixel 1"
    return replace(foreign, notes=(*foreign.notes, note))


def _unit(document: Document, settings: Settings, stated: str | None) -> str:
    try:
        return unit_of(settings, "mm", stated)
    except ValueError as error:
        raise InputError(f"{document.path}: {error}") from error


def _stereo(pair: Document, settings: Settings) -> ForeignRig:
    first, second = pair.inner("CameraParameters1"), pair.inner("CameraParameters2")
    unit = _unit(pair, settings, first.text("WorldUnits"))
    if pair.first("RotationOfCamera2"):
        key, rotation = "RotationOfCamera2", pair.matrix("RotationOfCamera2", 3, 3).T
        translation = pair.vector("TranslationOfCamera2", 3)
    else:
        inner = pair.inner("PoseCamera2")
        key, rotation, translation = "PoseCamera2", inner.matrix("R", 3, 3), inner.vector("Translation", 3)
    pose = pose_of(pair, key, rotation, translation, unit)
    if all(camera.first("TranslationVectors") for camera in (first, second)):
        places = [camera.array("TranslationVectors") * UNITS[unit] for camera in (first, second)]
        if places[0].shape == places[1].shape and places[0].ndim == 2 and places[0].size:
            check_views(pair, key, pose, places[0], places[1])
    cameras = tuple(
        _camera(camera, name, settings) for camera, name in zip((first, second), ("left", "right"), strict=True)
    )
    return ForeignRig(cameras, (Pose.identity(), pose), (length_note(unit),))


def _camera(camera: Document, name: str, settings: Settings) -> ForeignCamera:
    key = "K" if camera.first("K") else "IntrinsicMatrix"
    upright = camera.matrix(key, 3, 3) if key == "K" else camera.matrix(key, 3, 3).T
    matrix = intrinsics(Document(camera.path, {key: upright}, True, camera.where), key)
    radial, tangential = camera.vector("RadialDistortion"), _optional(camera, "TangentialDistortion", 2)
    if radial.size not in (2, 3):
        raise camera.refusal("RadialDistortion", f"expected 2 or 3 coefficients, got {radial.size}; calibrate again")
    coefficients = np.concatenate([radial[:2], tangential, radial[2:]])
    joined = Document(camera.path, {"RadialDistortion": coefficients}, True, camera.where)
    lens, distortion = lens_of(joined, "RadialDistortion", "brown", settings)
    origin = 1 if settings.first_pixel is None else settings.first_pixel
    size = None
    if camera.first("ImageSize") and camera.array("ImageSize").size:
        height, width = camera.size("ImageSize")
        size = (width, height)
    made = camera_matrix(matrix[[0, 1], [0, 1]], matrix[:2, 2], float(matrix[0, 1]), origin)
    return ForeignCamera(name, camera.path, made, distortion, lens, size)


def _optional(camera: Document, key: str, count: int) -> Array:
    return camera.vector(key, count) if camera.first(key) else np.zeros(count)
