"""Bouguet's Camera Calibration Toolbox for MATLAB: ``Calib_Results_stereo.mat`` and ``Calib_Results.mat``.

``X_right = R X_left + T`` with ``R = rodrigues(om)``; ``KK = [fc(1), alpha_c fc(1), cc(1); 0, fc(2), cc(2); 0, 0, 1]``;
``kc = (k1, k2, p1, p2, k3)`` as in OpenCV; pixels are counted from 0, lengths are millimetres (the toolbox's pages on
parameters and stereo).
"""

from __future__ import annotations

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

# om and R are written from one solution.
_SAME_ROTATION = 1e-4


def recognise(document: Document) -> bool:
    """Tell the toolbox by its names for focal length, centre and distortion."""
    return document.matlab and any(
        all(f"{key}{side}" in document.data for key in ("fc", "cc", "kc")) for side in ("", "_left")
    )


def read(documents: Sequence[Document], settings: Settings) -> ForeignRig:
    """Read a stereo file, or a file for each camera (lenses alone)."""
    if len(documents) > 1 and any("fc_left" in document.data for document in documents):
        raise InputError(f"{documents[1].path}: a stereo calibration is one file; name one")
    if "fc_left" not in documents[0].data:
        cameras = tuple(_camera(document, "", document.path.stem, settings) for document in documents)
        return ForeignRig(cameras, (None,) * len(cameras))
    document = documents[0]
    unit = unit_of(settings, "mm")
    cameras = tuple(_camera(document, f"_{side}", side, settings) for side in ("left", "right"))
    if not {"om", "T"} <= set(document.data):
        return ForeignRig(cameras, (None, None), ("no om and T: the lenses alone were read",))
    key, rotation = "om", Pose.from_rotvec(document.vector("om", 3), np.zeros(3)).rotation
    if "R" in document.data:
        key, stated = "R", document.matrix("R", 3, 3)
        pose_of(document, key, stated, np.zeros(3), unit)
        if np.abs(stated - rotation).max() > _SAME_ROTATION:
            raise document.refusal("R", "is not the rotation of om; is it transposed? Save the calibration again")
        rotation = stated
    pose = pose_of(document, key, rotation, document.vector("T", 3), unit)
    return ForeignRig(cameras, (Pose.identity(), pose), (length_note(unit, settings.units is None),))


def _camera(document: Document, side: str, name: str, settings: Settings) -> ForeignCamera:
    focal, centre = document.vector(f"fc{side}", 2), document.vector(f"cc{side}", 2)
    skew = document.vector(f"alpha_c{side}", 1)[0] * focal[0] if f"alpha_c{side}" in document.data else 0.0
    lens, distortion = lens_of(document, f"kc{side}", None, settings)
    matrix = camera_matrix(focal, centre, float(skew), settings.first_pixel or 0)
    size = document.size("nx", "ny") if {"nx", "ny"} <= set(document.data) else None
    return ForeignCamera(name, document.path, matrix, distortion, lens, size)
