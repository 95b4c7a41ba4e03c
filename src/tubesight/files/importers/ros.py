"""ROS camera_info: one file a camera, as ``camera_calibration`` writes them or ``topic echo`` prints them.

A stereo pair stores no relative pose but the rectification: ``p_rectified = rectification @ p_camera`` in each camera,
and in the right one's projection matrix ``P[0, 3] = -fx * baseline`` (``P[1, 3]`` where one camera is above the
other). With ``t = (P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0)`` the pose is
``right_from_left: R = R_right^T R_left, T = R_right^T t`` (sensor_msgs/CameraInfo; image_pipeline/CameraInfo).
Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tubesight.core import Array, InputError
from tubesight.files.importers.document import Document
from tubesight.files.importers.foreign import (
    ForeignCamera,
    ForeignRig,
    Settings,
    camera_matrix,
    intrinsics,
    length_note,
    lens_of,
    pose_of,
    unit_of,
)
from tubesight.geometry.pose import Pose

# Keys of the files, then of the messages of ROS 1 and ROS 2.
_MATRIX = ("camera_matrix", "K", "k")
_DISTORTION = ("distortion_coefficients", "D", "d")
_RECTIFICATION = ("rectification_matrix", "R", "r")
_PROJECTION = ("projection_matrix", "P", "p")
# Rectified focal lengths of a pair are one number, written with 6 digits.
_SAME_FOCAL = 1e-5


def recognise(document: Document) -> bool:
    """Tell a camera_info by its camera matrix and projection, or the name of its lens."""
    has = document.first
    if document.matlab or has(*_MATRIX) is None or has("image_width", "width") is None:
        return False
    return has(*_PROJECTION) is not None or (has("distortion_model") is not None and has(*_RECTIFICATION) is not None)


def read(documents: Sequence[Document], settings: Settings) -> ForeignRig:
    """Read one camera, or the left and the right one of a pair, in this order."""
    if len(documents) > 2:
        raise InputError(
            f"{documents[2].path}: camera_info describes one camera or a pair; name the files of the left and the right"
        )
    unit = unit_of(settings, "m")
    cameras = tuple(_camera(document, settings) for document in documents)
    notes = tuple(note for document in documents for note in _notes(document))
    poses: tuple[Pose | None, ...] = (None,) * len(cameras)
    if len(documents) == 2:
        pose = _pose(documents[0], documents[1], unit)
        if pose is None:
            notes = (*notes, "the projection matrices tell no baseline: the lenses alone were read")
        else:
            poses, notes = (Pose.identity(), pose), (*notes, length_note(unit))
    return ForeignRig(cameras, poses, notes)


def _key(document: Document, keys: tuple[str, ...]) -> str:
    return document.first(*keys) or keys[0]


def _camera(document: Document, settings: Settings) -> ForeignCamera:
    matrix = intrinsics(document, _key(document, _MATRIX))
    for key in ("binning_x", "binning_y"):
        if document.first(key) and document.vector(key, 1)[0] > 1:
            raise document.refusal(key, "binned pictures are not supported; calibrate at the size that is used")
    roi = document.data.get("roi")
    if isinstance(roi, dict) and any(roi.get(key) for key in ("x_offset", "y_offset", "width", "height")):
        raise document.refusal("roi", "a region of interest is not supported; calibrate at the size that is used")
    name = document.text("distortion_model")
    lens, distortion = lens_of(document, _key(document, _DISTORTION), name or None, settings)
    width = document.first("image_width", "width") or "image_width"
    height = "height" if width == "width" else "image_height"
    header = document.data.get("header")
    frame = header.get("frame_id") if isinstance(header, dict) else None
    label = document.text("camera_name") or (str(frame) if frame else document.path.stem)
    return ForeignCamera(
        label.rpartition("/")[2] or label,
        document.path,
        camera_matrix(matrix[[0, 1], [0, 1]], matrix[:2, 2], 0.0, settings.first_pixel or 0),
        distortion,
        lens,
        document.size(width, height),
    )


def _notes(document: Document) -> list[str]:
    skew = document.matrix(_key(document, _MATRIX), 3, 3)[0, 1]
    return [f"{document.path}: the skew of {skew:.4g} px was left out, as ROS does"] if skew else []


def _baseline(document: Document) -> Array | None:
    """Return t in the rectified frame in the unit of the file; None without a projection matrix."""
    if document.first(*_PROJECTION) is None or document.first(*_RECTIFICATION) is None:
        return None
    key = _key(document, _PROJECTION)
    p = document.matrix(key, 3, 4)
    if not (p[0, 0] > 0 and p[1, 1] > 0 and np.array_equal(p[2], (0, 0, 1, 0))):
        raise document.refusal(key, "expected rows (fx, 0, cx, Tx), (0, fy, cy, Ty), (0, 0, 1, 0); calibrate again")
    return np.array([p[0, 3] / p[0, 0], p[1, 3] / p[1, 1], 0.0])


def _pose(left: Document, right: Document, unit: str) -> Pose | None:
    """``right_from_left`` in mm, None where the files are no pair."""
    zero, t = _baseline(left), _baseline(right)
    if zero is None or t is None or not (zero.any() or t.any()):
        return None
    key = _key(right, _PROJECTION)
    if zero.any() or t[0] > 0:
        why = f"{left.path.name} holds the baseline" if zero.any() else f"{key}[0, 3] is {t[0]:.4g} fx, not negative"
        raise InputError(
            f"{right.path}: left and right look swapped: {why}; name the file of the left camera first, then the right"
        )
    focal = [d.matrix(_key(d, _PROJECTION), 3, 4)[[0, 1], [0, 1]] for d in (left, right)]
    if (np.abs(focal[0] - focal[1]) > _SAME_FOCAL * focal[0]).any():
        raise right.refusal(key, f"{left.path.name} has another focal length; are both files of one calibration?")
    rectified_from_left, rectified_from_right = (
        pose_of(d, _key(d, _RECTIFICATION), d.matrix(_key(d, _RECTIFICATION), 3, 3), np.zeros(3), unit)
        for d in (left, right)
    )
    shift = pose_of(right, key, np.eye(3), t, unit)
    return rectified_from_right.inverse() @ shift @ rectified_from_left
