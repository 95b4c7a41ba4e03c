"""What a running session learns of its rig: moved cameras, and delays between their times."""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise

import numpy as np

from tubesight.core import Array
from tubesight.geometry.rig import Rig
from tubesight.sensor import Reconstruction
from tubesight.tracking.health import Health, blind_spots, observe, verdict
from tubesight.tracking.offset import estimate_offset

# Moments a delay is estimated from: 20 s at 30 Hz.
_MOMENTS = 600
# What cannot be seen depends on where the tip is: it is told for each cell of this size that the tip was in, of the
# first so many (5 ms each).
_CELL_MM, _PLACES = 30.0, 40
# A delay that is told: three deviations of it, and what moves a tip at 100 mm/s by 0.1 mm.
_SURE, _LEAST_S = 3.0, 1e-3


class RigWatch:
    """Follows the residuals of a session.

    Parameters
    ----------
    clamped
        Whether the tube's base is that of the rig's frame.
    """

    def __init__(self, rig: Rig, clamped: bool) -> None:
        self._rig, self._clamped = rig, clamped
        self._health = Health()
        self._tips: deque[tuple[float, dict[str, Array]]] = deque(maxlen=_MOMENTS)
        self._places: dict[tuple[int, ...], Array] = {}

    def begin_anew(self, clamped: bool) -> None:
        """Forget the residuals: another method's, or those from a base marked by hand, are others on the same rig."""
        self._health, self._clamped, self._places = Health(), clamped, {}

    def add(self, result: Reconstruction, time_s: float) -> str:
        """Take a pair into account; which camera moved, in a sentence, or nothing."""
        self._health = observe(self._health, result, self._rig, self._clamped)
        if result:
            self._tips.append((time_s, {name: view.tip.axis for name, view in result.views.items()}))
            if self._health.tip_mm is not None and len(self._places) < _PLACES:
                cell = tuple(np.rint(self._health.tip_mm / _CELL_MM).astype(int).tolist())
                self._places.setdefault(cell, self._health.tip_mm)
        return verdict(self._health, self._rig)

    def remarks(self) -> tuple[str, ...]:
        """Say what was found of the rig, and what could not be seen."""
        moved = verdict(self._health, self._rig)
        said = [moved] if moved else []
        if self._places:
            spots = blind_spots(self._rig, np.array(list(self._places.values())), self._clamped)
            said += [f"not seen by the watch over the rig, with the tip where it was: {spot}" for spot in spots]
        return (*said, *self._delays())

    def _delays(self) -> list[str]:
        said = []
        times = np.array([time for time, _ in self._tips])
        for a, b in pairwise(self._rig.names):
            seen = [k for k, (_, tips) in enumerate(self._tips) if a in tips and b in tips]
            rays = {name: np.array([self._tips[k][1][name] for k in seen]).reshape(-1, 3) for name in (a, b)}
            found = estimate_offset(self._rig, a, b, times[seen], rays[a], rays[b])
            if found is not None and abs(found.offset_s) > max(_SURE * found.sd_s, _LEAST_S):
                ms, sd = 1e3 * found.offset_s, 1e3 * found.sd_s
                digits = max(0, -math.floor(math.log10(sd))) if sd > 0 else 1
                said.append(
                    f"{b} is {ms:.{digits}f} +- {sd:.{digits}f} ms later than {a}: --offset {b}={ms:.{digits}f}"
                )
        return said
