"""Pictures of one instant from cameras that each send their own: a pure function of the pictures as they arrive."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

from tubesight.core import Frame, FramePair

# Pictures of one camera that wait for their mates; a camera that is so far behind another is not one to measure with.
_WAITING = 8


class Refusal(StrEnum):
    """Why a picture is in no measured pair."""

    UNTIMED = "untimed"
    REPEATED = "repeated"
    OLD = "old"
    ALONE = "alone"
    SUPERSEDED = "superseded"
    BROKEN = "broken"
    TORN = "torn"
    FROZEN = "frozen"


@dataclass(frozen=True, slots=True)
class PairingRule:
    """Which pictures are of one instant.

    Attributes
    ----------
    cameras
        Names; a pair has a picture of each.
    tolerance_s
        Largest difference between the times of a pair's pictures. Below half of a frame time less the jitter of the
        times, two instants cannot be mixed up.
    offset_s
        By camera: what is taken off its times (a constant delay of its clock); none where absent.
    """

    cameras: tuple[str, ...]
    tolerance_s: float
    offset_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise ValueError(f"cameras: expected names that differ, got {self.cameras}")
        if not (math.isfinite(self.tolerance_s) and self.tolerance_s >= 0):
            raise ValueError(f"tolerance_s: expected zero or more, got {self.tolerance_s}")

    def time_s(self, frame: Frame) -> float:
        """Time of a picture on the clock of the rig."""
        return frame.time_s - self.offset_s.get(frame.camera, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Pictures of one instant.

    Attributes
    ----------
    frames
        By camera, in the order of the rule.
    time_s
        Mean of the pictures' times.
    skew_s
        Largest difference between them.
    """

    frames: Mapping[str, Frame]
    time_s: float
    skew_s: float

    def pair(self, name: str) -> FramePair:
        """Return the pictures as the sensor takes them."""
        return FramePair({camera: frame.image for camera, frame in self.frames.items()}, name, self.time_s)


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """State of the pairing: pictures that wait for their mates, oldest first, and the last time used, by camera."""

    frames: Mapping[str, tuple[Frame, ...]] = field(default_factory=dict)
    used_s: Mapping[str, float] = field(default_factory=dict)


Refused = tuple[tuple[Frame, Refusal], ...]


def offer(rule: PairingRule, waiting: Waiting, frame: Frame) -> tuple[Waiting, Matched | None, Refused]:
    """Take the next picture of any camera.

    A pair is made as soon as every camera has a picture within the tolerance; of several the nearest in time. Pictures
    from before a pair can no longer be in one and are refused. Time is that of the pictures alone, so that the same
    pictures in the same order always give the same pairs.

    Returns
    -------
    Waiting
        The state after it.
    Matched or None
        A pair, if this picture completed one.
    tuple
        Pictures that will be in no pair, with the reason.
    """
    camera, time_s = frame.camera, rule.time_s(frame)
    if camera not in rule.cameras:
        raise ValueError(f"camera {camera!r} is none of {', '.join(rule.cameras)}")
    if not math.isfinite(time_s):
        return waiting, None, ((frame, Refusal.UNTIMED),)
    own = waiting.frames.get(camera, ())
    newest = rule.time_s(own[-1]) if own else waiting.used_s.get(camera, -math.inf)
    if time_s <= newest:
        return waiting, None, ((frame, Refusal.REPEATED if time_s == newest else Refusal.OLD),)
    frames = {**waiting.frames, camera: (*own, frame)}
    chosen = _nearest(rule, frames, frame)
    if chosen is None:
        over = frames[camera][:-_WAITING]
        frames[camera] = frames[camera][-_WAITING:]
        return Waiting(frames, waiting.used_s), None, tuple((f, Refusal.ALONE) for f in over)
    times = {name: rule.time_s(f) for name, f in chosen.items()}
    refused = [(f, Refusal.ALONE) for name in chosen for f in frames[name] if rule.time_s(f) < times[name]]
    left = {name: tuple(f for f in frames[name] if rule.time_s(f) > times[name]) for name in chosen}
    spread = max(times.values()) - min(times.values())
    matched = Matched(MappingProxyType(chosen), math.fsum(times.values()) / len(times), spread)
    return Waiting(left, times), matched, tuple(refused)


def _nearest(rule: PairingRule, frames: Mapping[str, tuple[Frame, ...]], frame: Frame) -> dict[str, Frame] | None:
    """Of each camera the picture nearest to a new one, if they are all of one instant."""
    now = rule.time_s(frame)
    chosen: dict[str, Frame] = {}
    for name in rule.cameras:
        candidates = (frame,) if name == frame.camera else frames.get(name, ())
        if not candidates:
            return None
        chosen[name] = min(candidates, key=lambda f: abs(rule.time_s(f) - now))
    times = [rule.time_s(f) for f in chosen.values()]
    return chosen if max(times) - min(times) <= rule.tolerance_s else None
