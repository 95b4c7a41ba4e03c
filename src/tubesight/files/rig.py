"""``rig.yaml``: cameras, their poses in the base frame, and what the calibration left behind."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, PositiveInt, field_validator

from tubesight.core import InputError
from tubesight.files.nested import dump_yaml, parse_yaml
from tubesight.files.safe import Strict, read_bytes, read_text, validate, write_atomic
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig, RigCovariance

FORMAT = "tubesight-rig/1"

# The observations of 100 pictures with 500 corners each take 4 MiB.
RIG_BYTES = 16 << 20
# Camera names become folders, columns and file names.
_NAME = re.compile(r"\w[\w .-]*")
_RESERVED = ("clamp", "background", "calibration", "registration")

_Row = tuple[float, float, float]
_Row4 = tuple[float, float, float, float]


class _CameraFile(Strict):
    size_px: tuple[PositiveInt, PositiveInt]
    matrix: tuple[_Row, _Row, _Row]
    distortion: list[float] = Field(default_factory=list)
    lens: Literal["brown", "rational", "equidistant"] = "brown"
    camera_from_base: tuple[_Row4, _Row4, _Row4, _Row4] | None = None


class _CovarianceFile(Strict):
    parameters: list[str]
    covariance: list[float]


class _RigFile(Strict):
    format: Literal["tubesight-rig/1"]
    units: Literal["mm"]
    cameras: dict[str, _CameraFile] = Field(min_length=1)
    base_frame: str | None = None
    calibration: dict[str, Any] | None = None

    @field_validator("cameras", mode="before")
    @classmethod
    def _names_are_text(cls, cameras: Any) -> Any:
        return {str(name): camera for name, camera in cameras.items()} if isinstance(cameras, dict) else cameras


@dataclass(frozen=True, slots=True)
class RigFile:
    """A rig with the calibration it came from.

    Attributes
    ----------
    rig
        Cameras, poses and, where the calibration gave one, their covariance.
    calibration
        The file's ``calibration`` mapping as it is, None where there is none: ``rms_px``, ``date``, ``board``,
        ``views``, ``left_out``, ``image_hashes``, ``observations``, ``registration``, ``parameters``, ``covariance``
        (upper triangle, row by row).
    """

    rig: Rig
    calibration: Mapping[str, Any] | None = None


def load_rig(path: Path) -> RigFile:
    """Read ``rig.yaml``; raise `InputError` where it does not describe a rig."""
    return rig_from_text(read_text(Path(path), RIG_BYTES), Path(path))


def rig_from_text(text: str, path: Path) -> RigFile:
    """Read the text of a ``rig.yaml`` that lies in another file."""
    file = validate(parse_yaml(text, path), _RigFile, path)
    cameras, poses = {}, {}
    for name, entry in file.cameras.items():
        refuse_camera_name(name, f"{path}: cameras")
        try:
            cameras[name] = _camera(entry)
            if entry.camera_from_base is not None:
                poses[name] = Pose.from_matrix(entry.camera_from_base)
        except ValueError as error:
            raise InputError(f"{path}: cameras.{name}: {error}; mend it or calibrate again") from error
    base_frame = file.base_frame or ("clamp" if poses else next(iter(cameras)))
    if base_frame != "clamp" and base_frame not in cameras:
        raise InputError(f"{path}: base_frame: expected 'clamp' or a camera's name, got {base_frame[:40]!r}")
    covariance = _covariance(file.calibration or {}, cameras, path)
    return RigFile(Rig(cameras, poses, base_frame, covariance), file.calibration)


def refuse_camera_name(name: str, where: str) -> None:
    """Raise `InputError` for a name that no folder or column can have."""
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise InputError(
            f"{where}: {name[:40]!r} cannot be a camera's name; "
            f"use letters, digits, '_', '-', and none of {', '.join(_RESERVED)}"
        )


def _camera(entry: _CameraFile) -> Camera:
    if entry.distortion:
        return Camera(np.array(entry.matrix), entry.size_px, np.array(entry.distortion), entry.lens)
    if entry.lens != "brown":
        raise ValueError(f"distortion: the coefficients of the {entry.lens} lens are missing")
    return Camera(np.array(entry.matrix), entry.size_px)


def _covariance(calibration: Mapping[str, Any], cameras: Mapping[str, Camera], path: Path) -> RigCovariance | None:
    _refuse_nonfinite(calibration, "calibration", path)
    names, values = calibration.get("parameters"), calibration.get("covariance")
    if names is None or values is None:
        return None
    try:
        file = _CovarianceFile(parameters=names, covariance=values)
    except ValueError:
        raise InputError(
            f"{path}: calibration: parameters has to be names, covariance numbers; calibrate again"
        ) from None
    count = len(file.parameters)
    if len(file.covariance) != count * (count + 1) // 2:
        raise InputError(
            f"{path}: calibration.covariance: {count} parameters need {count * (count + 1) // 2} numbers, "
            f"got {len(file.covariance)}; calibrate again"
        )
    for name in file.parameters:
        if name.rpartition(".")[0] not in cameras:
            raise InputError(
                f"{path}: calibration.parameters: {name[:40]!r} is of no camera of the rig; calibrate again"
            )
    upper = np.zeros((count, count))
    upper[np.triu_indices(count)] = file.covariance
    if (upper.diagonal() < 0).any():
        raise InputError(f"{path}: calibration.covariance: a variance is negative; calibrate again")
    return RigCovariance(tuple(file.parameters), upper + np.triu(upper, 1).T)


def _refuse_nonfinite(value: Any, where: str, path: Path) -> None:
    if isinstance(value, dict):
        for key, item in value.items():
            _refuse_nonfinite(item, f"{where}.{key}", path)
    elif isinstance(value, list):
        for item in value:
            _refuse_nonfinite(item, where, path)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{path}: {where}: expected a finite number, got {value}; calibrate again")


def save_rig(path: Path, rig: Rig, calibration: Mapping[str, Any] | None = None) -> None:
    """Write ``rig.yaml``, whole or not at all.

    Parameters
    ----------
    calibration
        Goes into the file as it is (arrays become lists); ``parameters`` and ``covariance`` are taken from
        ``rig.covariance`` where the rig has one.

    Raises
    ------
    InputError
        If the place cannot be written.
    ValueError
        If a number is not finite: such a file could not be read again.
    """
    write_atomic(path, rig_text(rig, calibration))


def rig_text(rig: Rig, calibration: Mapping[str, Any] | None = None) -> str:
    """Write a rig as ``rig.yaml`` has it; see `save_rig`."""
    data: dict[str, Any] = {"format": FORMAT, "units": "mm"}
    if rig.base_frame != "clamp":
        data["base_frame"] = rig.base_frame
    data["cameras"] = {}
    for name, camera in rig.cameras.items():
        entry: dict[str, Any] = {"size_px": camera.size_px, "matrix": camera.matrix, "distortion": camera.distortion}
        if camera.lens != "brown":
            entry["lens"] = camera.lens
        if name in rig.camera_from_base:
            entry["camera_from_base"] = rig.camera_from_base[name].matrix
        data["cameras"][name] = entry
    kept = dict(calibration or {})
    if rig.covariance is not None:
        kept["parameters"] = list(rig.covariance.names)
        kept["covariance"] = rig.covariance.matrix[np.triu_indices(len(rig.covariance.names))]
    if kept:
        data["calibration"] = kept
    text = dump_yaml(data)
    if re.search(r"(?<![\w.])[-+]?\.(?:inf|nan)\b", text):
        raise ValueError("a rig file cannot hold a number that is not finite")
    return text


def rig_hash(path: Path) -> str:
    """SHA-256 of a rig file, hexadecimal: what results name as the rig they were made with."""
    return hashlib.sha256(read_bytes(path, RIG_BYTES)).hexdigest()
