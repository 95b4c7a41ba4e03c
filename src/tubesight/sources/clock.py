"""Other clocks than this machine's: a camera's own, a stream's."""

from __future__ import annotations

import math

# The shortest way a picture ever took is forgotten at this rate, so that a clock that drifts is followed: quartz clocks
# differ by up to 1e-4.
_FORGET = 2e-4


class ArrivalClock:
    """Turns the times of a foreign clock into this machine's.

    A picture cannot arrive before it was sent, so that the smallest difference between arrival and stamp seen so far is
    the difference of the clocks plus the shortest way; what is longer is delay of that picture. Jitter of the network
    falls out of the times thereby; the shortest way itself stays in them.
    """

    def __init__(self) -> None:
        self._shift_s, self._last_s = math.inf, math.nan

    def time_s(self, stamp_s: float, arrived_s: float) -> float:
        """Time on this machine's clock of a picture stamped by the other; its arrival where there is no stamp."""
        if not math.isfinite(stamp_s):
            return arrived_s
        shift = arrived_s - stamp_s
        if self._last_s < arrived_s:
            self._shift_s += _FORGET * (arrived_s - self._last_s)
        self._last_s = arrived_s
        # A clock that was set back starts anew.
        if shift < self._shift_s or shift > self._shift_s + 5.0:
            self._shift_s = shift
        return stamp_s + self._shift_s
