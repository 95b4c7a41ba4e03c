"""A trial of the pairing in simulated time: drops, jitter and delays, and how many instants get mixed up."""

from __future__ import annotations

import heapq
import random
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tubesight.core import Frame
from tubesight.tracking.pairing import PairingRule, Waiting, offer

# Two free-running clocks at 30 Hz, read with 3 ms of jitter, a fixed lag between the cameras of 4 ms, and pictures that
# arrive up to three frame times late. With the tolerance of 0.45 frame times two instants can not be mixed up: they are
# 33.3 - 4 - 2 * 3 = 23 ms apart at least.
_HZ, _JITTER_S, _LAG_S, _DELAY_S, _DROPS = 30.0, 0.003, 0.004, 0.1, 0.1
_CAMERAS = ("left", "right")


@dataclass(frozen=True, slots=True)
class PairingTrial:
    """What a trial gave.

    Attributes
    ----------
    instants, pictures
        Simulated instants, and pictures of them that were not dropped.
    pairs, mixed
        Pairs made, and those of them with pictures of different instants.
    paired, refused, waiting
        Where the pictures went.
    """

    instants: int
    pictures: int
    pairs: int
    mixed: int
    paired: int
    refused: int
    waiting: int


def run_trial(instants: int, seed: int = 0, tolerance_s: float = 0.45 / _HZ) -> PairingTrial:
    """Pair the pictures of so many instants in the order in which they would arrive."""
    rule, waiting = PairingRule(_CAMERAS, tolerance_s), Waiting()
    pictures = pairs = mixed = paired = refused = 0
    for frame in _arrivals(instants, random.Random(seed)):
        pictures += 1
        waiting, matched, out = offer(rule, waiting, frame)
        refused += len(out)
        if matched is not None:
            pairs += 1
            paired += len(matched.frames)
            # The number of a simulated picture is its instant.
            mixed += len({f.number for f in matched.frames.values()}) > 1
    held = sum(len(frames) for frames in waiting.frames.values())
    return PairingTrial(instants, pictures, pairs, mixed, paired, refused, held)


def _arrivals(instants: int, draw: random.Random) -> Iterator[Frame]:
    """Pictures in the order of arrival, with the times that are stamped on them; one camera's keep their order."""
    image = np.zeros((1, 1), np.uint8)
    coming: list[tuple[float, int, Frame]] = []
    last = dict.fromkeys(_CAMERAS, 0.0)
    count = 0
    for number in range(instants):
        for camera in _CAMERAS:
            if draw.random() < _DROPS:
                continue
            taken = number / _HZ + (_LAG_S if camera == "right" else 0.0)
            stamp = taken + draw.uniform(-_JITTER_S, _JITTER_S)
            arrives = max(taken + _DELAY_S * draw.random() ** 4, last[camera])
            last[camera] = arrives
            heapq.heappush(coming, (arrives, count, Frame(camera, image, stamp, number)))
            count += 1
        while coming and coming[0][0] < number / _HZ:
            yield heapq.heappop(coming)[2]
    while coming:
        yield heapq.heappop(coming)[2]
