"""What the player shows: the pairs of a folder, or the moments of a recording."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tubesight.core import FramePair, Image, InputError, Status
from tubesight.files.recording import PICTURE_TOPIC, RESULT_TOPIC, MessageIndex, Recording, decoded_image
from tubesight.geometry.curve import NodeCurve
from tubesight.geometry.shape import SD_NAMES, Shape
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.sources.folder import FolderSource
from tubesight.sources.jpeg import decode_picture

# Pairs of a folder shown a second at first.
_FOLDER_HZ = 5.0
_ANGLES = ("bending", "orientation")


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One place of a reel.

    Attributes
    ----------
    result, pair
        The shape, and its pictures where there are any.
    time_s
        When, for the plots; None for now.
    remarks
        In words.
    """

    result: Reconstruction
    pair: FramePair | None
    time_s: float | None
    remarks: str


class Reel(Protocol):
    """Places one after the other.

    Attributes
    ----------
    hz
        Places a second at first.
    measured
        Whether there are results that were measured before.
    """

    hz: float
    measured: bool

    def __len__(self) -> int: ...

    def show(self, index: int, sensor: ShapeSensor, again: bool) -> Shown:
        """Measure a place; or return what was measured before, where there is that and it is not to be done again."""

    def close(self) -> None:
        """Let files go."""


class FolderReel:
    """The pairs of a folder; nothing was measured before."""

    def __init__(self, source: FolderSource) -> None:
        self._source = source
        self.hz, self.measured = _FOLDER_HZ, False

    def __len__(self) -> int:
        return len(self._source)

    def show(self, index: int, sensor: ShapeSensor, again: bool) -> Shown:
        """Measure a pair."""
        try:
            pair = self._source.read(index)
        except InputError as error:
            return Shown(_failed(self._source.stems[index], str(error), sensor.method), None, None, "")
        return Shown(sensor(pair), pair, None, "")

    def close(self) -> None:
        """Nothing is held open."""


class RecordingReel:
    """The moments of a recording, with their pictures where it holds them.

    Parameters
    ----------
    recording
        A whole one.

    Raises
    ------
    InputError
        If it was cut off or holds no results.
    """

    def __init__(self, recording: Recording) -> None:
        about = recording.configuration
        self.path, self._about = recording.path, about
        self._index = MessageIndex(recording.path)
        found = [(m.time_ns, m.number) for m in self._index.messages(RESULT_TOPIC)]
        if not found:
            self._index.close()
            raise InputError(f"{self.path}: holds no results; record for longer")
        self._places = found
        steps = np.diff([time_ns for time_ns, _ in found]) / 1e9
        self.hz = 1 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else _FOLDER_HZ
        self.measured = any(self._data(k).get("row") is not None for k in range(len(found)))

    def __len__(self) -> int:
        return len(self._places)

    def show(self, index: int, sensor: ShapeSensor, again: bool) -> Shown:
        """Return what was measured then, or measure the pictures of then."""
        data = self._data(index)
        try:
            pair = self._pair(data, index)
            time_s = float(data["time_s"])
            remarks = "; ".join([str(data.get("state", "")), *map(str, data.get("notes", ())), *_pictures_told(pair)])
            if not again:
                return Shown(recorded_result(data), pair, time_s, f"as recorded; {remarks}")
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise InputError(f"{self.path}: a result in it is damaged ({error}); record again") from error
        if pair is None:
            failed = _failed(str(index), "no pictures of this moment are in the recording", sensor.method)
            return Shown(failed, None, time_s, remarks)
        return Shown(sensor(pair, str(data.get("family", ""))), pair, time_s, remarks)

    def close(self) -> None:
        """Close the file."""
        self._index.close()

    def _data(self, index: int) -> dict[str, Any]:
        time_ns, number = self._places[index]
        message = next(m for m in self._index.messages(RESULT_TOPIC, time_ns, time_ns + 1) if m.number == number)
        data = json.loads(message.data)
        if not isinstance(data, dict):
            raise InputError(f"{self.path}: a result in it is damaged; record again")
        return data

    def _pair(self, data: Mapping[str, Any], index: int) -> FramePair | None:
        """Pictures of a moment; None where they were not recorded, or as crops, whose places are not known."""
        numbers, times = data.get("pictures"), data.get("times_s")
        if not numbers or not times or self._about.get("pictures") in ("none", "crop"):
            return None
        images = {name: self._picture(name, int(number), float(times[name])) for name, number in numbers.items()}
        found = {name: image for name, image in images.items() if image is not None}
        return FramePair(found, str(index), float(data["time_s"])) if len(found) == len(images) else None

    def _picture(self, camera: str, number: int, time_s: float) -> Image | None:
        time_ns = int(self._about["epoch_ns"]) + round(time_s * 1e9)
        for message in self._index.messages(PICTURE_TOPIC + camera, time_ns, time_ns + 1):
            if message.number == number & 0xFFFFFFFF:
                _, coded = decoded_image(message.data)
                return decode_picture(coded, f"{self.path}: {camera} {number}", bool(self._about.get("gray")))
        return None


