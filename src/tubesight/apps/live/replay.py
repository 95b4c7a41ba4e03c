"""``tubesight replay``: the pictures of a recording measured again, and compared with what was measured then."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from tubesight.core import Array, Frame, Image, InputError, Status
from tubesight.files.images import decode_image
from tubesight.files.recording import RecordedPicture, RecordedResult, RecordedSwitch, Recording
from tubesight.files.rig import rig_from_text
from tubesight.files.tables import SD_COLUMNS, ShapeRow
from tubesight.files.tube import tube_from_text
from tubesight.geometry.curve import Curve3D
from tubesight.methods import METHODS
from tubesight.outputs.machine import machine
from tubesight.outputs.moments import moment_data
from tubesight.outputs.rows import curves_of, shape_row, write_results
from tubesight.sensor import ShapeSensor
from tubesight.sources.jpeg import decode_picture
from tubesight.tracking.designation import Designation
from tubesight.tracking.pairing import Matched
from tubesight.tracking.tracker import Tracked, Tracker
from tubesight.tracking.watch import CameraFault

# Pictures of one camera that wait for the result they belong to: they are written before it.
_WAITING = 16
# Differences that are kept to be shown.
_SHOWN = 20
# Time is not repeated, and what a frame was called is no measurement.
_NOT_COMPARED = ("total_ms", "frame")
_CURVE = ("xyz_mm", "s_mm", "sd_mm")


@dataclass(frozen=True, slots=True)
class Replayed:
    """How a replay compares.

    Attributes
    ----------
    pairs
        Pairs whose pictures are in the recording.
    compared, equal
        Of these, pairs that were measured then too, and those whose every number is the same to its last bit.
    without_pictures
        Pairs measured then whose pictures were not recorded.
    differences
        The first of them: pair, quantity, value then and value now.
    exact
        Whether the pictures are those that were measured (not ``jpeg`` or ``crop``).
    """

    pairs: int
    compared: int
    equal: int
    without_pictures: int
    differences: tuple[str, ...]
    exact: bool


def replay_file(path: Path, out: Path | None = None, method: str | None = None) -> Replayed:
    """Measure a recording again, by another method where one is named, and write tables where a folder is."""
    recording = Recording(path)
    sensor = sensor_of(recording)
    if method is not None:
        sensor = replace(sensor, method=method)
    rows: list[ShapeRow] = []
    curves: list[tuple[str, Curve3D]] = []

    def keep(tracked: Tracked) -> None:
        result = tracked.result
        if result is not None and out is not None:
            rows.append(shape_row(result, tracked.time_s))
            if result and result.curve is not None:
                curves.append((result.frame, result.curve))

    done = replay(recording, sensor, keep)
    if out is not None:
        about = {"format": "tubesight-replay/1", "recording": path.name, "method": sensor.method, "machine": machine()}
        write_results(out, rows, curves_of(curves), about)
    return done


def sensor_of(recording: Recording) -> ShapeSensor:
    """Build the sensor that measured a recording from its configuration.

    Raises
    ------
    InputError
        If the configuration is not what the format says.
    """
    about, path = recording.configuration, recording.path
    try:
        rig = rig_from_text(str(about["rig"]), path).rig
        tube = tube_from_text(str(about["tube"]), path)
        base = _marks(about)
        backgrounds: dict[str, Image] = {
            name: decode_image(base64.b64decode(data, validate=True), path, rig.cameras[name].size_px)
            for name, data in about["backgrounds"].items()
        }
        method = str(about["method"])
    except (KeyError, TypeError, AttributeError, ValueError, binascii.Error) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: its configuration is damaged ({error}); run `tubesight recover`") from error
    if method not in METHODS:
        raise InputError(f"{path}: was measured with the method {method[:40]!r}, which is not installed")
    return ShapeSensor(rig, tube, method, backgrounds, base, patient=False)


def _marks(about: Mapping[str, Any]) -> dict[str, Array]:
    return {name: np.array(px, float).reshape(2) for name, px in about["base_px"].items()}


def switched(sensor: ShapeSensor, before: Mapping[str, Any], entry: RecordedSwitch, path: Path) -> ShapeSensor:
    """Change a sensor as it was changed during a recording; a method other than the recorded one stays."""
    now = entry.configuration
    try:
        method = str(now["method"]) if sensor.method == before["method"] else sensor.method
        return replace(sensor, method=method, base_px=_marks(now))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            f"{path}: a change of its configuration is damaged ({error}); run `tubesight recover`"
        ) from error


def replay(
    recording: Recording, sensor: ShapeSensor, tell: Callable[[Tracked], None] = lambda tracked: None
) -> Replayed:
    """Measure every pair of a recording in order.

    Parameters
    ----------
    sensor
        `sensor_of` the recording, or another one to try.
    tell
        Called after every pair.

    Raises
    ------
    InputError
        If nothing in the recording can be measured.
    """
    about = recording.configuration
    if about.get("pictures") == "crop":
        raise InputError(f"{recording.path}: holds crops of the pictures, to look at; record with --pictures lossless")
    # What the skew adds to the deviations, and what is of another device, depends on the pairs before: with pictures
    # left out it cannot be repeated.
    whole = about.get("every") == 1
    pairs = compared = equal = without = 0
    differences: list[str] = []
    tracker = Tracker(bool(about.get("filtered")), designation=_designation(recording, sensor))
    for tracked, then in moments(recording, sensor, tracker):
        if tracked is None:
            without += 1
            whole = False
            continue
        if tracked.result is None:
            continue
        pairs += 1
        tell(tracked)
        other = Status.OTHER_DEVICE in (tracked.result.status, (then.get("row") or {}).get("status"))
        if then.get("row") is None or (other and not whole):
            continue
        off = _differences(then, moment_data(tracked), whole)
        compared += 1
        equal += not off
        differences += off[: _SHOWN - len(differences)]
    if not pairs:
        raise InputError(f"{recording.path}: holds no pictures to measure; record with --pictures lossless")
    return Replayed(pairs, compared, equal, without, tuple(differences), about.get("pictures") == "lossless")


def _designation(recording: Recording, sensor: ShapeSensor) -> Designation:
    try:
        marks = {name: np.array(px, float).reshape(2) for name, px in recording.configuration.get("tip_px", {}).items()}
    except (TypeError, AttributeError, ValueError) as error:
        message = f"{recording.path}: its configuration is damaged (tip_px: {error}); run `tubesight recover`"
        raise InputError(message) from error
    return Designation(marks, has_end=sensor.tube.tip.shape != "open")


def moments(
    recording: Recording, sensor: ShapeSensor, tracker: Tracker
) -> Iterator[tuple[Tracked | None, Mapping[str, Any]]]:
    """Go through a recording: what is measured now (None without pictures) and what was written then."""
    about: Mapping[str, Any] = recording.configuration
    gray = bool(about.get("gray"))
    waiting: dict[str, dict[int, RecordedPicture]] = {name: {} for name in sensor.rig.names}
    index = 0
    for entry in recording.entries():
        if isinstance(entry, RecordedPicture):
            own = waiting.setdefault(entry.camera, {})
            own[entry.number] = entry
            while len(own) > _WAITING:
                own.pop(next(iter(own)))
            continue
        if isinstance(entry, RecordedSwitch):
            sensor, about = switched(sensor, about, entry, recording.path), entry.configuration
            tracker.begin_anew()
            continue
        numbers = entry.data.get("pictures")
        if numbers is None:
            told = tracker.watch(_faults(entry), float(entry.data.get("time_s", 0.0)))
            if told is not None:
                yield told, entry.data
            continue
        pictures = {name: waiting.get(name, {}).pop(int(number), None) for name, number in numbers.items()}
        found = {name: picture for name, picture in pictures.items() if picture is not None}
        if len(found) < len(sensor.rig.names):
            index += 1
            yield None, entry.data
            continue
        matched = _matched(recording, entry, found, gray)
        result = sensor(matched.pair(str(index)), str(entry.data.get("family", "")))
        yield tracker.step(result, matched), entry.data
        index += 1


def _matched(
    recording: Recording, entry: RecordedResult, pictures: Mapping[str, RecordedPicture], gray: bool
) -> Matched:
    times = entry.data.get("times_s", {})
    frames = {
        name: Frame(
            name,
            decode_picture(picture.data, f"{recording.path}: {name} {picture.number}", gray),
            float(times.get(name, picture.time_ns / 1e9)),
            picture.number,
            picture.data,
        )
        for name, picture in pictures.items()
    }
    return Matched(MappingProxyType(frames), float(entry.data["time_s"]), float(entry.data["skew_s"]))


def _faults(entry: RecordedResult) -> dict[str, CameraFault]:
    return {name: CameraFault(fault) for name, fault in entry.data.get("faults", {}).items()}


def _differences(then: Mapping[str, Any], now: Mapping[str, Any], whole: bool) -> list[str]:
    """Quantities that are not the same to their last bit."""
    left_out = (*_NOT_COMPARED, *(() if whole else SD_COLUMNS))
    row, new = then["row"], now["row"]
    off = [
        f"pair {row.get('frame')}: {key} was {row.get(key)}, is {value}"
        for key, value in new.items()
        if key not in left_out and row.get(key) != value
    ]
    return off + [f"pair {row.get('frame')}: {key} differs" for key in _CURVE if then.get(key) != now.get(key)]
