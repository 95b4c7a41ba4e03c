"""What the tracking is doing, and what moves it from one state to the next: one table."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType


class State(StrEnum):
    """State of the tracking."""

    SEARCHING = "searching"
    TRACKING = "tracking"
    DEGRADED = "degraded"
    LOST = "lost"
    FAULT = "fault"

    @property
    def meaning(self) -> str:
        """One sentence for people."""
        return _MEANING[self]


class Event(StrEnum):
    """What a pair of pictures, or a camera, brought."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    MISSED = "missed"
    MISSED_LONG = "missed_long"
    CAMERA_FAULT = "camera_fault"
    CAMERAS_BACK = "cameras_back"


_MEANING: Mapping[State, str] = MappingProxyType(
    {
        State.SEARCHING: "no shape measured yet, or not since the cameras came back",
        State.TRACKING: "the last pair was measured and agrees with those before",
        State.DEGRADED: "the last pair was not measured, or contradicts those before",
        State.LOST: "no pair was measured for a while",
        State.FAULT: "a camera gives no new pictures: nothing is measured",
    }
)

_S, _E = State, Event
#: Every state with every event. A pair that was on its way when a camera failed does not end the fault: only the
#: cameras being back does. A doubtful pair neither ends a search nor a loss.
TRANSITIONS: Mapping[tuple[State, Event], State] = MappingProxyType(
    {
        (_S.SEARCHING, _E.GOOD): _S.TRACKING,
        (_S.SEARCHING, _E.DOUBTFUL): _S.SEARCHING,
        (_S.SEARCHING, _E.MISSED): _S.SEARCHING,
        (_S.SEARCHING, _E.MISSED_LONG): _S.SEARCHING,
        (_S.SEARCHING, _E.CAMERA_FAULT): _S.FAULT,
        (_S.SEARCHING, _E.CAMERAS_BACK): _S.SEARCHING,
        (_S.TRACKING, _E.GOOD): _S.TRACKING,
        (_S.TRACKING, _E.DOUBTFUL): _S.DEGRADED,
        (_S.TRACKING, _E.MISSED): _S.DEGRADED,
        (_S.TRACKING, _E.MISSED_LONG): _S.LOST,
        (_S.TRACKING, _E.CAMERA_FAULT): _S.FAULT,
        (_S.TRACKING, _E.CAMERAS_BACK): _S.TRACKING,
        (_S.DEGRADED, _E.GOOD): _S.TRACKING,
        (_S.DEGRADED, _E.DOUBTFUL): _S.DEGRADED,
        (_S.DEGRADED, _E.MISSED): _S.DEGRADED,
        (_S.DEGRADED, _E.MISSED_LONG): _S.LOST,
        (_S.DEGRADED, _E.CAMERA_FAULT): _S.FAULT,
        (_S.DEGRADED, _E.CAMERAS_BACK): _S.DEGRADED,
        (_S.LOST, _E.GOOD): _S.TRACKING,
        (_S.LOST, _E.DOUBTFUL): _S.LOST,
        (_S.LOST, _E.MISSED): _S.LOST,
        (_S.LOST, _E.MISSED_LONG): _S.LOST,
        (_S.LOST, _E.CAMERA_FAULT): _S.FAULT,
        (_S.LOST, _E.CAMERAS_BACK): _S.LOST,
        (_S.FAULT, _E.GOOD): _S.FAULT,
        (_S.FAULT, _E.DOUBTFUL): _S.FAULT,
        (_S.FAULT, _E.MISSED): _S.FAULT,
        (_S.FAULT, _E.MISSED_LONG): _S.FAULT,
        (_S.FAULT, _E.CAMERA_FAULT): _S.FAULT,
        (_S.FAULT, _E.CAMERAS_BACK): _S.SEARCHING,
    }
)
