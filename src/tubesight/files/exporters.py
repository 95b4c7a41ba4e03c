"""Rigs for other tools: OpenCV's FileStorage and ROS camera_info, as text by file name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np

from tubesight.core import Array, InputError
from tubesight.files.nested import dump_yaml
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

_ROS_LENSES = {"brown": "plumb_bob", "rational": "rational_polynomial", "equidistant": "equidistant"}
# Sine of the angle between the baseline and the mean optical axis under which the rectified pictures would be empty: no
# lens sees 87 degrees off its axis and the tube at once.
_ALONG_BASELINE = 0.05


def to_opencv(rig: Rig) -> dict[str, str]:
    """Write a rig for `cv2.FileStorage`.

    One camera, or cameras without poses: a file each with ``camera_matrix``, ``distortion_coefficients``,
    ``image_width``, ``image_height``, ``fisheye_model``, as OpenCV's calibration sample writes it. Otherwise a
    file for the first camera with each other one: ``M1, D1, M2, D2, R, T`` as of OpenCV's stereo sample,
    ``X_2 = R X_1 + T``, T in mm, with ``image_size1, image_size2, fisheye_model``.

    Raises
    ------
    InputError
        If a camera has a skew, which OpenCV leaves out when it projects, or two of a pair have lenses of which one is
        equidistant.
    """
    _refuse_skew(rig, "OpenCV")
    first, *others = rig.names
    if not others or set(rig.camera_from_base) != set(rig.names):
        return {f"{name}.yml": _storage(_mono(camera)) for name, camera in rig.cameras.items()}
    return {f"{first}_{name}.yml": _storage(_pair(rig, first, name)) for name in others}


def to_ros(rig: Rig) -> dict[str, str]:
    """Write a rig as ``camera_info`` files, one a camera.

    Two cameras with poses are rectified: x along the baseline from the left to the right camera, z the mean of the
    optical axes across it, and ``P_right[0, 3] = -f * baseline`` in metres, from which the pose can be composed again.
    Other numbers of cameras, and cameras without poses, have ``P = [K | 0]`` and no rectification.

    Raises
    ------
    InputError
        If a camera has a skew, or two cameras look along their baseline.
    """
    _refuse_skew(rig, "ROS")
    rotations = {name: np.eye(3) for name in rig.names}
    projections = {name: np.column_stack([camera.matrix, np.zeros(3)]) for name, camera in rig.cameras.items()}
    if len(rig.names) == 2 and len(rig.camera_from_base) == 2:
        rotations, projections = _rectify(rig)
    return {
        f"{name}.yaml": _camera_info(name, rig.cameras[name], rotations[name], projections[name]) for name in rig.names
    }


EXPORTERS: Mapping[str, Callable[[Rig], dict[str, str]]] = {"opencv": to_opencv, "ros": to_ros}


def _refuse_skew(rig: Rig, tool: str) -> None:
    for name, camera in rig.cameras.items():
        if camera.matrix[0, 1]:
            raise InputError(
                f"{name}: {tool} knows no skew, this camera has {camera.matrix[0, 1]:.3g} px; calibrate without skew"
            )


def _mono(camera: Camera) -> dict[str, Any]:
    return {
        "image_width": camera.size_px[0],
        "image_height": camera.size_px[1],
        "fisheye_model": int(camera.lens == "equidistant"),
        "camera_matrix": camera.matrix,
        "distortion_coefficients": camera.distortion,
    }


def _pair(rig: Rig, first: str, second: str) -> dict[str, Any]:
    a, b = rig.cameras[first], rig.cameras[second]
    if (a.lens == "equidistant") != (b.lens == "equidistant"):
        raise InputError(f"{first}, {second}: OpenCV knows no pair of a {a.lens} and a {b.lens} lens; use one for both")
    pose = rig.relative_pose(second, first)
    return {
        "image_size1": list(a.size_px),
        "image_size2": list(b.size_px),
        "fisheye_model": int(a.lens == "equidistant"),
        "M1": a.matrix,
        "D1": a.distortion,
        "M2": b.matrix,
        "D2": b.distortion,
        "R": pose.rotation,
        "T": pose.translation_mm[:, None],
    }


def _storage(entries: Mapping[str, Any]) -> str:
    """Text of a storage by OpenCV's own writer, with all 17 digits and the header that every version reads."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in entries.items():
        if isinstance(value, list):
            storage.startWriteStruct(key, cv2.FileNode_SEQ | cv2.FileNode_FLOW)
            for item in value:
                storage.write("", item)
            storage.endWriteStruct()
        else:
            # A vector without a second direction would become a type that older versions do not read.
            storage.write(key, np.atleast_2d(value) if isinstance(value, np.ndarray) else value)
    _, _, body = str(storage.releaseAndGetString()).partition("\n")
    return f"%YAML:1.0\n{body}"


def _rectify(rig: Rig) -> tuple[dict[str, Array], dict[str, Array]]:
    """Rectifying rotations and projection matrices (metres) of two cameras."""
    left, right = rig.names
    if _sideways(rig.relative_pose(right, left)) < 0:
        left, right = right, left
    right_from_left = rig.relative_pose(right, left)
    centre = right_from_left.inverse().translation_mm
    baseline_mm = float(np.linalg.norm(centre))
    x = centre / baseline_mm
    axis = np.array([0.0, 0.0, 1.0]) + right_from_left.rotation[2]
    z = axis - (axis @ x) * x
    if np.linalg.norm(z) < _ALONG_BASELINE * np.linalg.norm(axis) or not axis.any():
        raise InputError(f"{left}, {right}: the cameras look along their baseline, ROS cannot rectify them; use opencv")
    z /= np.linalg.norm(z)
    rectified_from_left = np.array([x, np.cross(z, x), z])
    width, height = rig.cameras[left].size_px
    focal = min(rig.cameras[name].focal_px for name in (left, right))
    matrix = np.array([[focal, 0, (width - 1) / 2, 0], [0, focal, (height - 1) / 2, 0], [0, 0, 1, 0]])
    moved = matrix.copy()
    moved[0, 3] = -focal * baseline_mm / 1000
    rotations = {left: rectified_from_left, right: rectified_from_left @ right_from_left.rotation.T}
    return rotations, {left: matrix, right: moved}


def _sideways(second_from_first: Pose) -> float:
    """Positive where the second camera is to the right of the first, as both see it on average."""
    return float(second_from_first.inverse().translation_mm[0] - second_from_first.translation_mm[0])


def _camera_info(name: str, camera: Camera, rotation: Array, projection: Array) -> str:
    def matrix(values: Array) -> dict[str, Any]:
        rows = np.atleast_2d(values)
        return {"rows": rows.shape[0], "cols": rows.shape[1], "data": rows.ravel()}

    return dump_yaml(
        {
            "image_width": camera.size_px[0],
            "image_height": camera.size_px[1],
            "camera_name": name,
            "camera_matrix": matrix(camera.matrix),
            "distortion_model": _ROS_LENSES[camera.lens],
            "distortion_coefficients": matrix(camera.distortion),
            "rectification_matrix": matrix(rotation),
            "projection_matrix": matrix(projection),
        }
    )
