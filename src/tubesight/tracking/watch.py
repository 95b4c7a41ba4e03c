"""Whether each camera still gives new pictures: a pure function of what arrived and when."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

# A camera that is silent for so many frame times, and at least so long, is flagged: at 30 Hz after 90 ms. Below 60 ms a
# busy machine's scheduler is as likely a cause.
_SILENT_FRAMES, _SILENT_S = 2.7, 0.06
# Pictures in a row that equal the one before: a sensor's noise makes no two alike, but a driver may hand out one twice.
_FROZEN_AFTER = 2
# Share of a new frame time in the running mean; a gap of this many frame times is a loss, not a frame time.
_LEARN, _GAP = 0.1, 2.5


class CameraFault(StrEnum):
    """What is wrong with a camera."""

    UNPLUGGED = "unplugged"
    SILENT = "silent"
    FROZEN = "frozen"


@dataclass(frozen=True, slots=True)
class Watched:
    """What is known of one camera.

    Attributes
    ----------
    arrived_s
        When its last new picture arrived; NaN before the first.
    period_s
        Mean time between pictures; NaN before the second.
    repeats
        Pictures in a row that were equal to the one before.
    failure
        What its reader said when it gave up, empty while it runs.
    """

    arrived_s: float = math.nan
    period_s: float = math.nan
    repeats: int = 0
    failure: str = ""

    def fault(self, now_s: float) -> CameraFault | None:
        """Say what is wrong at this moment."""
        if self.failure:
            return CameraFault.UNPLUGGED
        if self.repeats >= _FROZEN_AFTER:
            return CameraFault.FROZEN
        longest = max(_SILENT_FRAMES * self.period_s, _SILENT_S) if math.isfinite(self.period_s) else math.inf
        return CameraFault.SILENT if now_s - self.arrived_s > longest else None


def arrived(watched: Watched, now_s: float, repeated: bool) -> Watched:
    """Take a picture, new or equal to the one before, into account."""
    step = now_s - watched.arrived_s
    period = watched.period_s
    if math.isfinite(step) and not repeated:
        if not math.isfinite(period):
            period = step
        elif step < _GAP * period:
            period += _LEARN * (step - period)
    if repeated:
        return replace(watched, repeats=watched.repeats + 1, failure="")
    return Watched(now_s, period, 0, "")


def failed(watched: Watched, reason: str) -> Watched:
    """Take into account that a camera's reader gave up."""
    return replace(watched, failure=reason)
