"""Rates and times of a running session, of the last seconds and of all."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubesight.outputs.machine import resident_mb
from tubesight.sources.live import CameraCounts
from tubesight.tracking.tracker import Tracked

# Rates and medians are of so many seconds.
_WINDOW_S = 5.0
# Latencies are counted in classes, each 1 % above the one before: from 10 us, far below a measurement, to 100 s, far
# above a frame time.
_CLASS, _SHORTEST_MS, _LONGEST_MS = math.log(1.01), 0.01, 1e5
_CLASSES = math.ceil(math.log(_LONGEST_MS / _SHORTEST_MS) / _CLASS) + 1


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one moment.

    Attributes
    ----------
    seconds
        Since the start.
    pairs, ok, late
        Pairs measured so far, those that are ``ok``, those beyond the deadline.
    rate_hz
        Pairs a second, lately.
    latency_ms, compute_ms
        Medians, lately: from the pictures' time to the shape, and the measurement alone.
    latency_p99_ms
        99th percentile since the start, to 1 %.
    skew_ms
        Median, lately.
    memory_mb
        Resident memory.
    status
        Pairs by status.
    cameras
        Pictures by camera: arrived, and in no pair by reason.
    recorded
        What the recorder says; empty without one.
    rig
        What was found of the rig: a moved camera, delays between cameras, and what cannot be seen.
    """

    seconds: float
    pairs: int
    ok: int
    late: int
    rate_hz: float
    latency_ms: float
    compute_ms: float
    latency_p99_ms: float
    skew_ms: float
    memory_mb: float
    status: Mapping[str, int]
    cameras: Mapping[str, Mapping[str, int]]
    recorded: Mapping[str, Any] = field(default_factory=dict)
    rig: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain data for ``--json``."""
        return asdict(self)

    def line(self) -> str:
        """One line for a log: ``key=value``, the same keys always."""
        lost = sum(n for counts in self.cameras.values() for key, n in counts.items() if key != "arrived")
        return (
            f"t={self.seconds:.1f}s pairs={self.pairs} ok={self.ok} late={self.late} rate={self.rate_hz:.1f}Hz "
            f"latency={self.latency_ms:.1f}ms p99={self.latency_p99_ms:.1f}ms compute={self.compute_ms:.1f}ms "
            f"skew={self.skew_ms:.2f}ms refused={lost} memory={self.memory_mb:.0f}MB"
        )


class Latencies:
    """How often which latency was, so that a session of days takes no more memory than one of minutes."""

    def __init__(self) -> None:
        self._counts: NDArray[np.int64] = np.zeros(_CLASSES, np.int64)

    def add(self, ms: float) -> None:
        """Count one; shorter and longer ones than there are classes for are in the first and last."""
        share = max(ms, _SHORTEST_MS) / _SHORTEST_MS
        self._counts[min(math.ceil(math.log(share) / _CLASS), _CLASSES - 1)] += 1

    def percentile_ms(self, share: float) -> float:
        """Upper end of the class below or in which this share of the latencies lies; NaN where there are none."""
        if not self._counts.any():
            return math.nan
        return _SHORTEST_MS * math.exp(
            _CLASS * int(np.searchsorted(np.cumsum(self._counts), share * self._counts.sum()))
        )

    def median_and_p99_ms(self) -> tuple[float, float]:
        """Both as `percentile_ms` gives them."""
        return self.percentile_ms(0.5), self.percentile_ms(0.99)


class Stats:
    """Collects the figures of a session."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._recent: deque[tuple[float, float, float, float]] = deque()
        self._latencies = Latencies()
        self._status: Counter[str] = Counter()
        self._late = 0

    def add(self, tracked: Tracked) -> None:
        """Count one result."""
        result = tracked.result
        if result is None:
            return
        now = time.monotonic()
        self._recent.append((now, 1e3 * tracked.latency_s, result.total_ms, 1e3 * tracked.skew_s))
        while self._recent[0][0] < now - _WINDOW_S:
            self._recent.popleft()
        self._latencies.add(1e3 * tracked.latency_s)
        self._status[str(result.status)] += 1
        self._late += tracked.late

    def figures(self, cameras: Mapping[str, CameraCounts], recorded: Mapping[str, Any]) -> Figures:
        """Return the figures of this moment."""
        now = time.monotonic()
        recent = [row for row in self._recent if row[0] >= now - _WINDOW_S]
        medians = np.median(np.array(recent)[:, 1:], axis=0).tolist() if recent else [math.nan] * 3
        span = min(now - self._start_s, _WINDOW_S)
        p99 = self._latencies.percentile_ms(0.99)
        by_camera = {
            name: {"arrived": counts.arrived, **{str(reason): n for reason, n in counts.refused.items()}}
            for name, counts in cameras.items()
        }
        return Figures(
            seconds=now - self._start_s,
            pairs=sum(self._status.values()),
            ok=self._status["ok"],
            late=self._late,
            rate_hz=len(recent) / span if span > 0 else math.nan,
            latency_ms=medians[0],
            compute_ms=medians[1],
            latency_p99_ms=p99,
            skew_ms=medians[2],
            memory_mb=resident_mb(),
            status=dict(self._status),
            cameras=by_camera,
            recorded=recorded,
        )