def recorded_result(data: Mapping[str, Any]) -> Reconstruction:
    """Turn a recorded moment (`tubesight.outputs.moments.moment_data`) back into its result.

    Views are not recorded. The curve has the recorded deviation as one displacement across it, so that its position's
    deviation is the recorded one.
    """
    row = data.get("row")
    if row is None:
        notes = tuple(map(str, data.get("notes", ()))) or (str(data.get("state", "")),)
        return Reconstruction(str(data.get("state", "")), Status.BAD_IMAGE, notes, None, None, {}, "")
    status, method = Status(row["status"]), str(row["method"])
    notes = tuple(note for note in str(row["notes"]).split("; ") if note)
    if status is not Status.OK or data.get("xyz_mm") is None:
        return Reconstruction(str(row["frame"]), status, notes, None, None, {}, method, ms=_ms(row))
    tip = np.array([_number(row[f"tip_{axis}_mm"]) for axis in "xyz"])
    bending, orientation = (math.radians(_number(row[f"{name}_deg"])) for name in _ANGLES)
    sd = dict(zip(SD_NAMES, (_deviation(row, name) for name in SD_NAMES), strict=True))
    shape = Shape(tip, bending, orientation, _number(row["length_mm"]), _number(row["curvature_per_mm"]), sd)
    rms = _number(row["fit_rms_px"])
    return Reconstruction(str(row["frame"]), status, notes, shape, _curve(data, row), {}, method, rms, _ms(row))


def _curve(data: Mapping[str, Any], row: Mapping[str, Any]) -> NodeCurve:
    s, points = np.array(data["s_mm"], float), np.array(data["xyz_mm"], float)
    sd = np.array([_number(value) for value in data["sd_mm"]])
    tangents = np.gradient(points, s, axis=0)
    tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    displaced: tuple[NodeCurve, ...] = ()
    if np.isfinite(sd).all():
        across = np.cross(tangents, np.eye(3)[int(np.abs(tangents).max(0).argmin())])
        across = across / np.linalg.norm(across, axis=1, keepdims=True)
        displaced = (NodeCurve(str(row["model"]), s, points + sd[:, None] * across, tangents),)
    return NodeCurve(str(row["model"]), s, points, tangents, displaced)


def _deviation(row: Mapping[str, Any], name: str) -> float:
    """Deviation of a quantity of `SD_NAMES` in its own unit, from the columns of ``shapes.csv``."""
    if name in _ANGLES:
        return math.radians(_number(row[f"{name}_sd_deg"]))
    return _number(row["curvature_sd_per_mm" if name == "curvature" else f"{name}_sd_mm"])


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)


def _ms(row: Mapping[str, Any]) -> dict[str, float]:
    return {"then": _number(row["total_ms"])}


def _failed(frame: str, reason: str, method: str) -> Reconstruction:
    return Reconstruction(frame, Status.BAD_IMAGE, (reason,), None, None, {}, method)


def _pictures_told(pair: FramePair | None) -> list[str]:
    return [] if pair is not None else ["no pictures recorded"]
