"""``tubesight soak``: what has to hold for hours, shown in minutes: pairing, false alarms, memory and rates."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tubesight.apps.live.fault_trial import KINDS, FaultTrial, fault_trial
from tubesight.apps.live.loop import Moment
from tubesight.apps.live.options import LiveOptions, RecordOptions, set_up
from tubesight.apps.live.pairing_trial import PairingTrial, run_trial
from tubesight.apps.live.session import run_session
from tubesight.apps.live.stats import Figures
from tubesight.outputs.machine import give_back_memory, resident_mb
from tubesight.simulate import rig_around
from tubesight.tracking.health import Health, Mean, verdict

# Left out of the growth of memory: so long, or half of a short session. By then the caches are full, the longest of
# which is of 600 moments (20 s at 30 Hz), and Python's collector has gone through everything (every 10 s).
_WARM_UP_S, _WARM_UP_SHARE = 60.0, 0.5
# Less than so much of a rest is too short to tell an hour's growth from.
_LEAST_S = 20.0
# The rest is averaged over so many equal parts, through which the line is laid; looks at the memory in all.
_PARTS, _LOOKS = 10, 400
# Residuals of a rig at rest, px: noise of a frame, and what depends on the tube's shape, of which a day shows many; the
# latter as measured on simulated photographs of 50 arcs of 0 to 86 degrees at 720p, drawn evenly from its whole range.
_NOISE_PX, _SHAPE_S = 0.05, 2.0
_BASE_PX, _SIDE_PX, _EPIPOLAR_PX = 0.06, 0.4, 0.13
_HZ = 30.0
_CLIP_PX = 1.5


@dataclass(frozen=True, slots=True)
class Growth:
    """How resident memory grows after the warm-up.

    Attributes
    ----------
    mb_per_hour
        Slope of the line through the means of ten equal parts, least squares; NaN for a session too short to tell.
    sd_mb_per_hour
        Its standard error, from how far the means are off the line: means of parts, unlike single looks, are nearly
        independent, and a single step shows in it.
    warm_up_s, seconds
        What was left out at the start, and what the line is laid through.
    """

    mb_per_hour: float
    sd_mb_per_hour: float
    warm_up_s: float
    seconds: float

    def words(self) -> str:
        """One line for people."""
        if math.isnan(self.mb_per_hour):
            return f"memory: {self.seconds:.0f} s after the warm-up are too short to tell its growth"
        return (
            f"memory {self.mb_per_hour:+.1f} +- {self.sd_mb_per_hour:.1f} MB per hour, "
            f"over {self.seconds:.0f} s after {self.warm_up_s:.0f} s of warm-up"
        )


@dataclass(frozen=True, slots=True)
class Soak:
    """What a soak found.

    Attributes
    ----------
    pairing
        Pairing in simulated time.
    false_alarms, hours
        Cameras said to have moved in so many simulated hours at rest.
    figures
        Of the live session.
    memory
        How its resident memory grows, free memory handed back before each look.
    cpu_ms_per_pair
        Time of all its threads, with decoding and recording.
    faults
        Of sessions that were killed, and of those whose disk was full; empty where none were asked for.
    """

    pairing: PairingTrial
    false_alarms: int
    hours: float
    figures: Figures
    memory: Growth
    cpu_ms_per_pair: float
    faults: tuple[FaultTrial, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain data for ``--json``."""
        return asdict(self)


def soak(
    sources: dict[str, str],
    seconds: float,
    instants: int,
    hours: float,
    size_px: tuple[int, int] | None = None,
    record: RecordOptions | None = None,
    tell: Callable[[Moment], None] = lambda moment: None,
    faults: int = 0,
) -> Soak:
    """Run all parts, one after the other.

    Parameters
    ----------
    sources
        Simulated cameras by name.
    seconds
        Of the live session.
    instants
        Of the pairing in simulated time, each with a picture of two cameras.
    hours
        Simulated, of a rig at rest.
    record
        What the live session records.
    faults
        Recording sessions that are killed, and as many whose disk is full.
    """
    trials = tuple(fault_trial(kind, faults) for kind in KINDS if faults)
    pairing = run_trial(instants)
    alarms = false_alarms(hours)
    options = LiveOptions(sources, size_px=size_px, gray=True, seconds=seconds, record=record)
    setup = set_up(options)
    memory: list[tuple[float, float]] = []

    def watch(moment: Moment) -> None:
        now = time.monotonic()
        if not memory or now - memory[-1][0] > seconds / _LOOKS:
            # What is held, not what the C library keeps free for the next pictures: that depends on how busy it was.
            give_back_memory()
            memory.append((now, resident_mb()))
        tell(moment)

    before = time.process_time()
    figures = run_session(options, setup, watch)
    cpu_s = time.process_time() - before
    per_pair = 1e3 * cpu_s / figures.pairs if figures.pairs else math.nan
    return Soak(pairing, alarms, hours, figures, growth(memory), per_pair, trials)


def false_alarms(hours: float, seed: int = 0) -> int:
    """Count how often a camera at rest is said to have moved; each alarm begins the watch anew."""
    rng = np.random.default_rng(seed)
    rig = rig_around(90.0)
    pair = (rig.names[0], rig.names[1])
    alarms, health, frames = 0, Health(), int(hours * 3600 * _HZ)
    block = int(_SHAPE_S * _HZ)
    spread = np.array([_BASE_PX, _BASE_PX, _SIDE_PX, _SIDE_PX, _EPIPOLAR_PX])
    for _ in range(0, frames, block):
        noise = rng.normal(0, _NOISE_PX, (block, 5)) + rng.uniform(-spread, spread)
        means = [
            *(health.base_px.get(n, Mean()) for n in rig.names),
            *(health.side_px.get(n, Mean()) for n in rig.names),
        ]
        means.append(health.epipolar_px.get(pair, Mean()))
        for values in noise.tolist():
            means = [mean.add(value, _CLIP_PX) for mean, value in zip(means, values, strict=True)]
        base, side = dict(zip(rig.names, means[:2], strict=True)), dict(zip(rig.names, means[2:4], strict=True))
        health = Health(base, side, {pair: means[4]})
        if verdict(health, rig):
            alarms, health = alarms + 1, Health()
    return alarms


def growth(memory: Sequence[tuple[float, float]]) -> Growth:
    """Lay a line through looks at the memory, (seconds, MB) each, after the warm-up."""
    time_s, mb = np.array(memory, float).reshape(-1, 2).T
    span_s = float(np.ptp(time_s)) if len(time_s) else 0.0
    warm_up_s = min(_WARM_UP_S, _WARM_UP_SHARE * span_s)
    rest_s = span_s - warm_up_s
    if rest_s < _LEAST_S:
        return Growth(math.nan, math.nan, warm_up_s, rest_s)
    # The very last look would be a part of its own.
    part = np.minimum(np.floor((time_s - time_s[0] - warm_up_s) / rest_s * _PARTS), _PARTS - 1)
    parts = [part == k for k in range(_PARTS)]
    if not all(among.any() for among in parts):
        return Growth(math.nan, math.nan, warm_up_s, rest_s)
    hours = np.array([time_s[among].mean() for among in parts]) / 3600
    means = np.array([mb[among].mean() for among in parts])
    hours -= hours.mean()
    slope = float(hours @ means / (hours @ hours))
    off = means - means.mean() - slope * hours
    sd = math.sqrt(float(off @ off) / (_PARTS - 2) / float(hours @ hours))
    return Growth(slope, sd, warm_up_s, rest_s)
