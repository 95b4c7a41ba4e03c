"""Kalibr's camera chain: ``cam0, cam1, ...`` in one file, as Kalibr and OpenVINS write it.

The pose of a camera is ``T_cn_cnm1`` (maps the camera before to this one), or ``T_cam_imu`` (IMU to camera), or
``T_imu_cam`` (camera to IMU, OpenVINS). Lengths are metres (Kalibr's page on YAML formats).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from tubesight.core import InputError
from tubesight.files.importers.document import Document
from tubesight.files.importers.foreign import (
    ForeignCamera,
    ForeignRig,
    Settings,
    camera_matrix,
    length_note,
    lens_of,
    pose_of,
    unit_of,
)
from tubesight.geometry.pose import Pose

_CAMERA = re.compile(r"cam(\d+)")
# How far the two ways to a pose may differ, as part of the baseline and in radians: both are written from one solution
# with 9 digits or more; 1 % and half a degree leave room for figures copied by hand.
_SAME_PART, _SAME_RAD = 0.01, 0.01


def recognise(document: Document) -> bool:
    """Tell a chain by its cameras: ``camN`` with intrinsics."""
    return not document.matlab and any(
        _CAMERA.fullmatch(key) and isinstance(value, dict) and "intrinsics" in value
        for key, value in document.data.items()
    )


def read(documents: Sequence[Document], settings: Settings) -> ForeignRig:
    """Read one file with all cameras of the chain."""
    if len(documents) > 1:
        raise InputError(f"{documents[1].path}: a camera chain is one file; name one")
    document = documents[0]
    keys = sorted((key for key in document.data if _CAMERA.fullmatch(key)), key=lambda key: int(key[3:]))
    if not keys:
        raise InputError(f"{document.path}: no camera cam0, cam1, ... in it; is it a camera chain of Kalibr?")
    chain = [document.inner(key) for key in keys]
    unit = unit_of(settings, "m")
    cameras = tuple(_camera(key, camera, settings) for key, camera in zip(keys, chain, strict=True))
    poses = _poses(chain, unit)
    notes = []
    if len(chain) > 1:
        lost = [key for key, pose in zip(keys, poses, strict=True) if pose is None]
        if len(lost) < len(keys):
            notes.append(length_note(unit))
        if lost:
            notes.append(f"no pose of {', '.join(lost)} in the file: the lens alone was read")
    return ForeignRig(cameras, poses, tuple(notes))


def _camera(name: str, camera: Document, settings: Settings) -> ForeignCamera:
    model = camera.text("camera_model") or "pinhole"
    if model != "pinhole":
        raise camera.refusal("camera_model", f"{model[:40]!r} is not supported (pinhole is); calibrate with pinhole")
    fx, fy, cx, cy = camera.vector("intrinsics", 4)
    distortion_model = camera.text("distortion_model")
    if not distortion_model:
        raise camera.refusal("distortion_model", "this key is missing; add radtan or equidistant")
    lens, distortion = lens_of(camera, "distortion_coeffs", distortion_model, settings)
    matrix = camera_matrix(np.array([fx, fy]), np.array([cx, cy]), 0.0, settings.first_pixel or 0)
    size = camera.size("resolution") if camera.first("resolution") else None
    return ForeignCamera(name, camera.path, matrix, distortion, lens, size)


def _poses(chain: Sequence[Document], unit: str) -> tuple[Pose | None, ...]:
    """``camera_from_first`` of each camera; where the file has both ways to it, they have to agree."""
    by_imu = [_from_imu(camera, unit) for camera in chain]
    poses: list[Pose | None] = [Pose.identity()]
    for n, camera in enumerate(chain[1:], start=1):
        before, imu, imu_first = poses[n - 1], by_imu[n], by_imu[0]
        direct = None if imu is None or imu_first is None else imu @ imu_first.inverse()
        step = _transform(camera, "T_cn_cnm1", unit) if camera.first("T_cn_cnm1") else None
        linked = None if step is None or before is None else step @ before
        if linked is not None and direct is not None:
            _refuse_contradiction(camera, linked, direct)
        poses.append(linked or direct)
    return tuple(poses) if any(poses[1:]) else (None,) * len(chain)


def _from_imu(camera: Document, unit: str) -> Pose | None:
    """``camera_from_imu`` in mm, from either direction."""
    if camera.first("T_cam_imu"):
        return _transform(camera, "T_cam_imu", unit)
    if camera.first("T_imu_cam"):
        return _transform(camera, "T_imu_cam", unit).inverse()
    return None


def _transform(camera: Document, key: str, unit: str) -> Pose:
    m = camera.matrix(key, 4, 4)
    if not np.allclose(m[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
        raise camera.refusal(key, "expected a last row of (0, 0, 0, 1); is it transposed? Mend the file")
    return pose_of(camera, key, m[:3, :3], m[:3, 3], unit)


def _refuse_contradiction(camera: Document, linked: Pose, direct: Pose) -> None:
    difference = linked @ direct.inverse()
    turned = float(np.linalg.norm(difference.rotvec_rad))
    moved = float(np.linalg.norm(linked.translation_mm - direct.translation_mm))
    if turned > _SAME_RAD or moved > _SAME_PART * float(np.linalg.norm(direct.translation_mm)):
        raise camera.refusal(
            "T_cn_cnm1",
            f"contradicts the poses against the IMU by {moved:.3g} mm and {np.degrees(turned):.2g} degrees; remove one",
        )
